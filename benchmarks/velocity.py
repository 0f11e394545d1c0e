"""Velocity of a plume from its density: nerif velocity, correlation of volumes and Horn-Schunck.

A puffing buoyant plume by direct simulation (`plume.nc` in `folder_of_plume`, `--set folder_of_plume=PATH`, relative to
the repository; not nerif's solver). Density: the true one, or that of `nerif sequence` from displacements of nine
views of 72² px with 5 % noise, of which `steps` is the effort for each frame. Errors are relative L2, of the density in
the whole box and in its `interior` (without a tenth at the faces through which the plume enters and leaves, where no
ray is used), of velocity and gradient of pressure where theta exceeds 5 % of its largest value, at the instants at
which the velocity is known. `improved` is the density of `nerif velocity`. `fraction` of the voxels have a vector
(correlation leaves some out), over which the error is taken. `error / std` compares errors of the velocity with the
stated standard deviations (1: right). `withheld`: error of frames between those of the film, carried there by the
velocity, relative to the error of linear interpolation. Horn-Schunck: of each pair of volumes, a velocity of
divergence 0, with the weight of smoothness that is best for the truth: a bound for that method. Needs the extra
`sequence`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.runner import N_AMBIENT, ROOT, Settings, Unavailable
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import COMPONENTS, Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.voxel_field import VoxelField
from nerif.flow.advected_scalar import between
from nerif.flow.assimilation import VelocityFit
from nerif.flow.periodic_box import PeriodicBox
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.neural.presets import preset
from nerif.simulation.particles.particle_velocity import VelocityVectors, velocity_between
from nerif.simulation.simulate import simulate
from nerif.workflow.film_velocity import densities, velocity_of_film
from nerif.workflow.sequence.plan import SequenceSettings
from nerif.workflow.sequence.reconstruct_sequence import reconstruct_sequence

COLUMNS = {
    "density": "{density}", "method": "{method}", "frames": "{frames}", "interval": "{interval:.0f} ms",
    "density error": "{density_error:.1%}", "interior": "{density_interior:.1%}", "improved": "{improved:.1%}",
    "its interior": "{improved_interior:.1%}", "velocity": "{velocity:.1%}", "pressure": "{pressure:.1%}",
    "its interior ": "{pressure_interior:.1%}", "fraction": "{fraction:.0%}", "error / std": "{calibration:.2f}",
    "withheld": "{withheld:.0%}", "seconds": "{time:.0f}", "of the film": "{film_seconds:.0f}",
}  # fmt: skip
FACES = ("x-", "x+", "y-", "y+")
INSIDE = 0.05  # of the largest theta
WEIGHTS = (1e-8, 1e-7, 1e-6, 1e-5)  # of the smoothness of Horn and Schunck


def cases(quick: bool) -> Iterator[Settings]:
    frames, steps = (5, 20) if quick else (21, 500)
    case = {"folder_of_plume": "../shared/data/plume", "frames": frames, "every": 1, "noise": 0.05, "steps": steps}
    case |= {"seconds": 5.0 if quick else 600.0, "resolution": 10 if quick else 30}
    for density in ("true",) if quick else ("true", "film"):
        yield case | {"density": density, "method": "boussinesq"}
        if quick:
            yield case | {"density": density, "method": "transport"}
        yield case | {"density": density, "method": "correlation"}
        yield case | {"density": density, "method": "Horn-Schunck"}
        yield case | {"density": density, "method": "boussinesq", "every": 2, "frames": (frames + 1) // 2}
    if not quick:
        yield case | {"density": "film", "method": "none", "steps": 6 * steps}


def measure(
    folder: Path, folder_of_plume: str, density: str, method: str, frames: int, every: int, noise: float,
    seconds: float, resolution: int, steps: int,
) -> dict[str, Any]:  # fmt: skip
    import xarray as xr

    path = ROOT / folder_of_plume / "plume.nc"
    if not path.is_file():
        raise Unavailable(f"no plume.nc in {path.parent}")
    with xr.open_dataset(path) as data:
        data = data.load()
    count = data.sizes["x"]
    grid = Grid(Box.cube(100.0), (count, count, count))
    indices = list(range(0, min(frames * every, len(data["time"])), every))
    volumes = torch.tensor(data["theta"].values, dtype=torch.float32)
    theta, times = volumes[indices], [float(data["time"][k]) for k in indices]
    store = _truth(folder, theta, grid, times) if density == "true" else _film(folder, theta, grid, times, noise, steps)
    measured = densities(store)
    flow = {float(t): k for k, t in enumerate(data["flow_time"].values)}
    instants = [(k, flow[t]) for k, t in enumerate(times) if t in flow]
    truth = {k: torch.tensor(np.stack([data[c].values[i] for c in "uvw"]), dtype=torch.float32) for k, i in instants}
    inside = {k: theta[k] > INSIDE * float(theta.max()) for k, _ in instants}
    metrics: dict[str, Any] = dict.fromkeys(
        ("improved", "improved_interior", "velocity", "pressure", "pressure_interior", "fraction", "calibration",
         "withheld", "film_seconds"), math.nan,
    ) | {"interval": 1e3 * (times[1] - times[0]), "time": 0.0}  # fmt: skip
    metrics["density_error"], metrics["density_interior"] = _density_errors(measured, theta)
    if density == "film":
        metrics["film_seconds"] = float(np.sum(store.read("seconds", slice(None))))
    begin = time.perf_counter()
    if method in ("boussinesq", "transport"):
        properties = float(data.attrs["viscosity_mm2_s"]), float(data.attrs["diffusivity_mm2_s"])
        settings = VelocityFit(
            physics=method, viscosity=properties[0], diffusivity=properties[1], resolution=resolution,
            time_limit=seconds,
        )  # fmt: skip
        name = f"{density}-{method}-{every}.zarr"
        result = velocity_of_film(store.path, folder / name, settings, force=True)
        metrics["time"] = time.perf_counter() - begin
        velocity = 1e3 * torch.stack([result.vectors(k) for k in range(len(times))])
        if "u_std" in result.quantities:  # else the time limit left none for it
            metrics["calibration"] = _calibration(result, velocity, truth, inside)
        best = 1 - torch.from_numpy(result.read("density", slice(None))) / result.attributes["reference_density"]
        if density == "film":
            metrics["improved"], metrics["improved_interior"] = _density_errors(best, theta)
        if every == 2:
            metrics["withheld"] = _withheld(measured, best, velocity, volumes, indices, grid, times)
        if method == "boussinesq":
            scale = 1e6 / result.attributes["reference_density"]
            slopes = torch.stack([_gradient(scale * torch.from_numpy(result.read("pressure", k)), grid)
                                  for k in range(len(times))])  # fmt: skip
            true = {k: _gradient(torch.tensor(data["p"].values[i], dtype=torch.float32), grid) for k, i in instants}
            metrics["pressure"] = _error(slopes, true, inside)[0]
            metrics["pressure_interior"] = _error(slopes, true, {k: _interior(v) for k, v in inside.items()})[0]
    elif method == "correlation":
        velocity = _correlation(measured, grid, times)
        metrics["time"] = time.perf_counter() - begin
    elif method == "Horn-Schunck":
        tries = [_horn_schunck(measured, grid, times, weight) for weight in WEIGHTS]
        velocity = tries[int(np.argmin([_error(v, truth, inside)[0] for v in tries]))]
        metrics["time"] = (time.perf_counter() - begin) / len(WEIGHTS)
    else:
        return metrics
    metrics["velocity"], metrics["fraction"] = _error(velocity, truth, inside)
    return metrics


def _density_errors(theta: Tensor, true: Tensor) -> tuple[float, float]:
    """Return the relative L2 of densities in the box and in its interior."""
    n = true.shape[1] // 10
    inner = slice(n, true.shape[1] - n)
    return float((theta - true).norm() / true.norm()), float((theta - true)[:, inner].norm() / true[:, inner].norm())


def _interior(mask: Tensor) -> Tensor:
    """Return a mask without the voxels near the faces z- and z+."""
    n, mask = mask.shape[0] // 10, mask.clone()
    mask[:n], mask[mask.shape[0] - n :] = False, False
    return mask


def _calibration(
    result: VelocitySequence, velocity: Tensor, truth: dict[int, Tensor], inside: dict[int, Tensor]
) -> float:
    """Return the rms error of the velocity over the rms standard deviation."""
    error = variance = 0.0
    for k, true in truth.items():
        valid = inside[k] & velocity[k].isfinite().all(dim=0)
        deviation = 1e3 * torch.stack([torch.from_numpy(result.read(f"{name}_std", k)) for name in COMPONENTS])
        error += float((velocity[k] - true)[:, valid].square().sum())
        variance += float(deviation[:, valid].square().sum())
    return math.sqrt(error / variance)


def _withheld(
    film: Tensor, theta: Tensor, velocity: Tensor, volumes: Tensor, indices: list[int], grid: Grid, times: list[float]
) -> float:
    """Return the error of frames halfway, carried by the velocity, over that of linear interpolation of the film."""
    carried = linear = 0.0
    for k, index in enumerate(indices[:-1]):
        halfway = 0.5 * (velocity[k].nan_to_num() + velocity[k + 1].nan_to_num())
        true = volumes[index + 1]
        there = between(theta[k], theta[k + 1], halfway, grid, times[k + 1] - times[k])
        carried += float((there - true).square().sum())
        linear += float((0.5 * (film[k] + film[k + 1]) - true).square().sum())
    return math.sqrt(carried / linear)


def _error(values: Tensor, truth: dict[int, Tensor], inside: dict[int, Tensor]) -> tuple[float, float]:
    """Return the relative L2 over voxels with a vector, and their fraction."""
    error = size = count = total = 0.0
    for k, true in truth.items():
        valid = inside[k] & values[k].isfinite().all(dim=0)
        error += float((values[k] - true)[:, valid].square().sum())
        size += float(true[:, valid].square().sum())
        count, total = count + int(valid.sum()), total + int(inside[k].sum())
    return math.sqrt(error / size), count / total


def _gradient(values: Float[Tensor, "z y x"], grid: Grid) -> Float[Tensor, "3 z y x"]:
    return torch.stack(torch.gradient(values, spacing=grid.spacing[::-1]))


def _truth(folder: Path, theta: Tensor, grid: Grid, times: list[float]) -> VolumeSequence:
    store = VolumeSequence.create(folder / "plume.truth.zarr", times, grid, ("index_excess",), N_AMBIENT)
    for k, volume in enumerate(theta):
        store.write(k, [Volume.of((1 - N_AMBIENT) * volume, grid, "index_excess", N_AMBIENT)])
    return store


def _film(folder: Path, theta: Tensor, grid: Grid, times: list[float], noise: float, steps: int) -> VolumeSequence:
    """Simulate and reconstruct the film once for all methods."""
    out = folder / f"film-{len(times)}-{times[1]:g}-{noise:g}-{steps}.zarr"
    if not out.exists():
        cameras = Ring(views=9, image_size=(72, 72), pixel_pitch=0.11).cameras()
        path = folder / f"measured-{len(times)}-{times[1]:g}-{noise:g}.zarr"
        for k, volume in enumerate(theta):
            field = VoxelField.through((1 - N_AMBIENT) * volume, grid)
            measurement = simulate(field, cameras, grid.box, N_AMBIENT, noise, seed=k, ambient_faces=FACES)
            if k == 0:
                sequence = MeasurementSequence.create(path, times, measurement, force=True)
            sequence.write_frame(k, measurement)
        fast = preset("fast", max_steps=steps, open_faces=("z-", "z+"))
        settings = SequenceSettings(voxels=grid.shape[0], quantities=("index_excess",), warm_steps=steps // 4)
        reconstruct_sequence(out, path, fast, settings, workers=1)
    return VolumeSequence(out)


def _correlation(theta: Tensor, grid: Grid, times: list[float]) -> Tensor:
    """Velocities by window correlation of the frames before and after each one, on the grid of the film, mm/s."""
    result = torch.full((len(times), 3, *grid.shape), math.nan)
    for k in range(len(times)):
        first, last = max(k - 1, 0), min(k + 1, len(times) - 1)
        before, after = Volume(theta[first], grid, "theta"), Volume(theta[last], grid, "theta")
        vectors = velocity_between(before, after, times[last] - times[first], window=12)
        result[k] = _on_grid(vectors, grid)
    return result


def _on_grid(vectors: VelocityVectors, grid: Grid) -> Tensor:
    """Return vectors between the centres of windows on a grid, NaN where one of them is missing."""
    from scipy.interpolate import RegularGridInterpolator

    axes = tuple(vectors.points[..., c].movedim(2 - c, 0)[:, 0, 0].numpy() for c in (2, 1, 0))
    between = RegularGridInterpolator(axes, vectors.values.numpy(), bounds_error=False)
    points = grid.points(torch.float64).flip(-1).reshape(-1, 3).numpy()
    return torch.from_numpy(between(points)).float().T.reshape(3, *grid.shape)


def _horn_schunck(theta: Tensor, grid: Grid, times: list[float], weight: float, iterations: int = 60) -> Tensor:
    """Velocities that minimise |dtheta/dt + u . grad theta|^2 + weight |grad u|^2 with divergence 0, mm/s.

    Conjugate gradients on the spectrum, preconditioned by its smoothness.
    """
    box = PeriodicBox(grid, 0.0)
    smoothness = (weight * box.wave_square.clamp_min(float(box.wave_square[0, 0, 1]))).sqrt()
    result = []
    for k in range(len(times)):
        first, last = max(k - 1, 0), min(k + 1, len(times) - 1)
        rate = (theta[last] - theta[first]) / (times[last] - times[first])
        slope = torch.stack(torch.gradient(theta[k], spacing=grid.spacing[::-1])[::-1])

        def velocity(x: Tensor) -> Tensor:
            return box.values(box.solenoidal(box.spectrum(x) / smoothness))

        def normal(x: Tensor, slope: Tensor = slope) -> Tensor:
            return velocity(slope * (slope * velocity(x)).sum(dim=0)) + x

        b = velocity(-slope * rate)
        x, r = torch.zeros_like(b), b
        p, rr = r, float(r.square().sum())
        for _ in range(iterations):
            q = normal(p)
            alpha = rr / float((p * q).sum())
            x, r = x + alpha * p, r - alpha * q
            before, rr = rr, float(r.square().sum())
            p = r + rr / before * p
        result.append(velocity(x))
    return torch.stack(result)
