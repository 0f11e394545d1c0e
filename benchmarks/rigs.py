"""One flame seen by rigs with one fault each: how far a reconstruction comes that knows of it, and one that does not.

    python benchmarks/rigs.py ../shared/data/rigs --write benchmarks/results/rigs-cpu.md

The folder holds measurement files and truth.nc (index excess on voxels), made by others. Each row is a process of its
own, alone on the machine.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

from bench import Table, add_write, alone

GOALS = {"thin": None, "f16": 0.0045, "f8": 0.0060, "f4": 0.015, "window6": None}
"""Rigs in the order of the table, and the L2 that NeRIF is to reach on them in 90 s."""
REFINED: dict[str, tuple[tuple[str, ...], float | None, float | None]] = {
    "thin": (("cameras", "shift"), None, None),
    "pose_small": (("cameras",), 0.008, 0.005),
    "pose_large": (("cameras",), 0.014, 0.0065),
    "offset": (("shift",), 0.0045, None),
    "all": (("cameras", "shift"), None, 0.01),
}
"""What is refined of a rig, and the L2 to reach so in 90 s, before and after the best rigid motion of the field."""


def run(path: Path, method: str, aperture: str, seconds: float, seed: int, refine: tuple[str, ...]) -> dict[str, Any]:
    """Reconstruct a file, and compare with the truth beside it."""
    from nerif.alignment import aligned
    from nerif.evaluation import evaluate_views, evaluate_volume
    from nerif.measurement import Measurement
    from nerif.prediction import reproject
    from nerif.reconstruction.aperture import seen_through
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural import NeRIF
    from nerif.reconstruction.refined_rig import with_corrections
    from nerif.reconstruction.total_variation import TotalVariation
    from nerif.volume_file import read_volume

    keep_freed_memory()
    measurement = Measurement.read(path)
    if method == "nerif":
        result = NeRIF(time_limit=seconds, epochs=1e9, seed=seed, aperture=aperture, refine=refine, device="cpu")(
            measurement
        )
    else:
        result = TotalVariation(aperture=aperture, device="cpu")(measurement)
    truth = read_volume(path.with_name("truth.nc"))
    scores = evaluate_volume(result.field, truth, measurement.n_ambient)
    moved = evaluate_volume(aligned(result.field, truth), truth, measurement.n_ambient)
    views = evaluate_views(reproject(result.field, with_corrections(seen_through(measurement, aperture), result.rig)))
    worst = max(view["rms_over_sigma"] for view in views)
    steps = result.history[-1].get("step", len(result.history)) if result.history else 0
    return {"l2": scores["l2"], "aligned": moved["l2"], "seconds": result.seconds, "worst": worst, "steps": int(steps)}


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("rigs", type=Path, help="folder with the measurement files and truth.nc")
    parser.add_argument("--only", nargs="+", default=list(GOALS | REFINED), help="some of the rigs")
    parser.add_argument("--methods", nargs="+", default=["nerif", "tv"], choices=["nerif", "tv"])
    parser.add_argument("--seconds", type=float, default=90.0, help="of training of NeRIF")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    add_write(parser)
    asked = parser.parse_args()
    columns = ["rig", "method", "lens, window", "refined", "L2", "goal", "L2 aligned", "goal"]
    columns += ["worst view, sigma", "steps", "s"]
    more = f"\n\nNeRIF trains for {asked.seconds:g} s; total variation by its defaults; medians of seeds."
    table = Table("Rigs with one fault each", columns, asked.write, more)
    for name in asked.only:
        path, lensed = asked.rigs / f"{name}.nc", name.startswith(("f", "window"))
        for method in asked.methods:
            ways: list[tuple[str, tuple[str, ...]]] = [("auto", ())]
            ways += [("off", ())] if lensed else []
            ways += [("auto", REFINED[name][0])] if name in REFINED and method == "nerif" else []
            for aperture, refine in ways:
                seeds = asked.seeds if method == "nerif" else asked.seeds[:1]
                found = [alone(run, path, method, aperture, asked.seconds, seed, refine) for seed in seeds]
                middle = {key: statistics.median(one[key] for one in found) for key in found[0]}
                goals = REFINED[name][1:] if refine else (GOALS.get(name), None)
                goals = goals if method == "nerif" and aperture == "auto" else (None, None)
                before, after = ("" if goal is None else f"{goal:.2%}" for goal in goals)
                known = "-" if not lensed else {"auto": "known", "off": "off"}[aperture]
                table.row(
                    [name, method, known, " ".join(refine) or "-", f"{middle['l2']:.3%}", before,
                     f"{middle['aligned']:.3%}", after, f"{middle['worst']:.2f}", f"{middle['steps']:.0f}",
                     f"{middle['seconds']:.0f}"]
                )  # fmt: skip


if __name__ == "__main__":
    main()
