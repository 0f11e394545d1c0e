"""What it costs to keep a view out first (nerif reconstruct --withhold auto, the default), and what it does to fields.

    python benchmarks/cross_validation.py ../shared/data/rigs --write benchmarks/results/cross-validation-cpu.md

Each file is reconstructed without it and with it; everything is counted in that the command does.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from bench import Table, add_write, alone
from nerif.common.conventions import InputError


def run(path: Path, truth: Path, method: str, limit: float, withhold: str) -> tuple[float, float, float, float]:
    """Return L2, seconds, and how far off the view was predicted, before and in the end, in sigma; NaN where not."""
    from nerif.analysis.evaluation import evaluate
    from nerif.reconstruction.base import Reconstructor
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF
    from nerif.reconstruction.voxels.total_variation import TotalVariation
    from nerif.results.directory import ResultDirectory
    from nerif.workflow.job import Run
    from nerif.workflow.pipeline import reconstruct_into

    keep_freed_memory()
    settings: Reconstructor = TotalVariation(voxels=48, device="cpu")
    if method == "nerif":
        settings = NeRIF(time_limit=limit, device="cpu")
    with tempfile.TemporaryDirectory() as folder:
        out, started = Path(folder) / "r", time.perf_counter()
        reconstruct_into(out, path, settings, Run(withhold=(withhold,), report=False), voxels=64)
        seconds = time.perf_counter() - started
        metrics = ResultDirectory(out).metrics()
        found = evaluate(out, truth=truth)
    views = (metrics.get("cross_validation") or {}).get("views") or []
    before = views[0]["rms_over_sigma"] if views else float("nan")
    after = [v["rms_over_sigma"] for v in metrics["views"] if views and v["name"] == views[0]["name"]]
    return found["l2"], seconds, before, after[0] if after else float("nan")


def main() -> None:
    """Run the files and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("rigs", type=Path, help="folder with measurement files and truth.nc")
    parser.add_argument("--files", nargs="+", default=["thin", "f8", "pose_small"])
    parser.add_argument("--methods", nargs="+", default=["nerif", "tv"], choices=["nerif", "tv"])
    parser.add_argument("--time-limit", type=float, default=45.0, help="of NeRIF, s")
    add_write(parser)
    asked = parser.parse_args()
    if not (asked.rigs / "truth.nc").is_file():
        raise InputError(f"{asked.rigs}: expected a folder with truth.nc")
    head = (
        "file",
        "method",
        "L2, none kept out",
        "seconds",
        "L2, one first",
        "seconds",
        "longer",
        "the view before",
        "after",
    )
    table = Table("A view that is kept out first", head, asked.write)
    for name in asked.files:
        for method in asked.methods:
            path, truth = asked.rigs / f"{name}.nc", asked.rigs / "truth.nc"
            plain = alone(run, path, truth, method, asked.time_limit, "none")
            first = alone(run, path, truth, method, asked.time_limit, "auto")
            cells = [f"{plain[0]:.3%}", f"{plain[1]:.0f}", f"{first[0]:.3%}", f"{first[1]:.0f}"]
            table.row(
                [name, method, *cells, f"{first[1] / plain[1]:.2f}", f"{first[2]:.2f} sigma", f"{first[3]:.2f} sigma"]
            )


if __name__ == "__main__":
    main()
