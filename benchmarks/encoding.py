"""Octaves along thirteen directions against the paper's along the axes alone: L2 of every phantom after equal steps.

    python benchmarks/encoding.py --write benchmarks/results/encoding-cpu.md

A case is a phantom and a seed, each seed with one of the noise levels; steps and not seconds end a run, so that what
else the machine does plays no part. What a step costs either way is in choices.py.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import statistics
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import torch

from bench import N_AMBIENT, Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.volume import Volume
from nerif.fields.network import DIRECTIONS
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.neural.neural import NeRIF
from nerif.simulation.simulate import add_noise, simulate

PHANTOMS = ("1", "2", "3", "4", "5", "6", "7", "octahedron", "fire", "turbulence")
NOISES = (0.05, 0.10, 0.15)
TRUTH = 100  # voxels along an edge of the box


def errors(case: tuple[str, int, float], pixels: int, steps: int, encodings: list[int]) -> dict[int, float]:
    """L2 of one case, a phantom with a seed and a noise, for each number of directions."""
    phantom, seed, noise = case
    torch.set_num_threads(1)
    cameras, box = paper_rig(pixels)
    field, grid = make_phantom(phantom, box, seed), Grid.of_resolution(box, TRUTH)
    truth = Volume(field.sample(grid), grid)
    measurement = add_noise(simulate(field, cameras, box, N_AMBIENT), noise, seed=seed + 100)
    base, found = NeRIF(max_steps=steps, epochs=1e9, seed=seed, device="cpu"), {}
    for directions in encodings:
        result = replace(base, network=replace(base.network, directions=directions))(measurement)
        found[directions] = evaluate_volume(result.field, truth, N_AMBIENT)["l2"]
    return found


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--phantoms", nargs="+", default=list(PHANTOMS))
    parser.add_argument("--pixels", type=int, default=64, help="of an edge of each view")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--directions", type=int, nargs="+", default=[3, 13], choices=list(DIRECTIONS))
    parser.add_argument("--processes", type=int, default=2, help="of one thread each")
    add_write(parser)
    asked = parser.parse_args()
    axes, *more = asked.directions
    title = f"Directions of the encoding, {asked.steps} equal steps, 9 views of {asked.pixels} x {asked.pixels}"
    shown = "\n\nMedians of L2, and of its ratio to that of the first (lowest to highest)."
    columns = ["phantom", "noise", "seeds", *(f"L2, {n} directions" for n in asked.directions)]
    table = Table(title, [*columns, *(f"ratio, {n}" for n in more)], asked.write, shown)
    context, all_of = multiprocessing.get_context("spawn"), dict[int, list[float]]((n, []) for n in more)
    with ProcessPoolExecutor(asked.processes, mp_context=context) as pool:
        for phantom in asked.phantoms:
            noises = itertools.islice(itertools.cycle(NOISES), asked.seeds)
            cases = [(phantom, seed, noise) for seed, noise in enumerate(noises)]
            runs = [pool.submit(errors, case, asked.pixels, asked.steps, asked.directions) for case in cases]
            of_case = [(case[2], run.result()) for case, run in zip(cases, runs, strict=True)]
            for level in sorted({noise for noise, _ in of_case}):
                some = [found for noise, found in of_case if noise == level]
                ratios = {n: [found[n] / found[axes] for found in some] for n in more}
                cells = [phantom, f"{level:g}", str(len(some))]
                cells += [f"{statistics.median(found[n] for found in some):.3%}" for n in asked.directions]
                cells += [f"{statistics.median(r):.2f} ({min(r):.2f} to {max(r):.2f})" for r in ratios.values()]
                table.row(cells)
                for n in more:
                    all_of[n] += ratios[n]
    for n in more:
        better = sum(ratio < 1 for ratio in all_of[n])
        table.text("", f"{n} directions: better in {better} of {len(all_of[n])} cases, median ratio "
                   f"{statistics.median(all_of[n]):.2f}.")  # fmt: skip


if __name__ == "__main__":
    main()
