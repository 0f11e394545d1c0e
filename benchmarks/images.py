"""From images to the field: by displacements, and straight, on rendered images of a flame with 12-bit noise.

    python benchmarks/images.py --write benchmarks/results/images-cpu.md

Images are rendered by curved rays, averaged over pixels and lens, with shot noise of 10,000 electrons at full well.
All routes see the same images and the same cameras; each reconstruction is a process of its own, alone. The last
columns are of the displacements that windows found: their rms error, and that in units of their sigma.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench import N_AMBIENT, Table, add_write, alone
from nerif.analysis.prediction import predict
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volume, write_netcdf
from nerif.fields.base import Field
from nerif.fields.phantoms import Scaled, make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.imaging.displacement.displacement import DisplacementSettings, measure
from nerif.imaging.patterns import Background
from nerif.imaging.recording import Scene, Surroundings, join_views
from nerif.simulation.rendering import Sensor, background_texture, pattern_size, render

REFERENCES = 5
CHECKER = "checker"


ROUTES = (
    ("nerif", "correlation", "displacements"),
    ("nerif", "dis", "displacements"),
    ("nerif", "correlation", "images"),
    ("nerif", "none", "images"),
    ("tv", "correlation", "displacements"),
    ("tv", "correlation", "images"),
)
"""Method, optical flow (none: the images alone), and what the reconstruction goes by."""
EVERY = tuple(range(len(ROUTES)))


@dataclass(frozen=True)
class Case:
    """A flame before a background.

    Parameters
    ----------
    pixels : of an edge
    seconds : of training of NeRIF
    goal : L2 that the images are to reach
    f_number : of 50 mm lenses, or 0 for pinholes
    background : kind of pattern
    dot : its size, px
    shift : largest displacement, px; 0 for that of the flame in the rig
    drift : of the light from one side of the image to the other, and as much over all of it
    routes : that are taken, see ROUTES
    """

    pixels: int = 128
    seconds: float = 30.0
    goal: float | None = None
    f_number: float = 0.0
    background: str = "dots"
    dot: float = 3.0
    shift: float = 0.0
    drift: float = 0.0
    routes: tuple[int, ...] = (0, 2)


CASES = {
    "128², pinholes": Case(goal=0.013, routes=EVERY),
    "200², f/8": Case(200, 60.0, 0.012, 8.0, routes=EVERY),
    "wavelets": Case(background="wavelet"),
    "checkers": Case(background=CHECKER),
    "shifts of 0.3 px": Case(shift=0.3),
    "shifts of 1 px": Case(shift=1.0),
    "shifts of 4 px": Case(shift=4.0, routes=(0, 2, 3)),
    "light drifts by 5 %": Case(drift=0.05),
}


def pattern(case: Case, seed: int, width: float, height: float, pixel: float) -> np.ndarray:
    """Return the background of a view, four texels a pixel."""
    texel = pixel / 4
    if case.background != CHECKER:
        return Background(case.background, width, height, dot=case.dot * pixel, seed=seed).raster(texel)
    row, column = np.mgrid[: round(height / texel), : round(width / texel)] // round(4 * case.dot)
    return ((row + column) % 2).astype(float)


def photographed(case: Case, folder: Path) -> None:
    """Render the images, find displacements by each optical flow, and write the measurements and the truth."""
    cameras, box = paper_rig(case.pixels)
    if case.f_number:
        from nerif.geometry import Lens

        cameras = tuple(replace(camera, lens=Lens(50.0 / case.f_number)) for camera in cameras)
    field: Field = make_phantom("flame", box, 0)
    thin = tuple(replace(camera, lens=None) for camera in cameras)
    exact = predict(field, thin, box, N_AMBIENT).displacements
    if case.shift:
        factor = case.shift / float(exact.norm(dim=-1).max())
        field, exact = Scaled(field, factor), exact * factor
    torch.save(exact, folder / "exact.pt")
    grid = Grid.of_resolution(box, 100)
    write_netcdf(folder / "truth.nc", [Volume.of(field.sample(grid), grid, "index_excess", N_AMBIENT)])
    sensor, taken = Sensor(bits=12), []
    for i, camera in enumerate(cameras):
        width, height = pattern_size(camera)
        pixel = width / 1.1 / case.pixels
        raster = pattern(case, i, width, height, pixel)
        texture = background_texture(camera, torch.from_numpy(raster), pixel / 4)
        still = render(camera, texture)
        moved = render(camera, texture, field, box, N_AMBIENT, steps=60)
        drift = 1 + case.drift * (1 + torch.linspace(-0.5, 0.5, case.pixels, dtype=torch.float64))
        references = [sensor.expose(still, REFERENCES * i + k) for k in range(REFERENCES)]
        taken.append((references, sensor.expose(moved * drift, 1000 + i)))
    scene = Scene(box, Surroundings(n_ambient=N_AMBIENT))
    for flow in ("correlation", "dis"):
        settings = DisplacementSettings(flow)
        found = [measure(references, [image], settings) for references, image in taken]
        views = ((camera, one, None) for camera, one in zip(cameras, found, strict=True))
        join_views(views, scene, images=True).write(folder / f"{flow}.nc")
    whole = Measurement.read(folder / "correlation.nc")
    replace(whole, displacement=None, sigma=None).write(folder / "none.nc")


def reconstruct(folder: Path, method: str, flow: str, source: str, seconds: float, seed: int) -> dict[str, Any]:
    """Reconstruct, and compare with the truth."""
    from nerif.analysis.evaluation import evaluate_volume
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF
    from nerif.reconstruction.voxels.total_variation import TotalVariation

    keep_freed_memory()
    measurement = Measurement.read(folder / f"{flow}.nc")
    if method == "nerif":
        result = NeRIF(time_limit=seconds, epochs=1e9, seed=seed, source=source, device="cpu")(measurement)
    else:
        result = TotalVariation(source=source, device="cpu")(measurement)
    scores = evaluate_volume(result.field, read_volume(folder / "truth.nc"), N_AMBIENT)
    found = {"l2": scores["l2"], "variation": scores["l2_variation"], "seconds": result.seconds}
    if measurement.displacement is not None and source == "displacements":
        assert measurement.sigma is not None
        error = (measurement.displacement - torch.load(folder / "exact.pt")).numpy()
        found["error"] = float(np.sqrt(np.nanmean(error**2)))
        found["over_sigma"] = float(np.sqrt(np.nanmean((error / measurement.sigma.numpy()) ** 2)))
    return found


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", default=list(CASES), help="some of the cases, by words in their names")
    parser.add_argument("--methods", nargs="+", default=["nerif", "tv"], choices=["nerif", "tv"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    add_write(parser)
    asked = parser.parse_args()
    columns = ["case", "method", "optical flow", "from", "L2", "of variation", "goal", "s"]
    columns += ["error [px]", "error / sigma"]
    table = Table("From images to the field", columns, asked.write, "\n\nMedians of the seeds.")
    for name, case in CASES.items():
        if not any(words in name for words in asked.only):
            continue
        with tempfile.TemporaryDirectory() as kept:
            folder = Path(kept)
            photographed(case, folder)
            for method, flow, source in (ROUTES[i] for i in case.routes):
                if method not in asked.methods:
                    continue
                seeds = asked.seeds if method == "nerif" else asked.seeds[:1]
                runs = [alone(reconstruct, folder, method, flow, source, case.seconds, seed) for seed in seeds]
                middle = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
                goal = "" if case.goal is None or (method, source) != ("nerif", "images") else f"{case.goal:.1%}"
                error = [f"{middle['error']:.4f}", f"{middle['over_sigma']:.1f}"] if "error" in middle else ["", ""]
                share = [f"{middle['l2']:.2%}", f"{middle['variation']:.2%}", goal, f"{middle['seconds']:.0f}"]
                table.row([name, method, flow, source, *share, *error])


if __name__ == "__main__":
    main()
