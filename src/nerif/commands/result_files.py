"""What a result directory holds, and how nerif reconstruct fills it."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from nerif import __version__
from nerif.atomic import atomic
from nerif.commands.methods import Reconstruct
from nerif.commands.output import counting_bar, say, say_masked
from nerif.commands.settings import to_toml
from nerif.evaluation import evaluate_views, reproject, write_json
from nerif.geometry import Grid
from nerif.measurement import Measurement
from nerif.physics.quantities import derive
from nerif.reconstruction.base import Reconstruction
from nerif.reconstruction.files import CHECKPOINT, FIELD, write_field, write_state
from nerif.report.exports import export
from nerif.report.result import FIGURES, HISTORY, METRICS, REPORT, RUN, VOLUME
from nerif.reprojection import REPROJECTION
from nerif.volume import Volume

__all__ = ["ENSEMBLE", "all_quantities", "clear", "run_toml", "versions", "write_result", "write_volumes"]

ENSEMBLE = "ensemble"
OWN_FILES = (RUN, METRICS, HISTORY, FIELD, CHECKPOINT, VOLUME, "volume.vti", REPROJECTION, REPORT)


def clear(directory: Path) -> None:
    """Remove what an earlier run has written there, and nothing else."""
    for name in OWN_FILES:
        (directory / name).unlink(missing_ok=True)
    for name in (ENSEMBLE, FIGURES):
        shutil.rmtree(directory / name, ignore_errors=True)


def run_toml(settings: Reconstruct, about: dict[str, Any] | None = None) -> str:
    """Settings that repeat the run, as TOML; `about` tells what came out."""
    kept = replace(settings, force=False, resume=False, config=None, measurement=settings.measurement.resolve())
    if kept.start_from is not None:
        kept = replace(kept, start_from=kept.start_from.resolve())
    head = "# nerif reconstruct --config run.toml -o OTHER repeats this run\n"
    return head + to_toml(kept, {"nerif": __version__, **(about or {})})


def write_result(settings: Reconstruct, measurement: Measurement, result: Reconstruction) -> None:
    """Write the result directory; the field first, it is the costliest."""
    out = settings.out
    write_field(out, result)
    if result.state is not None:
        write_state(out, result.state)
    _write_history(out / HISTORY, result.history)
    with counting_bar("re-projecting", len(measurement.cameras)) as bar:
        reprojection = reproject(result.field, measurement, settings.hold_out, result.device, bar, result.model)
    reprojection.write(out / REPROJECTION)
    views = evaluate_views(reprojection)
    write_json(  # afresh: scores of an earlier field must not stay
        out / METRICS,
        {
            "views": views,
            "seconds": result.seconds,
            "peak_memory_bytes": result.peak_memory_bytes,
            "device": result.device,
            "outcome": result.outcome.reason,
            "message": result.outcome.message,
            "measurement": str(settings.measurement.resolve()),
        },
    )
    about = {**versions(), "outcome": result.outcome.reason, "seconds": round(result.seconds, 3)}
    with atomic(out / RUN) as part:
        part.write_text(run_toml(settings, about))
    write_volumes(out, all_quantities(settings, result))
    for group, held in (("training view", False), ("held-out view", True)):
        chosen = [v for v in views if v["held_out"] is held]
        if chosen:
            cc = min(v["cc"] for v in chosen)
            rms = max(v["rms_px"] for v in chosen)
            noise = max(v.get("rms_over_sigma", float("nan")) for v in chosen)
            beside = "" if noise != noise else f", at most {noise:.2f} sigma"
            plural = "s" if len(chosen) > 1 else ""
            say(f"{len(chosen)} {group}{plural}: CC at least {cc:.4f}, rms error at most {rms:.4f} px{beside}")
    say(f"{out}: result of {result.seconds:.0f} s on {result.device}; open {out / 'volume.vti'} in ParaView")


def versions() -> dict[str, str]:
    """When and with what it was done."""
    import platform

    import numpy as np
    import torch

    return {
        "finished": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "machine": f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads",
    }


def all_quantities(settings: Reconstruct, result: Reconstruction) -> list[Volume]:
    """Sample a reconstruction as index excess, n, density and temperature."""
    excess = result.volume(Grid.of_resolution(result.box, settings.volume_voxels))
    return [derive(excess, quantity, settings.gas) for quantity in ("index_excess", "n", "density", "temperature")]


def write_volumes(directory: Path, volumes: list[Volume]) -> None:
    """Write volume.nc and volume.vti, and say what is masked."""
    for name in (VOLUME, "volume.vti"):
        export(directory / name, volumes)
    say_masked(volumes)


def _write_history(path: Path, history: list[dict[str, float]]) -> None:
    columns = list(dict.fromkeys(key for record in history for key in record))
    with atomic(path) as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(history)
