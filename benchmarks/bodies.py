"""Bodies in the flow: a cone in a supersonic stream, thin plates, and flow that leaves the box.

The cone (15 degrees, Mach 2.2, flow by Taylor and Maccoll; pixels of 0.47 mm) lies in `folder_of_bodies`
(`--set folder_of_bodies=PATH`, relative to the repository). Shock: error functions fitted to the field across the
shock, at 24 azimuths and 14 to 30 mm from the apex; its width is that from 10 to 90 %, of the truth 0.75 px (on its own
voxels 2.0 px). Plates: discs 0.4 mm thick in a field that jumps across them, nine views of 100² px. Cut: the box of the
cone cut to a cube of 30 mm, through five faces of which the flow leaves. Whole runs of the pipeline, without a report;
`seconds` is their limit. L2 is that of the variation, outside the bodies.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.runner import ROOT, Settings, Unavailable
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import simulate
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

APEX, ANGLE, STREAM, BEHIND, SURFACE = (-1.0, -0.8, -9.0), 31.33, 1.2e-4, 1.245, 1.433
PIXEL = 0.4667  # mm
FACES = ("x-", "x+", "y-", "y+", "z+")
GAUGES: dict[str, dict[str, Any]] = {
    "faces of the file": {},
    "face z-": {"ambient_faces": ("z-",)},
    "region ahead of the shock": {"ambient_region": (-14.0, 14.0, -14.0, 14.0, -15.0, -11.0)},
    "probe": {"probes": ((0.0, 0.0, -14.0, 1 + STREAM),)},
    "face z-, z+ open": {"ambient_faces": ("z-",), "open_faces": ("z+",)},
    "face z-, all others open, grown 5 mm": {"ambient_faces": ("z-",), "open_faces": FACES, "extend_open_faces": 5.0},
    "face z-, all others open, grown 10 mm": {"ambient_faces": ("z-",), "open_faces": FACES, "extend_open_faces": 10.0},
    "region, all others open, grown 10 mm": {
        "ambient_region": (-14.0, 14.0, -14.0, 14.0, -15.0, -11.0), "open_faces": FACES, "extend_open_faces": 10.0,
    },
}  # fmt: skip
COLUMNS = {
    "flow": "{flow}", "method": "{method}", "body": "{body}", "octaves": "{octaves}", "gauge": "{gauge}",
    "seed": "{seed}", "L2": "{l2:.2%}", "within 2 mm": "{near:.2%}", "surface": "{surface:.2%}",
    "shock": "{angle:.2f}°", "width": "{width:.2f} px", "behind it": "{behind:+.1%}", "on the cone": "{on_cone:+.1%}",
    "seconds": "{time:.0f}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    case = {
        "folder_of_bodies": "../shared/data/body",
        "method": "nerif",
        "body": "yes",
        "octaves": 5,
        "gauge": "",
        "seed": 0,
    }
    if quick:
        yield case | {"flow": "plate 3°", "seconds": 5.0, "pixels": 24}
        return
    cone, plate = case | {"flow": "cone", "seconds": 90.0}, case | {"seconds": 60.0, "pixels": 100}
    yield cone | {"body": "no"}
    for seed in (0, 1):
        yield cone | {"seed": seed}
        yield cone | {"octaves": 6, "seed": seed}
    yield cone | {"method": "tv"}
    for lean in ("3°", "12°"):
        for body in ("yes", "hidden pixels only"):
            yield plate | {"flow": f"plate {lean}", "body": body}
        yield plate | {"flow": f"plate {lean}", "method": "tv"}
    for gauge in GAUGES:
        yield case | {"flow": "cut", "seconds": 60.0, "gauge": gauge}


class Plate(Field):
    """A disc across which the field jumps; it is continuous around the rim.

    In oblate spheroidal coordinates (xi, eta) of the disc, eta |eta| exp(-(xi / 0.45)^2), and a ball of gas beside it.
    """

    radius, thickness, size = 14.0, 0.4, 2e-5
    centre = torch.tensor([1.0, -0.7, 0.5], dtype=torch.float64)

    def __init__(self, lean: float) -> None:
        a = math.radians(lean)
        n = torch.tensor([0.6 * math.sin(a), 0.8 * math.sin(a), math.cos(a)], dtype=torch.float64)
        x = torch.nn.functional.normalize(torch.linalg.cross(n, n.new_tensor([0.0, 1.0, 0.0])), dim=0)
        self.axes = torch.stack([x, torch.linalg.cross(n, x), n])

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            p = points.detach().double().reshape(-1, 3).clone().requires_grad_()
            x, y, z = ((p - self.centre) @ self.axes.T).unbind(-1)
            r2 = self.radius**2
            s = x**2 + y**2 + z**2 - r2
            root = (s * s + 4 * r2 * z * z + 1e-12).sqrt()
            xi, eta2 = ((s + root) / (2 * r2) + 1e-12).sqrt(), (root - s) / (2 * r2) + 1e-12
            value = torch.sign(z) * eta2 * torch.exp(-((xi / 0.45) ** 2)) * (1 + 0.3 * x / self.radius)
            ball = (p - p.new_tensor([6.0, 4.0, -9.0])).square().sum(dim=1)
            value = self.size * (value + 0.6 * torch.exp(-ball / 50))
            (gradient,) = torch.autograd.grad(value.sum(), p)
        return value.detach().to(points).reshape(points.shape[:-1]), gradient.to(points).reshape(points.shape)

    def surface(self, count: int = 4000) -> Float[Tensor, "n 3"]:
        """Return random points of both sides, without the rim, mm."""
        unit = torch.rand(count, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        r, angle = 0.95 * self.radius * unit[:, 0].sqrt(), 2 * math.pi * unit[:, 1]
        side = torch.where(torch.arange(count) % 2 == 0, 1.0, -1.0) * (self.thickness / 2 + 0.02)
        local = torch.stack([r * angle.cos(), r * angle.sin(), side], dim=1)
        return (local @ self.axes + self.centre).float()

    def body(self) -> Any:
        """Return the disc as a mesh."""
        from nerif.geometry.body import Body

        n = 64
        angle = torch.arange(n, dtype=torch.float64) * 2 * math.pi / n
        rim = torch.stack([self.radius * angle.cos(), self.radius * angle.sin(), 0 * angle], dim=1)
        half = torch.tensor([0.0, 0.0, self.thickness / 2], dtype=torch.float64)
        faces = []
        for i in range(n):
            j = (i + 1) % n
            faces += [[i, j, 2 * n], [n + j, n + i, 2 * n + 1], [i, n + i, j], [j, n + i, n + j]]
        vertices = torch.cat([rim + half, rim - half, half[None], -half[None]])
        return Body(vertices @ self.axes + self.centre, torch.tensor(faces), "plate")


def shock(value: Callable[[np.ndarray], np.ndarray], axis: np.ndarray) -> dict[str, float]:
    """Return angle (degrees) and width (px) of the shock, and the error of the density behind it."""
    from scipy.optimize import curve_fit
    from scipy.special import erf

    apex, wave = np.array(APEX), math.radians(ANGLE)
    first = np.cross(axis, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second, s, fits = np.cross(axis, first), np.linspace(-3, 3, 121), []

    def front(x: np.ndarray, x0: float, width: float, height: float, slope: float) -> np.ndarray:
        return height / 2 * (1 - erf((x - x0) / width)) * (1 + slope * np.minimum(x - x0, 0))

    for azimuth in np.arange(24) * math.pi / 12:
        out = math.cos(azimuth) * first + math.sin(azimuth) * second
        along, normal = math.cos(wave) * axis + math.sin(wave) * out, math.cos(wave) * out - math.sin(wave) * axis
        for r in np.arange(14.0, 31.0, 2.0):
            points = apex + r * along + s[:, None] * normal
            if np.abs(points).max() < 24:
                with suppress(RuntimeError):  # no fit, as to a field without a shock
                    (x0, width, height, _), _ = curve_fit(front, s, value(points) / STREAM, [0.0, 0.3, 0.245, -0.05])
                    fits.append((ANGLE + math.degrees(math.atan2(x0, r)), 1.812 * abs(width) / PIXEL, height))
    angle, width, height = np.median(fits, axis=0) if fits else (np.nan,) * 3
    return {"angle": float(angle), "width": float(width), "behind": float((1 + height) / BEHIND - 1)}


def measure(
    folder: Path, flow: str, method: str, body: str, octaves: int, gauge: str, seconds: float, seed: int,
    pixels: int = 120, **data: Any,
) -> dict[str, Any]:  # fmt: skip
    plate = Plate(float(flow.removeprefix("plate ").rstrip("°"))) if flow.startswith("plate") else None
    if plate is not None:
        ring = Ring(views=9, arc=(0.0, 160.0), image_size=(pixels, pixels), pixel_pitch=4.0 / pixels)
        box = Box.cube(50.0)
        measurement = simulate(plate, ring.cameras(), box, 1.00027, 0.05, seed=1 + seed)
        mesh = plate.body()
    else:
        source = ROOT / data["folder_of_bodies"]
        if not (source / "cone.nc").is_file():
            raise Unavailable(f"no cone.nc in {source}")
        measurement, mesh = Measurement.read(source / "cone.nc"), None
        if body != "no":
            from nerif.data.body_file import read_body

            mesh = read_body(source / "cone.stl")
    if mesh is not None:
        from nerif.imaging.bodies import with_bodies

        measurement = with_bodies(measurement, [mesh])
        if body == "hidden pixels only":
            measurement = replace(measurement, bodies=())
    options = dict(GAUGES[gauge]) if gauge else {}
    run = RunSettings(report=False, extend_open_faces=options.pop("extend_open_faces", 0.0))
    if flow == "cut":
        measurement = replace(measurement, box=Box.cube(30.0))
    reconstructor: Reconstructor = TotalVariation(device="cpu")
    if method == "nerif":
        fast = preset("fast")
        network = replace(fast.network, octaves=octaves)
        reconstructor = replace(fast, network=network, time_limit=seconds, seed=seed, device="cpu", **options)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        measurement.write(Path(temporary) / "m.nc")
        start = time.perf_counter()
        field = reconstruct_into(Path(temporary) / "r", Path(temporary) / "m.nc", reconstructor, run).field
        elapsed = time.perf_counter() - start
    scores = (
        of_plate(plate, mesh, field)
        if plate is not None
        else of_cone(ROOT / data["folder_of_bodies"], field, flow == "cut")
    )
    return {"time": elapsed, **scores}


def of_plate(plate: Plate, mesh: Any, field: Field) -> dict[str, float]:
    """Return the errors of a field about a plate."""
    points = Grid.of_resolution(Box.cube(50.0), 100).points().reshape(-1, 3)
    distance = mesh.distance(points)
    points, distance = points[distance > 0], distance[distance > 0]
    scores = {}
    for name, places in (("l2", points), ("near", points[distance < 2.0]), ("surface", plate.surface())):
        truth = plate(places)
        scores[name] = float((sample(field, places) - truth).norm() / truth.norm())
    return scores


def of_cone(source: Path, field: Field, cut: bool) -> dict[str, float]:
    """Return the errors of a field about the cone; within a cube of 30 mm that of the variation alone."""
    import xarray as xr

    with xr.open_dataset(source / "cone_truth.nc") as dataset:
        axes = [torch.tensor(dataset[name].values) for name in "zyx"]
        truth = torch.tensor(dataset["index_excess"].values)
    points = torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1], dim=-1).float()
    inside = truth.isfinite() & (points.abs().amax(dim=-1) < (15.0 if cut else 25.0))
    truth = truth[inside]
    scores = {"l2": float((sample(field, points[inside]) - truth).norm() / truth.norm())}
    if cut:
        return scores
    import trimesh

    vertices = np.asarray(trimesh.load_mesh(source / "cone.stl").vertices) - np.array(APEX)
    length = np.linalg.norm(vertices, axis=1)
    axis = vertices[length > 0.999 * length.max()].mean(axis=0)
    axis /= np.linalg.norm(axis)
    on_surface = vertices[0:0]
    for fraction in np.linspace(0.13, 0.27, 15):  # of its length, within the box
        rim = vertices[length > 0.999 * length.max()]
        on_surface = np.concatenate([on_surface, fraction * rim])
    outwards = on_surface - (on_surface @ axis)[:, None] * axis
    places = on_surface + 0.05 * outwards / np.linalg.norm(outwards, axis=1)[:, None] + np.array(APEX)
    density = 1 + sample(field, torch.from_numpy(places).float()) / STREAM
    scores["on_cone"] = float(density.median()) / SURFACE - 1
    return scores | shock(lambda p: sample(field, torch.from_numpy(p).float()).double().numpy(), axis)


@torch.no_grad()
def sample(field: Field, points: Tensor) -> Tensor:
    """Return a field at points."""
    return torch.cat([field(part) for part in points.split(1 << 13)])
