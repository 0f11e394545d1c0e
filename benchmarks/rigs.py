"""Rigs with one fault each.

Measurements of a flame simulated by other code, each with one fault of the rig, reconstructed with and without
allowing for it, and with refinement of the cameras. The files and truth.nc (index excess on voxels) lie in
`folder_of_rigs` (`--set folder_of_rigs=PATH`, relative to the repository); rig "images" renders its own, 200² px
through lenses at f/8 (images.py). NeRIF trains for 90 s. Aligned: after the best rigid motion of the field. Goals are
L2 as stated in docs/refinement.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.images import photographed
from benchmarks.runner import ROOT, Settings, Unavailable
from nerif.analysis.alignment import aligned
from nerif.analysis.evaluation import evaluate_views, evaluate_volume
from nerif.analysis.prediction import reproject
from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.rig_parameters import with_corrections
from nerif.reconstruction.shared_settings import Aperture, Source
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.voxels.total_variation import TotalVariation

IMAGES = "images"
GOALS = {"thin": None, "f16": 0.0045, "f8": 0.0060, "f4": 0.015, "window6": None, IMAGES: 0.012}
"""Rigs and the L2 that NeRIF should reach on them in 90 s."""
REFINED: dict[str, tuple[str, float | None, float | None]] = {
    "thin": ("cameras shift", None, None),
    "pose_small": ("cameras", 0.008, 0.005),
    "pose_large": ("cameras", 0.014, 0.0065),
    "offset": ("shift", 0.0045, None),
    "all": ("cameras shift", None, 0.01),
}
"""What is refined, and the L2 to reach with it in 90 s, before and after alignment."""
COLUMNS = {
    "rig": "{rig}", "from": "{source}", "method": "{method}", "aperture": "{aperture}", "refined": "{refine}",
    "L2": "{l2:.3%}", "goal": "{goal:.2%}", "L2 aligned": "{aligned:.3%}", "goal, aligned": "{goal_aligned:.2%}",
    "worst view, sigma": "{worst:.2f}", "steps": "{steps:.0f}", "seconds": "{time:.0f}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    case = {"seconds": 90.0, "seed": 0, "folder_of_rigs": "../shared/data/rigs"}
    case |= {"pixels": 200, "f_number": 8.0, "truth_voxels": 100}  # of the rig "images"
    default = {"aperture": "auto", "refine": "", "source": "displacements"}
    if quick:
        yield case | default | {"rig": IMAGES, "method": "nerif"} | {
            "seconds": 3.0, "pixels": 24, "f_number": 0.0, "truth_voxels": 24,
        }  # fmt: skip
        return
    for rig in GOALS | REFINED:
        for method in ("nerif", "tv"):
            base = case | default | {"rig": rig, "method": method}
            if rig == IMAGES:
                yield base | {"source": IMAGES}
            yield base
            if rig.startswith(("f", "window")):
                yield base | {"aperture": "off"}
            if rig in REFINED and method == "nerif":
                yield base | {"refine": REFINED[rig][0]}


def measure(
    folder: Path, rig: str, method: str, aperture: Aperture, refine: str, source: Source, seconds: float, pixels: int,
    f_number: float, seed: int, truth_voxels: int, folder_of_rigs: str,
) -> dict[str, Any]:  # fmt: skip
    path = ROOT / folder_of_rigs / f"{rig}.nc"
    if rig == IMAGES:
        path = photographed(folder, pixels, f_number, "dots", 3.0, 0.0, 0.0, truth_voxels) / "correlation.nc"
    elif not path.is_file():
        raise Unavailable(f"no {rig}.nc in {folder_of_rigs}")
    measurement = Measurement.read(path)
    if method == "nerif":
        refined = tuple(refine.split())
        settings = NeRIF(time_limit=seconds, epochs=1e9, seed=seed, aperture=aperture, refine=refined)
        result = replace(settings, source=source, device="cpu")(measurement)
    else:
        result = TotalVariation(aperture=aperture, source=source, device="cpu")(measurement)
    truth = read_volume(path.with_name("truth.nc"))
    through = apply_aperture(of_source(measurement, source), aperture)
    views = evaluate_views(reproject(result.field, with_corrections(through, result.rig)))
    return {
        "l2": evaluate_volume(result.field, truth, measurement.n_ambient)["l2"],
        "aligned": evaluate_volume(aligned(result.field, truth), truth, measurement.n_ambient)["l2"],
        "worst": max(view["rms_over_sigma"] for view in views),
        "steps": int(result.history[-1].get("step", len(result.history))) if result.history else 0,
        "time": result.seconds,
    }


def derive(rows: list[dict[str, Any]]) -> None:
    for row in rows:
        if (
            row["method"] == "nerif"
            and row["aperture"] == "auto"
            and (row["rig"], row["source"]) != (IMAGES, "displacements")
        ):
            refined = REFINED[row["rig"]][1:] if row["refine"] else (GOALS.get(row["rig"]), None)
            row["goal"], row["goal_aligned"] = refined
