"""One flame seen by rigs with one fault each: how far a reconstruction comes that knows of it, and one that does not.

    python benchmarks/rigs.py ../shared/data/rigs --write benchmarks/results/rigs-cpu.md

The folder holds measurement files and truth.nc (index excess on voxels), made by others; the row `images` renders its
own, of 200² px through lenses at f/8 (images.py). Each row is a process of its own, alone on the machine.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import images
from bench import Table, add_write, alone
from nerif.reconstruction.shared_settings import Aperture, Source

IMAGES = "images"
GOALS = {"thin": None, "f16": 0.0045, "f8": 0.0060, "f4": 0.015, "window6": None, IMAGES: 0.012}
"""Rigs in the order of the table, and the L2 that NeRIF is to reach on them in 90 s."""
REFINED: dict[str, tuple[tuple[str, ...], float | None, float | None]] = {
    "thin": (("cameras", "shift"), None, None),
    "pose_small": (("cameras",), 0.008, 0.005),
    "pose_large": (("cameras",), 0.014, 0.0065),
    "offset": (("shift",), 0.0045, None),
    "all": (("cameras", "shift"), None, 0.01),
}
"""What is refined of a rig, and the L2 to reach so in 90 s, before and after the best rigid motion of the field."""


@dataclass(frozen=True)
class Way:
    """How a measurement is taken: what its lenses count as, what is refined, what the field is found from."""

    aperture: Aperture = "auto"
    refine: tuple[str, ...] = ()
    source: Source = "displacements"


def ways(name: str, method: str) -> list[Way]:
    """Return the ways in which a rig is reconstructed, those that know of its fault first."""
    if name == IMAGES:
        return [Way(source="images"), Way()]
    found = [Way(), *([Way("off")] if name.startswith(("f", "window")) else [])]
    return found + ([Way(refine=REFINED[name][0])] if name in REFINED and method == "nerif" else [])


def goals(name: str, method: str, way: Way) -> tuple[float | None, float | None]:
    """Return the L2 that is to be reached, and that after the best rigid motion."""
    if method != "nerif" or way.aperture != "auto" or (name == IMAGES and way.source != IMAGES):
        return None, None
    return REFINED[name][1:] if way.refine else (GOALS.get(name), None)


def run(path: Path, method: str, way: Way, seconds: float, seed: int) -> dict[str, Any]:
    """Reconstruct a file, and compare with the truth beside it."""
    from nerif.analysis.alignment import aligned
    from nerif.analysis.evaluation import evaluate_views, evaluate_volume
    from nerif.analysis.prediction import reproject
    from nerif.data.measurement import Measurement
    from nerif.data.volume_file import read_volume
    from nerif.reconstruction.aperture import seen_through
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF
    from nerif.reconstruction.rig.parameters import with_corrections
    from nerif.reconstruction.sources import of_source
    from nerif.reconstruction.voxels.total_variation import TotalVariation

    keep_freed_memory()
    measurement = Measurement.read(path)
    if method == "nerif":
        settings = NeRIF(time_limit=seconds, epochs=1e9, seed=seed, aperture=way.aperture, refine=way.refine)
        result = replace(settings, source=way.source, device="cpu")(measurement)
    else:
        result = TotalVariation(aperture=way.aperture, source=way.source, device="cpu")(measurement)
    truth = read_volume(path.with_name("truth.nc"))
    scores = evaluate_volume(result.field, truth, measurement.n_ambient)
    moved = evaluate_volume(aligned(result.field, truth), truth, measurement.n_ambient)
    seen = seen_through(of_source(measurement, way.source), way.aperture)
    views = evaluate_views(reproject(result.field, with_corrections(seen, result.rig)))
    worst = max(view["rms_over_sigma"] for view in views)
    steps = result.history[-1].get("step", len(result.history)) if result.history else 0
    return {"l2": scores["l2"], "aligned": moved["l2"], "seconds": result.seconds, "worst": worst, "steps": int(steps)}


def cells(name: str, method: str, way: Way, found: dict[str, float]) -> list[str]:
    """Return the row of what was found, its goals beside it."""
    before, after = ("" if goal is None else f"{goal:.2%}" for goal in goals(name, method, way))
    lensed = name == IMAGES or name.startswith(("f", "window"))
    known = {"auto": "known", "off": "off"}[way.aperture] if lensed else "-"
    shown = f"{name}, from {way.source}" if name == IMAGES else name
    errors = [f"{found['l2']:.3%}", before, f"{found['aligned']:.3%}", after, f"{found['worst']:.2f}"]
    run = [f"{found['steps']:.0f}", f"{found['seconds']:.0f}"]
    return [shown, method, known, " ".join(way.refine) or "-", *errors, *run]


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
    with tempfile.TemporaryDirectory() as folder:
        for name in asked.only:
            path = asked.rigs / f"{name}.nc"
            if name == IMAGES:
                path = Path(folder) / "correlation.nc"
                images.photographed(images.CASES["200², f/8"], path.parent)
            for method in asked.methods:
                for way in ways(name, method):
                    seeds = asked.seeds if method == "nerif" else asked.seeds[:1]
                    found = [alone(run, path, method, way, asked.seconds, seed) for seed in seeds]
                    middle = {key: statistics.median(one[key] for one in found) for key in found[0]}
                    table.row(cells(name, method, way, middle))


if __name__ == "__main__":
    main()
