"""The number that scales standard deviations (reconstruction/trials.py), fitted to flows that no test uses.

    python benchmarks/deviations.py --folder out/deviations --write benchmarks/results/deviations-cpu.md

Flows, rigs and noise are drawn at random (random_flows.py). Each is reconstructed with its trials; wanted is the
factor between the errors that trials show around each voxel of the flow and those of the reconstruction,

    F = (F_1 F_2)^(1/2),    |q - n| <= m F_m e    in the share of voxels that a normal distribution has within m,

e^2 the mean square error of the trials, averaged as for standard deviations. Lost is (1 - k^2)^(1/2), k^2 the share of
detail that trials keep, and rho how much less the reconstruction leaves unexplained than they do. C makes the squares
of log F - log rho - C lost least over all draws; how far F is from what the other draws tell of it is the scatter to
expect of standard deviations. What is done is kept in --folder, and not done again.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench import Table, add_write
from nerif.common.files import atomic
from nerif.reconstruction.base import Outcome, Reconstruction
from nerif.reconstruction.uncertainty.bootstrap import LOST, Deviations
from nerif.results.directory import ResultDirectory
from random_flows import random_flow

SHARES = (0.6827, 0.9545)  # of a normal distribution, within one and two standard deviations


def looked_at(number: int, folder: Path) -> dict[str, float | str]:
    """Reconstruct a draw with its trials, or read what was found of it."""
    path = folder / f"{number:04d}.json"
    if not path.is_file():
        found = _reconstructed(number)
        with atomic(path) as part:
            part.write_text(json.dumps(found, indent=1))
    found = json.loads(path.read_text())
    assert isinstance(found, dict)
    return found


def _reconstructed(number: int) -> dict[str, float | str]:
    import torch

    from nerif.analysis.evaluation import FLOW
    from nerif.analysis.prediction import reproject
    from nerif.geometry import Grid
    from nerif.physics.quantities import GasSettings
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF
    from nerif.reconstruction.uncertainty.bootstrap import VOXELS, Original, Trials
    from nerif.workflow.job import Run
    from nerif.workflow.pipeline import reconstruct_into

    torch.set_num_threads(1)
    keep_freed_memory()
    case = random_flow(number)
    measurement = case.measured()
    grid = Grid.of_resolution(case.box, VOXELS)
    truth = case.truth.sample(grid).double()
    with tempfile.TemporaryDirectory() as out:
        method = NeRIF(max_steps=case.steps, epochs=1e9, seed=number, device="cpu")
        run = Run(report=False, uncertainty="fast")
        reconstruct_into(out, measurement, method, run, voxels=VOXELS)
        result = ResultDirectory(out)
        main = _read(result)
        original = Original(main, method, measurement, lambda field: reproject(field, measurement).maps)
        deviations = Deviations(original.volume, GasSettings(), original)
        trials = Trials("fast")
        for trial in range(1, trials.members + 1):
            deviations.add(trials.member(trial, original), _read(result.member(trial)))
    flow = truth.abs() > FLOW * truth.abs().max()
    error = original.volume.values.double() - truth
    size = (error.abs() / deviations.local())[flow].numpy()
    return {
        "flow": "cloud" if case.cloudy else "front",
        "views": case.views,
        "noise": case.noise,
        "steps": case.steps,
        "f_number": case.f_number,
        "l2_variation": float(error.norm() / truth.norm()),
        "lost": math.sqrt(deviations.lost),
        "better": deviations.better,
        **{f"factor_{m}": float(np.quantile(size, share)) / m for m, share in enumerate(SHARES, 1)},
    }


def _read(directory: ResultDirectory) -> Reconstruction:
    return Reconstruction(*directory.field(), [], Outcome("converged", ""), {}, quantity=directory.quantity())


def fitted(lost: NDArray[np.float64], factors: NDArray[np.float64]) -> float:
    """Return C of the least squares of log F - C lost, F over rho."""
    return float(lost @ np.log(factors) / (lost @ lost))


def main() -> None:
    """Reconstruct the draws, and print the number fitted to them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--draws", type=int, nargs="+", default=list(range(20)), help="their numbers")
    parser.add_argument("--folder", type=Path, default=Path("out/deviations"), help="where each draw is kept")
    parser.add_argument("--processes", type=int, default=2)
    add_write(parser)
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    columns = ["draw", "flow", "views", "noise", "lens", "L2 of variation", "lost", "rho", "F_1", "F_2", "F", "told"]
    table = Table("What scales standard deviations", columns, asked.write)
    with ProcessPoolExecutor(asked.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        draws = list(pool.map(looked_at, asked.draws, [asked.folder] * len(asked.draws)))
    lost = np.array([float(d["lost"]) for d in draws])
    better = np.array([float(d["better"]) for d in draws])
    factors = np.array([math.sqrt(float(d["factor_1"]) * float(d["factor_2"])) for d in draws])
    told = []
    for number, d in enumerate(draws):
        others = np.arange(len(draws)) != number
        told.append(better[number] * math.exp(fitted(lost[others], (factors / better)[others]) * lost[number]))
        lens = f"f/{d['f_number']:g}" if d["f_number"] else "-"
        numbers = [lost[number], better[number], d["factor_1"], d["factor_2"], factors[number], told[-1]]
        cells = [f"{d['noise']:.3f}", lens, f"{d['l2_variation']:.1%}", *(f"{float(x):.2f}" for x in numbers)]
        table.row([str(asked.draws[number]), str(d["flow"]), str(d["views"]), *cells])
    off = np.abs(np.log(factors / np.array(told)))
    table.text("", f"C = {fitted(lost, factors / better):.2f}; in trials.py {LOST:g}.")
    median, most = (math.exp(float(np.quantile(off, q))) for q in (0.5, 0.9))
    table.text(f"What the others tell of a draw is off by a factor of {median:.2f} (median), {most:.2f} (nine in ten).")


if __name__ == "__main__":
    main()
