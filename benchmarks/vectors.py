"""From the files of vectors of every program to a field, beside the same flow read as a measurement.

Each program's file is written as it documents them (vector_files.py) from one measurement per grid: a flame, vectors on
every 4th pixel, windows of 12 px, 5 % noise. A window that is not stated is taken as two steps of the grid. Both
measurements are reconstructed with the same steps and seed; the truth is in neither.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.runner import N_AMBIENT, Settings
from benchmarks.vector_files import DT, MM, WRITERS, Grid
from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.prediction import predict
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volume
from nerif.fields.phantoms import make_phantom
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Camera, Lens, paper_rig
from nerif.geometry import Grid as Voxels
from nerif.imaging.vectors.vector_settings import VectorSettings
from nerif.imaging.vectors.vectors import read_vectors
from nerif.reconstruction.neural.neural import NeRIF
from nerif.simulation.simulate import add_noise

COLUMNS = {
    "program": "{program}", "file": "{ending}", "views": "{views}", "window": "{window}",
    "rms difference [px]": "{difference:.4f}", "L2 of variation, measurement": "{direct:.2%}",
    "from the file": "{read:.2%}",
}  # fmt: skip
STEP, WINDOW = 4, 12


def cases(quick: bool) -> Iterator[Settings]:
    size = {"pixels": 64, "steps": 20, "voxels": 30} if quick else {"pixels": 256, "steps": 600, "voxels": 80}
    for program in ("PIVlab text",) if quick else WRITERS:
        yield {"program": program, "views": 9, "window": "stated", **size, "seed": 0}
    for program in () if quick else ("PIVlab session", "OpenPIV", "DaVis .vc7"):
        yield {"program": program, "views": 4, "window": "stated", **size, "seed": 0}
    yield {"program": "PIVlab text", "views": 9, "window": "two steps", **size, "seed": 0}


def measure(
    folder: Path, program: str, views: int, window: str, pixels: int, steps: int, voxels: int, seed: int
) -> dict[str, Any]:  # fmt: skip
    writer = WRITERS[program]
    direct, truth, calibration = _flow(folder, writer.first, views, pixels, voxels, seed)
    origin, place = writer.first * STEP - 0.5, folder / f"vectors {program} {views}".replace("/", " per ")
    place.mkdir(exist_ok=True)
    d = STEP * direct.displacements.double().numpy()
    for name, vectors in zip(direct.names, d, strict=True):
        grid = Grid(vectors, np.zeros(vectors.shape[:2], dtype=bool), origin, STEP, pixels)
        writer.write(place / f"{name}{writer.ending}", grid.moved(writer.lag))
    scale, seconds = (
        value if f"--{name}" in writer.arguments else 0.0 for name, value in (("scale", MM), ("time-step", DT))
    )
    stated = WINDOW if window == "stated" else 0.0
    vectors = read_vectors(place, calibration, VectorSettings(window=stated, scale=scale, time_step=seconds))
    difference = (vectors.displacements - direct.displacements)[vectors.usable].square().mean().sqrt() * STEP
    assert vectors.sigma is not None
    direct = replace(direct, sigma=torch.full_like(direct.displacements, float(vectors.sigma.median())))
    errors = (_error(m, truth, steps, seed) for m in (direct, vectors))
    return {
        "ending": writer.ending,
        "difference": float(difference),
        **dict(zip(("direct", "read"), errors, strict=True)),
    }


def _flow(
    folder: Path, first: float, views: int, pixels: int, voxels: int, seed: int
) -> tuple[Measurement, Volume, Path]:  # fmt: skip
    """Return the vectors as a measurement, the true volume, and the calibration of the images."""
    cameras, box = paper_rig(pixels)
    cameras = tuple(replace(c, name=f"cam{i}") for i, c in enumerate(cameras[:: 9 // views][:views], 1))
    calibration, path, truth = folder / f"cameras-{views}.toml", folder / f"{first}-{views}.nc", folder / "truth.nc"
    if not path.is_file():
        write_cameras(calibration, [CalibratedCamera.from_camera(c) for c in cameras], box=box)
        grid = Voxels.of_resolution(box, voxels)
        values = make_phantom("flame", box, 0).sample(grid)
        Volume.of(values, grid, "index_excess", N_AMBIENT).write(truth, force=True)
        _measurement(VoxelField.through(values, grid), cameras, box, first, seed).write(path)
    return Measurement.read(path), read_volume(truth), calibration


def _measurement(flow: VoxelField, cameras: tuple[Camera, ...], box: Box, first: float, seed: int) -> Measurement:
    """Return the vectors as a measurement: a camera whose pixels are the windows."""
    origin, count = first * STEP - 0.5, int(cameras[0].image_size[0] / STEP - 2 * first) + 1
    change = torch.tensor(
        [[1 / STEP, 0, -origin / STEP], [0, 1 / STEP, -origin / STEP], [0, 0, 1]], dtype=torch.float64
    )
    windows = tuple(
        replace(c, intrinsics=change @ c.intrinsics, image_size=(count, count), lens=Lens(window=WINDOW / STEP))
        for c in cameras
    )
    return add_noise(predict(flow, windows, box, N_AMBIENT), 0.05, seed=seed)


def _error(measurement: Measurement, truth: Volume, steps: int, seed: int) -> float:
    result = NeRIF(max_steps=steps, seed=seed, device="cpu")(measurement)
    return evaluate_volume(result.field, truth, N_AMBIENT)["l2_variation"]
