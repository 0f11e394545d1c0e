"""Velocity of a plume from its density: nerif velocity, correlation of volumes and Horn-Schunck.

A puffing buoyant plume by direct simulation (`plume.nc` in `folder_of_plume`, `--set folder_of_plume=PATH`, relative to
the repository; not nerif's solver). Density: the true one, or that of `nerif sequence` from displacements of nine
views of 72² px with 5 % noise. Errors are relative L2 where theta exceeds 5 % of its largest value, over the instants
at which the velocity is known; `pressure` is that of the gradient of the pressure. `fraction` of these voxels have a
vector (correlation leaves some out), over which the error is taken. Horn-Schunck: of each pair of volumes, a velocity
of divergence 0, with the weight of smoothness that is best for the truth: a bound for that method. Needs the extra
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
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.grid import VoxelField
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.velocity.assimilation import VelocityFit
from nerif.reconstruction.velocity.periodic_box import PeriodicBox
from nerif.simulation.particles.velocity import Velocity, velocity_between
from nerif.simulation.simulate import simulate
from nerif.workflow.sequence.plan import SequenceSettings
from nerif.workflow.sequence.reconstruct import reconstruct_sequence
from nerif.workflow.velocity import densities, velocity_of_film

COLUMNS = {
    "density": "{density}", "method": "{method}", "frames": "{frames}", "density error": "{density_error:.1%}",
    "velocity": "{velocity:.1%}", "pressure": "{pressure:.1%}", "fraction": "{fraction:.0%}", "seconds": "{time:.0f}",
}  # fmt: skip
FACES = ("x-", "x+", "y-", "y+")
INSIDE = 0.05  # of the largest theta
WEIGHTS = (1e-8, 1e-7, 1e-6, 1e-5)  # of the smoothness of Horn and Schunck


def cases(quick: bool) -> Iterator[Settings]:
    case = {"folder_of_plume": "../shared/data/plume", "frames": 5 if quick else 21, "every": 1, "noise": 0.05}
    case |= {"seconds": 5.0 if quick else 600.0, "resolution": 10 if quick else 30, "steps": 20 if quick else 500}
    for density in ("true",) if quick else ("true", "film"):
        yield case | {"density": density, "method": "boussinesq"}
        yield case | {"density": density, "method": "transport"}
        yield case | {"density": density, "method": "correlation"}
        yield case | {"density": density, "method": "Horn-Schunck"}


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
    theta = torch.tensor(data["theta"].values[indices], dtype=torch.float32)
    times = [float(data["time"][k]) for k in indices]
    store = _truth(folder, theta, grid, times) if density == "true" else _film(folder, theta, grid, times, noise, steps)
    measured = densities(store)
    begin = time.perf_counter()
    pressure = None
    if method in ("boussinesq", "transport"):
        properties = float(data.attrs["viscosity_mm2_s"]), float(data.attrs["diffusivity_mm2_s"])
        settings = VelocityFit(
            physics=method, viscosity=properties[0], diffusivity=properties[1], resolution=resolution,
            time_limit=seconds,
        )  # fmt: skip
        result = velocity_of_film(store.path, folder / f"{density}-{method}.zarr", settings, force=True)
        velocity = 1e3 * torch.stack([result.vectors(k) for k in range(len(times))])
        if method == "boussinesq":
            scale = 1e6 / result.attributes["reference_density"]
            pressure = scale * torch.from_numpy(result.read("pressure", slice(None)))
    elif method == "correlation":
        velocity = _correlation(measured, grid, times)
    else:
        velocity = None
    metrics: dict[str, Any] = {"time": time.perf_counter() - begin}
    flow = {float(t): k for k, t in enumerate(data["flow_time"].values)}
    instants = [(k, flow[t]) for k, t in enumerate(times) if t in flow]
    truth = {k: torch.tensor(np.stack([data[c].values[i] for c in "uvw"]), dtype=torch.float32) for k, i in instants}
    inside = {k: theta[k] > INSIDE * float(theta.max()) for k, _ in instants}
    if velocity is None:
        tries = [_horn_schunck(measured, grid, times, weight) for weight in WEIGHTS]
        errors = [_error(v, truth, inside)[0] for v in tries]
        velocity = tries[int(np.argmin(errors))]
        metrics["time"] = (time.perf_counter() - begin) / len(WEIGHTS)
    metrics["velocity"], metrics["fraction"] = _error(velocity, truth, inside)
    metrics["pressure"] = math.nan
    if pressure is not None:
        true = {k: _gradient(torch.tensor(data["p"].values[i], dtype=torch.float32), grid) for k, i in instants}
        slopes = torch.stack([_gradient(p, grid) for p in pressure])
        metrics["pressure"] = _error(slopes, true, inside)[0]
    metrics["density_error"] = float((measured - theta).norm() / theta.norm())
    return metrics


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
    out = folder / f"film-{len(times)}-{times[1]:g}-{noise:g}.zarr"
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


def _on_grid(vectors: Velocity, grid: Grid) -> Tensor:
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
