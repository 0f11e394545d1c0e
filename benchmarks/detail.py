"""Detail: turbulent and smooth flows with and without it, by the Gaussian process, and by total variation.

Whole runs of the pipeline, from measurement to result directory, with views of 100² px: NeRIF with `--detail off` and
`auto`, 60 s each and on the rough flows 150 s too, and `gp` and `tv`, which end by themselves. Residuals are those of
the re-projected fitted views over sigma, rms.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from benchmarks.runner import N_AMBIENT, Settings
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume, write_netcdf
from nerif.data.volume_file import read_volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.detail.gaussian_process import GaussianProcess
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

COLUMNS = {
    "phantom": "{phantom}", "views": "{views}", "pixels": "{pixels}²", "method": "{method}", "detail": "{detail}",
    "limit": "{limit:.0f} s",
    "L2": "{l2:.2%}", "of variation": "{l2_variation:.2%}", "residual": "{residual:.2f}", "seconds": "{seconds:.0f}",
    "added": "{added}",
}  # fmt: skip
METHODS = (("nerif", "off"), ("nerif", "auto"), ("gp", "off"), ("tv", "off"))
LIMITS = {16: (6.0,), 100: (60.0, 150.0)}
"""Time limits of NeRIF by the pixels along an image, s; the second for rough flows in nine views."""


def cases(quick: bool) -> Iterator[Settings]:
    flows = [("turbulence", 6, 16, 1)]
    if not quick:
        flows = [(phantom, 9, 100, 3) for phantom in ("turbulence", "fire")]
        flows += [(phantom, 9, 100, 1) for phantom in ("flame", "gaussians", "octahedron")]
        flows += [(phantom, views, 100, 1) for phantom in ("turbulence", "fire") for views in (6, 18)]
    for seed in range(max(seeds for *_, seeds in flows)):
        for phantom, views, pixels, seeds in flows:
            for (method, detail), limit in product(METHODS, LIMITS[pixels]) if seed < seeds else ():
                if limit > LIMITS[pixels][0] and (method != "nerif" or seeds == 1):
                    continue
                if method == "tv" and (views != 9 or seed):
                    continue
                case = {"phantom": phantom, "views": views, "pixels": pixels, "method": method, "detail": detail}
                yield {**case, "limit": limit, "noise": 0.05, "seed": seed}


def measured(folder: Path, phantom: str, views: int, pixels: int, noise: float, seed: int) -> tuple[Path, Path]:
    """Return the files of measurement and truth, simulated once."""
    name = f"detail-{phantom}-{views}-{pixels}-{noise:g}-{seed}"
    data, truth = folder / f"{name}.nc", folder / f"{name}.truth.nc"
    if not (data.exists() and truth.exists()):
        box = Box.cube(50.0)
        field, grid = make_phantom(phantom, box, seed), Grid.of_resolution(box, 100)
        arc = (0.0, 180 * (1 - 1 / views))
        ring = Ring(views=views, arc=arc, image_size=(pixels, pixels), pixel_pitch=4.0 / pixels)
        write_netcdf(truth, [Volume.of(field.sample(grid), grid, "index_excess", N_AMBIENT)])
        simulate(field, ring.cameras(), box, N_AMBIENT, noise, seed=seed + 1).write(data)
    return data, truth


def measure(
    folder: Path, phantom: str, views: int, pixels: int, method: str, detail: Literal["auto", "on", "off"],
    limit: float, noise: float, seed: int,
) -> dict[str, Any]:  # fmt: skip
    data, truth = measured(folder, phantom, views, pixels, noise, seed)
    measurement = Measurement.read(data)
    reconstructor: Reconstructor = replace(preset("fast"), time_limit=limit, seed=seed, device="cpu")
    if method != "nerif":
        reconstructor = {"gp": GaussianProcess, "tv": TotalVariation}[method](device="cpu")
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        out = Path(temporary) / "r"
        start = time.perf_counter()
        result = reconstruct_into(out, data, reconstructor, RunSettings(report=False, detail=detail))
        seconds = time.perf_counter() - start
        metrics = ResultDirectory(out).metrics()
    scores = evaluate_volume(result.field, read_volume(truth), measurement.n_ambient)
    residuals = [view["rms_over_sigma"] for view in metrics.views]
    return {
        "l2": scores["l2"], "l2_variation": scores["l2_variation"], "seconds": seconds,
        "residual": (sum(r**2 for r in residuals) / len(residuals)) ** 0.5, "added": metrics.detail is not None,
    }  # fmt: skip
