"""The paper's settings to their own end.

Error over the epochs of preset `paper`, which ends after n_outer = 200 passes over all rays, on nine views without
noise. Network, images and steps are small, and a run is stopped after the CPU hours of its case: run it with
OMP_NUM_THREADS=1. The changes exclude what may limit the preset, one by one: the constant rate, the l2 norm, random
samples, the term of central differences.
Loss: mean since the row before, over that of the first step.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.runner import N_AMBIENT, Figure, Settings, cells, table
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.neural.training_settings import LossWeights
from nerif.reconstruction.reconstructor import Step
from nerif.simulation.simulate import simulate

CHANGES: dict[str, dict[str, Any]] = {
    "none": {},
    "cosine rate": {"schedule": "cosine"},
    "squared norm": {"norm": "squared"},
    "shifted samples": {"sampling": "shifted"},
    "exact gradient for differences": {"weights": LossWeights(consistency=1, head=1, automatic=1)},
    "exact gradient alone": {"weights": LossWeights(automatic=1)},
}
EPOCHS = (1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120, 160, 200)
"""Epochs whose error is recorded."""
VOXELS = 40
COLUMNS = {
    "phantom": "{phantom}", "network": "{depth} x {width}", "pixels": "{pixels}²", "change": "{change}",
    "n_outer": "{epochs:g}", "steps": "{steps:.0f}", "CPU seconds": "{seconds:.0f}", "loss": "{loss:.3f}",
    "L2": "{l2:.2%}", "of variation": "{l2_variation:.2%}", "CC": "{cc:.5f}", "outcome": "{outcome}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    small = {"pixels": 32, "depth": 3, "width": 64, "points": 2048, "epochs": 200.0, "hours": 4.0}
    if quick:
        small |= {"pixels": 8, "width": 16, "epochs": 1.0}
    for phantom, seed in (("gaussians", 0),) if quick else (("gaussians", 0), ("flame", 0), ("gaussians", 1)):
        yield {"phantom": phantom, **small, "change": "none", "seed": seed}
    if quick:
        return
    large = {"pixels": 24, "depth": 7, "width": 256, "hours": 2.0}
    yield {"phantom": "gaussians", **small, **large, "change": "none", "seed": 0}
    for change in CHANGES:
        yield {"phantom": "gaussians", **small, "epochs": 20.0, "change": change, "seed": 0}


def measure(
    folder: Path, phantom: str, pixels: int, depth: int, width: int, points: int, epochs: float, hours: float,
    change: str, seed: int,
) -> dict[str, Any]:  # fmt: skip
    cameras, box = paper_rig(pixels)
    field, grid = make_phantom(phantom, box, seed), Grid.of_resolution(box, VOXELS)
    truth = Volume.of(field.sample(grid), grid, "index_excess", N_AMBIENT)
    paper = preset("paper")
    exact = change == "exact gradient alone"
    skip, heads = min(paper.network.skip, depth - 1), 0 if exact else width // 4
    network = replace(paper.network, depth=depth, width=width, skip=skip, head_width=heads, gradient_head=not exact)
    paper = replace(
        paper, network=network, points_per_batch=points, epochs=epochs, seed=seed, device="cpu", **CHANGES[change]
    )
    start, losses = time.process_time(), list[float]()
    first, curve = list[float](), list[list[float]]()

    def record(step: Step) -> bool:
        losses.append(step.losses["loss"])
        first[:] = first or losses
        if len(curve) < len(EPOCHS) and step.epoch >= EPOCHS[len(curve)]:
            scores = evaluate_volume(step.field(), truth, N_AMBIENT)
            loss, seconds = fmean(losses) / first[0], time.process_time() - start
            curve.append([step.epoch, step.step, seconds, loss, scores["l2"], scores["l2_variation"]])
            print(f"{phantom} {depth}x{width} {change}: epoch {step.epoch:.1f} {curve[-1]}", flush=True)
            losses.clear()
        return time.process_time() - start > 3600 * hours

    result = paper(simulate(field, cameras, box, N_AMBIENT), record)
    scores = evaluate_volume(result.field, truth, N_AMBIENT)
    return {
        "steps": result.history[-1]["step"], "seconds": time.process_time() - start, "loss": curve[-1][3],
        "curve": curve, "outcome": result.outcome.reason, **{n: scores[n] for n in ("l2", "l2_variation", "cc")},
    }  # fmt: skip


def blocks(rows: list[dict[str, Any]]) -> list[str | Figure]:
    """Return the table of the ends, and loss and error over the epochs as a table and a figure."""
    done = [row for row in rows if row.get("curve")]
    names = [f"{row['phantom']}, {row['depth']} x {row['width']}, {row['change']}, {row['epochs']:g}" for row in done]

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(1, 2)
        for row, name in zip(done, names, strict=True):
            epochs, _, _, loss, _, error = zip(*row["curve"], strict=True)
            axes[0].loglog(epochs, loss, label=name)
            axes[1].loglog(epochs, [100 * e for e in error])
        axes[0].set(xlabel="epoch", ylabel="loss over that of the first step")
        axes[1].set(xlabel="epoch", ylabel="L2 of variation [%]")
        canvas.legend(loc="outside lower center", fontsize=7, ncols=2)

    curves = [
        [name, f"{epoch:.0f}", f"{step:.0f}", f"{seconds:.0f}", f"{loss:.3f}", f"{l2:.2%}", f"{error:.2%}"]
        for row, name in zip(done, names, strict=True)
        for epoch, step, seconds, loss, l2, error in row["curve"]
    ]
    heads = ["case", "epoch", "steps", "CPU seconds", "loss", "L2", "of variation"]
    figure = Figure("paper-preset-curves", "Loss and error over the epochs of preset paper", (9, 5.5), draw)
    return [table(list(COLUMNS), [cells(COLUMNS, row) for row in rows]), figure, table(heads, curves, 1)]
