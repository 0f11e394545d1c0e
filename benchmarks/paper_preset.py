"""Preset `paper` until its own rule ends it, beside `fast` at equal steps and at equal seconds, on a small rig.

    OMP_NUM_THREADS=1 python benchmarks/paper_preset.py --write benchmarks/results/paper-preset-cpu.md

The rule is the paper's: stop after n_outer passes over all rays, or when the loss is below a share of the initial one.
Network and step are smaller than the paper's; the terms of the loss, the sampling and the optimiser are the preset's.
Seconds are those of the CPU, so that other programs on the machine do not count: run it with one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from types import SimpleNamespace

from bench import N_AMBIENT, Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.base import Reconstruction
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural import schedule as budget
from nerif.reconstruction.neural.losses import DATA_TERMS
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.presets import preset
from nerif.simulation.simulate import simulate

METHODS = ("paper", "fast, equal steps", "fast, equal seconds")
WHAT = ("steps", "CPU seconds", "L2 of variation", "CC")
COLUMNS = ("phantom", *(f"{name}: {what}" for name in METHODS for what in WHAT))
TERMS = ("consistency", "numerical", "head", "gauge")
LAST = 5  # records of the history that the terms at the end are means over


@dataclass(frozen=True)
class Score:
    """What a run came to."""

    steps: int
    seconds: float
    l2_variation: float
    cc: float
    reason: str
    message: str
    epochs: float
    first: dict[str, float]
    last: dict[str, float]
    taken_back: int


def run(method: NeRIF, measurement: Measurement, phantom: str) -> Score:
    """Reconstruct by the clock of the processor, and compare with the truth."""
    keep_freed_memory()
    budget.time = SimpleNamespace(perf_counter=time.process_time)  # type: ignore[assignment]
    result = method(measurement)
    grid = Grid.of_resolution(measurement.box, 64)
    truth = Volume(make_phantom(phantom, measurement.box, 0).sample(grid), grid)
    found = evaluate_volume(result.field, truth, N_AMBIENT, result.device)
    first, last = ends(result)
    end = result.history[-1]
    return Score(
        int(end["step"]), result.seconds, found["l2_variation"], found["cc"], result.outcome.reason,
        result.outcome.message, end["epoch"], first, last, sum("taken_back" in r for r in result.history),
    )  # fmt: skip


def ends(result: Reconstruction) -> tuple[dict[str, float], dict[str, float]]:
    """Return the terms of the loss at the first step, and their means over the last records of the history."""
    records = [r for r in result.history if "loss" in r]
    names = [n for n in (*TERMS, *DATA_TERMS, "loss") if n in records[0]]
    return {n: records[0][n] for n in names}, {n: fmean(r[n] for r in records[-LAST:]) for n in names}


def spread(values: Sequence[float], form: str) -> str:
    """The mean over the seeds, and the range."""
    mean = sum(values) / len(values)
    if len(values) == 1:
        return format(mean, form)
    return f"{mean:{form}} ({min(values):{form}} to {max(values):{form}})"


def cells(scores: Sequence[Score]) -> list[str]:
    """Steps, seconds, L2 of variation and CC of the seeds."""
    names = (("steps", ".0f"), ("seconds", ".0f"), ("l2_variation", ".2%"), ("cc", ".4f"))
    return [spread([getattr(s, name) for s in scores], form) for name, form in names]


def terms(table: Table, found: dict[str, list[Score]]) -> None:
    """Add the table of the terms of the loss."""
    table.text("", "Terms of the loss of preset `paper` at the first step and, as means, at the end:", "")
    table.begin(("phantom", "seed", *TERMS, "loss, end over start", "epochs", "taken back", "ended by"))
    for phantom, own_scores in found.items():
        for seed, s in enumerate(own_scores):
            shown = [f"{s.first[n]:.2g} → {s.last[n]:.2g}" for n in TERMS]
            share = f"{s.last['loss'] / s.first['loss']:.3f}"
            table.row([phantom, str(seed), *shown, share, f"{s.epochs:.1f}", str(s.taken_back), s.reason])


def main() -> None:
    """Run the three in turns, seed by seed, and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--phantom", nargs="+", default=["gaussians", "flame"])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--pixels", type=int, default=32, help="of an edge of each view (the paper: 200)")
    parser.add_argument("--depth", type=int, default=3, help="layers of preset paper (the paper: 7)")
    parser.add_argument("--width", type=int, default=64, help="neurons a layer of preset paper (the paper: 256)")
    parser.add_argument("--points", type=int, default=2048, help="of a step of preset paper")
    parser.add_argument("--epochs", type=float, default=200.0, help="n_outer (the paper does not say)")
    add_write(parser)
    given = parser.parse_args()

    paper = preset("paper")
    skip = min(paper.network.skip, given.depth - 1)
    network = replace(paper.network, depth=given.depth, width=given.width, skip=skip, head_width=given.width // 4)
    paper = replace(paper, network=network, points_per_batch=given.points, epochs=given.epochs, device="cpu")
    fast = replace(preset("fast"), device="cpu")
    cameras, box = paper_rig(given.pixels)
    clean = {p: simulate(make_phantom(p, box, 0), cameras, box, N_AMBIENT) for p in given.phantom}
    about = (
        f"\n\nPreset `paper` with {given.depth} x {given.width} neurons (skip at layer {skip}, heads of "
        f"{network.head_width}) and {given.points} points a step, n_outer = {given.epochs:g}; preset `fast` as it is. "
        f"{len(cameras)} views of {given.pixels} x {given.pixels} px, no noise. One thread; each cell the mean of "
        "the seeds, and the range."
    )
    table = Table("Preset paper beside fast", COLUMNS, given.write, about)
    found: dict[str, list[Score]] = {}
    for phantom, measurement in clean.items():
        scores: dict[str, list[Score]] = {name: [] for name in METHODS}
        for seed in range(given.seeds):
            settings = replace(paper, seed=seed)
            for name in METHODS:
                score = run(settings, measurement, phantom)
                table.say(f"  {phantom}, seed {seed}, {name}: {score}")
                scores[name].append(score)
                own = scores[METHODS[0]][-1]
                equal = {"max_steps": own.steps} if name == METHODS[0] else {"time_limit": own.seconds}
                settings = replace(fast, seed=seed, **equal)
        found[phantom] = scores["paper"]
        table.row([phantom, *(cell for name in METHODS for cell in cells(scores[name]))])
    terms(table, found)


if __name__ == "__main__":
    main()
