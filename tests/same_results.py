"""Compare the results of this working tree with those of another commit, to the last bit.

    python tests/same_results.py REV

Both run on this machine with one thread and the same seeds: simulated measurements, NeRIF, the voxel methods and the
bootstrap, by the command line. Compared are all numbers of the NetCDF files and of the histories but the times. Poses
that were refined may differ by the rounding of LAPACK, which depends on where its arrays lie in memory.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np

ROOT = Path(__file__).parents[1]
RIG = ["--views", "5", "--image-size", "20", "26", "--pixel-pitch", "0.2", "--steps", "40", "--truth-voxels", "16"]
FIT = ["--voxels", "16", "--no-report"]
MEASUREMENTS = {
    "balls": ["--phantom", "gaussians", "--noise", "0.05", "--seed", "3"],
    "flame": ["--phantom", "flame", "--noise", "0.03", "--seed", "4"],
    "soot": ["--phantom", "gaussians", "--technique", "absorption", "--noise", "0.02", "--seed", "5"],
}
NERIF = ["--preset", "fast", "--max-steps", "60", "--points-per-batch", "1024", "--device", "cpu"]
RECONSTRUCTIONS = {
    "nerif": ("balls", NERIF),
    "nerif_withheld": ("flame", [*NERIF, "--withhold", "85deg", "--seed", "2"]),
    "nerif_paper": ("balls", ["--preset", "paper", "--max-steps", "6", *NERIF[4:]]),
    "nerif_rig": ("balls", [*NERIF, "--refine", "cameras"]),
    "nerif_bootstrap": ("balls", [*NERIF, "--uncertainty", "fast"]),
    "tv": ("balls", ["--method", "tv", "--iterations", "20", "--device", "cpu"]),
    "tikhonov": ("flame", ["--method", "tikhonov", "--iterations", "20", "--device", "cpu"]),
    "landweber": ("flame", ["--method", "landweber", "--iterations", "20", "--device", "cpu"]),
    "mlem": ("soot", ["--method", "mlem", "--iterations", "20", "--device", "cpu"]),
}
POSES = ("rotation", "translation")
TIMES = ("seconds", "rays_per_second")
WRITTEN = {"NUMBA_CACHE_DIR": "numba", "MPLCONFIGDIR": "matplotlib"}


def commands(folder: Path) -> list[list[str]]:
    """Return the arguments of `nerif`, in order."""
    made = [["simulate", "-o", str(folder / f"{name}.nc"), *how, *RIG] for name, how in MEASUREMENTS.items()]
    for name, (measurement, how) in RECONSTRUCTIONS.items():
        made.append(["reconstruct", str(folder / f"{measurement}.nc"), "-o", str(folder / name), *how, *FIT])
    return made


def run(source: Path, folder: Path) -> None:
    """Make all measurements and reconstructions with the package in `source`."""
    folder.mkdir()
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    environment = os.environ | threads | {name: str(folder / to) for name, to in WRITTEN.items()}
    environment["PYTHONPATH"] = str(source)
    for arguments in commands(folder):
        command = [sys.executable, "-m", "nerif", *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{source}: nerif {' '.join(arguments)}\n{done.stderr}")


def of_clock(row: dict[str, str]) -> bool:
    """Return whether a record of a training is there because five seconds have passed, not for its step."""
    return bool(row.get("rays_per_second")) and float(row["step"]) % 20 > 1


def numbers(folder: Path) -> dict[str, np.ndarray]:
    """Return every array of the NetCDF files and every column of the histories, but the times."""
    arrays: dict[str, np.ndarray] = {}
    for path in sorted(folder.rglob("*.nc")):
        with h5py.File(path) as file:
            leaf: dict[str, np.ndarray] = {}
            file.visititems(lambda n, d, leaf=leaf: leaf.update({n: d[()]}) if isinstance(d, h5py.Dataset) else None)
        arrays |= {f"{path.relative_to(folder)}: {name}": value for name, value in leaf.items()}
    for path in sorted(folder.rglob("history.csv")):
        with path.open() as file:
            rows = [row for row in csv.DictReader(file) if not of_clock(row)]
        for column in rows[0]:
            if column not in TIMES:
                values = np.array([float(row[column] or "nan") for row in rows])
                arrays[f"{path.relative_to(folder)}: {column}"] = values
    return arrays


def differences(before: dict[str, np.ndarray], after: dict[str, np.ndarray]) -> list[str]:
    """Return what differs, a line each."""
    lines = [f"{name}: only in one of the two" for name in sorted(before.keys() ^ after.keys())]
    for name in sorted(before.keys() & after.keys()):
        a, b = before[name], after[name]
        if a.dtype != b.dtype or a.shape != b.shape:
            lines.append(f"{name}: {a.dtype} {a.shape} became {b.dtype} {b.shape}")
        elif name.endswith(POSES) and np.allclose(a, b, rtol=1e-10, atol=1e-12):
            continue
        elif a.tobytes() != b.tobytes() and not (a.dtype.kind == "O" and np.array_equal(a, b)):
            lines.append(f"{name}: values differ")
    return lines


def main() -> None:
    """Run both, print what differs, and exit 1 if anything does."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("revision", help="commit to compare with")
    revision = parser.parse_args().revision
    with tempfile.TemporaryDirectory() as directory:
        other = Path(directory) / "other"
        subprocess.run(["git", "worktree", "add", "-q", "--detach", str(other), revision], cwd=ROOT, check=True)
        try:
            run(other / "src", Path(directory) / "before")
            run(ROOT / "src", Path(directory) / "after")
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(other)], cwd=ROOT, check=True)
        before, after = numbers(Path(directory) / "before"), numbers(Path(directory) / "after")
    lines = differences(before, after)
    print(f"{len(before)} arrays of {len(RECONSTRUCTIONS)} reconstructions at {revision}, {len(lines)} of them differ")
    print("\n".join(lines), end="\n" if lines else "")
    sys.exit(1 if lines else 0)


if __name__ == "__main__":
    main()
