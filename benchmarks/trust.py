"""What standard deviations are worth (nerif reconstruct --uncertainty): does the truth lie within them?

    python benchmarks/trust.py --write benchmarks/results/trust-cpu.md

Simulated data on rings of cameras over half a turn. For each case: error, and in the flow (excess above 2 % of its
largest) the share of voxels whose truth lies within one and two standard deviations, where 68 and 95 % would be right;
the rank correlation (Spearman) of errors and deviations over all voxels and, of errors averaged as the deviations are,
in the flow; rms deviation over rms error; and the time of the whole command over that without them. Steps end a run, so
that what else the machine does changes the seconds alone. None of these flows scales the deviations (deviations.py).
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench import N_AMBIENT, Table, add_write, alone
from nerif.common.conventions import InputError
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.workflow.job import Run

PHANTOMS = ("gaussians", "flame", "octahedron", "fire")
COLUMNS = ("L2 of variation", "in 1 std", "in 2 std", "Spearman, all", "Spearman, averaged", "std / error", "cost")
VOXELS, EDGE = 64, 50.0
AVERAGED = 0.04  # of the box edge
KINDS: dict[str, dict[str, Any]] = {
    "fast": {"uncertainty": "fast"},
    "full": {"uncertainty": "full"},
}
GOALS = (0.63, 0.73), (0.93, 0.97)


def method_of(name: str, steps: int, seed: int) -> Reconstructor:
    """The method that is asked for: NeRIF, ended by steps, or total variation."""
    if name == "tv":
        return TotalVariation(voxels=40, device="cpu")
    return NeRIF(max_steps=steps, epochs=1e9, seed=seed, device="cpu")


def case(
    phantom: str, noise: float, views: int, f_number: float, kind: str, method: str, steps: int, pixels: int, seed: int
) -> dict[str, float]:
    """Reconstruct one case with its standard deviations, and compare them with the truth."""
    from scipy.ndimage import gaussian_filter
    from scipy.stats import spearmanr

    from nerif.analysis.evaluation import FLOW, evaluate
    from nerif.data.volume import Volume
    from nerif.data.volume_file import write_netcdf
    from nerif.fields.phantoms import make_phantom
    from nerif.geometry import Box, Grid, Ring
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.results.directory import ResultDirectory
    from nerif.simulation.simulate import simulate
    from nerif.workflow.pipeline import reconstruct_into

    keep_freed_memory()
    box = Box.cube(EDGE)
    grid = Grid.of_resolution(box, VOXELS)
    ring = Ring(views=views, arc=(0.0, 180 * (1 - 1 / views)), image_size=(pixels, pixels), pixel_pitch=4.0 / pixels)
    field = make_phantom(phantom, box, seed, 0.0)
    measurement = simulate(field, ring.cameras(f_number), box, N_AMBIENT, noise, seed=seed + 1)
    truth = field.sample(grid)
    with tempfile.TemporaryDirectory() as folder:
        out, known = Path(folder) / "r", Path(folder) / "truth.nc"
        write_netcdf(known, [Volume(truth, grid, attributes={"n_ambient": N_AMBIENT})])
        measurement.write(Path(folder) / "m.nc")
        run = replace(Run(report=False), **KINDS[kind])
        started = time.perf_counter()
        reconstruct_into(out, Path(folder) / "m.nc", method_of(method, steps, seed), run, voxels=VOXELS)
        whole = time.perf_counter() - started
        found = evaluate(out, truth=known)
        metrics = ResultDirectory(out).read().metrics
        volumes = ResultDirectory(out).volumes()
    centre = volumes.get("index_excess_mean", volumes["index_excess"])
    std, error = volumes["index_excess_std"].values, centre.values - truth
    flow = truth.abs() > FLOW * truth.abs().max()
    width = AVERAGED * VOXELS
    local = np.sqrt(gaussian_filter(error.double().numpy() ** 2, width))[flow.numpy()]
    coverage, repeated = metrics["coverage"], metrics["uncertainty"]
    numbers = (
        found["l2_variation"], coverage["share_in_one_in_flow"], coverage["share_in_flow"], coverage["spearman"],
        float(spearmanr(local, std[flow].numpy()).statistic), float(std[flow].norm() / error[flow].norm()),
        whole / (whole - repeated["seconds"]),
    )  # fmt: skip
    return dict(zip(COLUMNS, numbers, strict=True))


def main() -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--phantoms", nargs="+", default=list(PHANTOMS))
    parser.add_argument("--noise", nargs="+", type=float, default=[0.05, 0.15])
    parser.add_argument("--views", nargs="+", type=int, default=[6, 9, 18])
    parser.add_argument("--f-numbers", nargs="+", type=float, default=[0.0, 8.0], help="0 for pinholes")
    parser.add_argument("--kinds", nargs="+", default=["fast"], choices=list(KINDS))
    parser.add_argument("--methods", nargs="+", default=["nerif"], choices=["nerif", "tv"])
    parser.add_argument("--steps", type=int, default=600, help="of NeRIF")
    parser.add_argument("--pixels", type=int, default=64, help="of an edge of each view")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    add_write(parser)
    asked = parser.parse_args()
    if not all(f >= 0 for f in asked.f_numbers):
        raise InputError("f-numbers: expected 0 or more")
    head = ("phantom", "noise", "views", "lens", "method", "kind", "seed", *COLUMNS)
    more = f"\n\nGoals: {GOALS[0][0]:.0%} to {GOALS[0][1]:.0%} in one, {GOALS[1][0]:.0%} to {GOALS[1][1]:.0%} in two."
    table, met = Table("Standard deviations: is the truth within them?", head, asked.write, more), []
    cases = itertools.product(
        asked.phantoms, asked.noise, asked.views, asked.f_numbers, asked.methods, asked.kinds, asked.seeds
    )
    for phantom, noise, views, f_number, method, kind, seed in cases:
        found = alone(case, phantom, noise, views, f_number, kind, method, asked.steps, asked.pixels, seed)
        met.append([low <= found[c] <= high for c, (low, high) in zip(COLUMNS[1:3], GOALS, strict=True)])
        shares = [f"{found[c]:.1%}" for c in COLUMNS[:3]]
        cells = [*shares, *(f"{found[c]:.2f}" for c in COLUMNS[3:])]
        lens = f"f/{f_number:g}" if f_number else "-"
        table.row([phantom, f"{noise:g}", str(views), lens, method, kind, str(seed), *cells])
    one, two = (sum(column) for column in zip(*met, strict=True))
    both = sum(all(row) for row in met)
    table.text("", f"Of {len(met)} cases the goal is met within one in {one}, within two in {two}, both in {both}.")


if __name__ == "__main__":
    main()
