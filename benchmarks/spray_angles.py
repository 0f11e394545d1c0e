"""X-ray absorption of a liquid spray: every fifth angle of a scan left out, and predicted from the others.

    python benchmarks/spray_angles.py spray_Re6700.hdf5 --write benchmarks/results/spray-cpu.md

Relative rms error |predicted - measured| / |measured| of the angles left out. "on the axis" compares readings that are
interpolated to a grid about the axis of rotation, as scikit-image's transforms need them and as its users see them;
half of the noise is averaged away there. Peers, with the iteration that is best for the angles left out: SART of
scikit-image and MLEM. TV and NeRIF are fitted without those angles, and TV's weight is chosen by leaving out
others; but that all readings count alike, and that saturation is undone, was settled with the errors of those angles in
view. "but one" leaves out the reading furthest off.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from pathlib import Path

import numpy as np
from skimage.transform import iradon_sart, radon

from bench import Table, add_write
from nerif.imaging.line_scans import LineScan
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.multiplicative import MLEM

sys.path.append(str(Path(__file__).parents[1] / "examples"))
example = importlib.import_module("spray")
WITHHELD, read, reconstruct = example.WITHHELD, example.read, example.reconstruct
relative_error = example.relative_error

GOALS = {"impingement": 0.035, "jets": 0.045, "near": 0.042}
OUT = list(WITHHELD)
ITERATIONS = {"SART": 60, "MLEM": 100}


def about_the_axis(scan: LineScan, axis: float, values: np.ndarray) -> np.ndarray:
    """Values (angle, position) interpolated to positions that have the axis in their middle."""
    count = len(scan.positions)
    at = (np.arange(count) - count // 2) * scan.spacing + axis
    return np.stack([np.interp(at, scan.positions, row, left=0, right=0) for row in values])


def sart(scan: LineScan, axis: float) -> tuple[float, int]:
    """Error on the axis of the best of the iterations, and which that is."""
    seen, degrees = about_the_axis(scan, axis, scan.readings).T, np.degrees(scan.angles)
    kept = [i for i in range(len(degrees)) if i not in OUT]
    field, errors = None, []
    for _ in range(ITERATIONS["SART"]):
        field = iradon_sart(seen[:, kept], degrees[kept], image=field, clip=(0, np.inf))
        errors.append(relative_error(radon(field, degrees[OUT], circle=True), seen[:, OUT]))
    return min(errors), int(np.argmin(errors)) + 1


def errors(scan: LineScan, axis: float, predicted: np.ndarray) -> list[str]:
    """On the axis, as read, and as read but for the reading that is furthest off."""
    there = relative_error(about_the_axis(scan, axis, predicted)[OUT], about_the_axis(scan, axis, scan.readings)[OUT])
    off = (predicted - scan.readings)[OUT]
    rest = np.sqrt((off**2).sum() - (off**2).max()) / np.linalg.norm(scan.readings[OUT])
    return [f"{there:.4f}", f"{relative_error(predicted[OUT], scan.readings[OUT]):.4f}", f"{rest:.4f}"]


def best_mlem(data: Path, name: str) -> tuple[LineScan, float, np.ndarray, int]:
    """What the iteration of MLEM predicts that is best for the angles left out."""
    found = []
    for count in range(10, ITERATIONS["MLEM"] + 1, 10):
        method = MLEM(voxels=60, basis="linear", iterations=count, tolerance=0.0, device="cpu")
        scan, predicted, _, told = reconstruct(read(data, name), WITHHELD, method)
        found.append((relative_error(predicted[OUT], scan.readings[OUT]), count, scan, told.axis, predicted))
    _, count, scan, axis, predicted = min(found, key=lambda f: f[0])
    return scan, axis, predicted, count


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="spray_Re6700.hdf5")
    parser.add_argument("--slices", nargs="+", default=list(GOALS))
    parser.add_argument("--seeds", type=int, default=3, help="of NeRIF, whose median is shown")
    parser.add_argument("--steps", type=int, default=300, help="of NeRIF")
    add_write(parser)
    asked = parser.parse_args()
    columns = ("slice", "goal", "method", "on the axis", "as read", "as read, but one", "seconds")
    table, tells = Table("Spray: angles left out", columns, asked.write), []
    for name in asked.slices:
        start = time.perf_counter()
        tv = example.total_variation(read(asked.data, name), WITHHELD)
        scan, predicted, _, told = reconstruct(read(asked.data, name), WITHHELD, tv)
        seconds = time.perf_counter() - start
        axis = told.axis
        tells.append(f"{name}: {told}; {floor(scan)}")
        best, iteration = sart(scan, axis)
        at, middle, of_mlem, stopped = best_mlem(asked.data, name)
        rows = {
            f"SART, best iteration ({iteration})": [f"{best:.4f}", "", "", ""],
            f"MLEM, best iteration ({stopped})": [*errors(at, middle, of_mlem), ""],
            f"TV, weight {tv.regularisation:g}": [*errors(scan, axis, predicted), f"{seconds:.0f}"],
            f"NeRIF, median of {asked.seeds}": networks(asked, name),
        }
        for method, cells in rows.items():
            table.row([name, f"{GOALS[name]:g}", method, *cells])
    table.text("", *tells)


def floor(scan: LineScan) -> str:
    """How far the angles left out are beside their place, and what that alone changes of them.

    The centre of mass of a medium that the rays of an angle all see runs along a sinusoid. An angle whose centre is
    beside it by a shift was read there, or the medium was: nothing fitted to other angles can tell, and its readings
    are off by the shift times their slope.
    """
    shift = scan.shifts()
    slope = np.gradient(scan.readings, scan.spacing, axis=1)
    off = [shift[i] * slope[i] for i in OUT if i in shift]
    share = np.linalg.norm(off) / np.linalg.norm(scan.readings[OUT])
    told = ", ".join(f"{1e3 * shift[i]:+.0f}" for i in OUT if i in shift)
    return f"the angles left out are {told} µm beside their sinusoid, which alone changes {share:.1%} of them"


def networks(asked: argparse.Namespace, name: str) -> list[str]:
    """Errors and seconds of NeRIF, medians of several seeds."""
    rows = []
    for seed in range(asked.seeds):
        method = NeRIF(max_steps=asked.steps, samples=(24, 40), seed=seed, device="cpu")
        start = time.perf_counter()
        scan, predicted, _, told = reconstruct(read(asked.data, name), WITHHELD, method)
        seconds = time.perf_counter() - start
        rows.append([*map(float, errors(scan, told.axis, predicted)), seconds])
    middle = np.median(rows, axis=0)
    return [*(f"{m:.4f}" for m in middle[:3]), f"{middle[3]:.0f}"]


if __name__ == "__main__":
    main()
