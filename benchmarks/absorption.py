"""Absorption: NeRIF and the voxel methods compared with svmbir.

The burnt fraction of the flame phantom as extinction, seen along parallel rays over half a turn; every pixel of the
reference counts a stated number of quanta, with Poisson noise. svmbir (model-based iterative reconstruction, BSD-3)
fits the same absorbances on voxels of a pixel with its default regularisation and the weights of transmission. L2 /
svmbir and seconds / svmbir are ratios on the same data.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.runner import Settings, peer, ratios
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.voxels.multiplicative import MLEM
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulation import Simulation

SVMBIR = "svmbir"
COLUMNS = {
    "views": "{views}", "counts": "{counts:g}", "largest absorbance": "{largest:.2f}", "method": "{method}",
    "L2": "{l2:.2%}", "L2 / svmbir": "{l2_ratio:.2f}", "CC": "{cc:.5f}", "seconds": "{time:.1f}",
    "seconds / svmbir": "{time_ratio:.1f}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    size = {"pixels": 24, "voxels": 24, "seconds": 3.0} if quick else {"pixels": 64, "voxels": 64, "seconds": 60.0}
    for views in (9,) if quick else (9, 18, 36):
        for counts in (1000.0,) if quick else (100.0, 1000.0):
            for method in (SVMBIR, "NeRIF", "TV", "MLEM"):
                yield {"views": views, "counts": counts, "peak": 0.1, **size, "method": method, "seed": 0}


def by_svmbir(measurement: Measurement, azimuths: np.ndarray, folder: Path) -> Field:
    """Reconstruct by svmbir on voxels of a pixel; its slices go downwards, rows and columns along y and x."""
    svmbir = peer("svmbir", SVMBIR)
    sinogram = measurement.maps["absorbance"].nan_to_num().numpy()  # (view, row, column)
    pitch = float(measurement.cameras[0].pixel_size(torch.zeros(3, dtype=torch.float64)))  # mm
    with tempfile.TemporaryDirectory(dir=folder) as matrices:
        values = svmbir.recon(
            sinogram, np.radians(azimuths), weight_type="transmission", delta_channel=pitch, delta_pixel=pitch,
            svmbir_lib_path=matrices, verbose=0,
        )  # fmt: skip
    grid = Grid(Box.cube(pitch * len(values)), values.shape)
    return VoxelField.through(torch.from_numpy(values[::-1].copy()).float(), grid)


def measure(
    folder: Path, views: int, counts: float, peak: float, pixels: int, voxels: int, seconds: float, method: str,
    seed: int,
) -> dict[str, Any]:  # fmt: skip
    azimuths = 180 / views * np.arange(views)
    ring = Ring(
        views=views, arc=(0.0, float(azimuths[-1])), projection="telecentric", image_size=(pixels, pixels),
        pixel_pitch=0.02 * 200 / pixels,
    )  # fmt: skip
    simulation = Simulation(technique=("absorption",), counts=counts, seed=seed, peak=peak, truth_voxels=voxels)
    measurement, truth = simulation(ring.cameras())
    methods: dict[str, Reconstructor] = {
        "NeRIF": NeRIF(time_limit=seconds, epochs=1e9, seed=seed, device="cpu"),
        "TV": TotalVariation(voxels=voxels, device="cpu"),
        "MLEM": MLEM(voxels=voxels, device="cpu"),
    }
    start = time.perf_counter()
    field = by_svmbir(measurement, azimuths, folder) if method == SVMBIR else methods[method](measurement).field
    duration = time.perf_counter() - start
    scores = evaluate_volume(field, truth, 1.0)
    largest = float(measurement.maps["absorbance"].nan_to_num().max())
    return {"largest": largest, "l2": scores["l2"], "cc": scores["cc"], "time": duration}


def derive(rows: list[dict[str, Any]]) -> None:
    for metric in ("l2", "time"):
        ratios(rows, metric, ("views", "counts"), method=SVMBIR)
