"""Standard deviations: is the truth within them?

Simulated data on rings of cameras over half a turn, `--uncertainty fast`. Columns: error; share of voxels of the flow
(excess above 2 % of its largest) whose truth lies within one and two standard deviations, where 68 and 95 % would be
right; rank correlation (Spearman) of errors and deviations over all voxels and, with errors averaged as the
deviations are, in the flow; rms deviation over rms error; time of the whole command over that without deviations. A
run ends by steps. None of these flows was used to scale the deviations (docs/decisions/035).
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.runner import N_AMBIENT, Settings
from nerif.analysis.evaluation import FLOW, evaluate
from nerif.data.volume import Volume, write_netcdf
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

EDGE = 50.0  # mm
AVERAGED = 0.04  # of the box edge
GOALS = {"one": (0.63, 0.73), "two": (0.93, 0.97)}
COLUMNS = {
    "phantom": "{phantom}", "noise": "{noise:g}", "views": "{views}", "f-number": "{f_number:g}", "method": "{method}",
    "kind": "{kind}", "source": "{source}", "L2 of variation": "{l2_variation:.1%}", "in 1 std": "{one:.1%}",
    "in 2 std": "{two:.1%}", "Spearman, all": "{spearman:.2f}", "Spearman, averaged": "{averaged:.2f}",
    "std / error": "{ratio:.2f}", "cost": "{cost:.2f}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    if quick:
        yield {
            "phantom": "gaussians", "noise": 0.05, "views": 6, "f_number": 0.0, "method": "nerif", "kind": "fast",
            "steps": 10, "pixels": 16, "voxels": 16, "seed": 0,
        }  # fmt: skip
        return
    phantoms = ("gaussians", "flame", "octahedron", "fire", "turbulence")
    for phantom, noise, views, f_number in itertools.product(phantoms, (0.05, 0.15), (6, 9, 18), (0.0, 8.0)):
        yield {
            "phantom": phantom, "noise": noise, "views": views, "f_number": f_number, "method": "nerif", "kind": "fast",
            "steps": 600, "pixels": 64, "voxels": 64, "seed": 0,
        }  # fmt: skip


def measure(
    folder: Path, phantom: str, noise: float, views: int, f_number: float, method: str,
    kind: Literal["fast", "full"], steps: int, pixels: int, voxels: int, seed: int,
) -> dict[str, Any]:  # fmt: skip
    from scipy.ndimage import gaussian_filter
    from scipy.stats import spearmanr

    box = Box.cube(EDGE)
    grid = Grid.of_resolution(box, voxels)
    ring = Ring(views=views, arc=(0.0, 180 * (1 - 1 / views)), image_size=(pixels, pixels), pixel_pitch=4.0 / pixels)
    field = make_phantom(phantom, box, seed, 0.0)
    measurement = simulate(field, ring.cameras(f_number), box, N_AMBIENT, noise, seed=seed + 1)
    truth = field.sample(grid)
    reconstructor: Reconstructor = NeRIF(max_steps=steps, epochs=1e9, seed=seed, device="cpu")
    if method == "tv":
        reconstructor = TotalVariation(voxels=40, device="cpu")
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        out, truth_file, data = (Path(temporary) / name for name in ("r", "truth.nc", "m.nc"))
        write_netcdf(truth_file, [Volume(truth, grid, attributes={"n_ambient": N_AMBIENT})])
        measurement.write(data)
        start = time.perf_counter()
        reconstruct_into(out, data, reconstructor, replace(RunSettings(report=False), uncertainty=kind), voxels=voxels)
        seconds = time.perf_counter() - start
        scores = evaluate(out, truth=truth_file)
        metrics, volumes = ResultDirectory(out).read().metrics, ResultDirectory(out).volumes()
    std, error = (
        volumes["index_excess_std"].values,
        volumes.get("index_excess_mean", volumes["index_excess"]).values - truth,
    )
    flow = truth.abs() > FLOW * truth.abs().max()
    local = np.sqrt(gaussian_filter(error.double().numpy() ** 2, AVERAGED * voxels))[flow.numpy()]
    coverage, uncertainty = metrics.coverage, metrics.uncertainty
    assert coverage
    assert uncertainty
    return {
        "l2_variation": scores["l2_variation"], "one": coverage["one_sigma_in_flow"],
        "two": coverage["two_sigma_in_flow"], "spearman": coverage["spearman"], "averaged": float(spearmanr(local,
        std[flow].numpy()).statistic), "ratio": float(std[flow].norm() / error[flow].norm()),
        "source": uncertainty["source"], "cost": seconds / (seconds - uncertainty["seconds"]),
    }  # fmt: skip


def notes(rows: list[dict[str, Any]]) -> list[str]:
    within = [[low <= row[k] <= high for k, (low, high) in GOALS.items()] for row in rows if "one" in row]
    counts = [sum(column) for column in zip(*within, strict=True)] or [0, 0]
    ranges = ", ".join(f"{low:.0%} to {high:.0%} in {name}" for name, (low, high) in GOALS.items())
    return [
        f"Goals: {ranges}; of {len(within)} cases {counts[0]} and {counts[1]} reach them, {sum(map(all, within))} both."
    ]
