"""The ensemble of nerif reconstruct: its members one by one, each kept as soon as it is done, and their spread."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch

from nerif.commands.methods import Reconstruct
from nerif.commands.output import interruptible, progress_bar, say
from nerif.commands.result_files import ENSEMBLE, all_quantities, write_volumes
from nerif.conventions import InputError
from nerif.evaluation import evaluate_views, reproject, update_json
from nerif.fields.base import Field
from nerif.measurement import Measurement
from nerif.reconstruction.base import Outcome, Reconstruction, Reconstructor, compose
from nerif.reconstruction.ensemble import Ensemble, Spread
from nerif.reconstruction.files import FIELD, read_field, write_field
from nerif.report.result import METRICS

__all__ = ["add_ensemble"]

ASKED = "asked.json"


def add_ensemble(
    settings: Reconstruct, training: Measurement, main: Reconstruction, start: Field | None = None
) -> None:
    """Reconstruct the members, and write mean and standard deviation of every quantity beside the main result.

    Members that an interrupted run of the same settings has left are not done again. An interruption leaves those done
    so far. A member that diverges is left out, and told.
    """
    ensemble = Ensemble(settings.ensemble, settings.leave_one_out)
    noise, source = _noise(training, main)
    spread, left_out, diverged, started = Spread(), [], [], time.monotonic()
    for number in range(1, ensemble.members + 1):
        result = _member(settings, ensemble, number, training, noise, start)
        if result.outcome.reason == "interrupted":
            say(f"ensemble: interrupted after {spread.count} of {ensemble.members} members; --resume goes on")
            break
        if result.outcome.failed:
            say(f"ensemble: member {number} {result.outcome.reason} and is left out: {result.outcome.message}")
            diverged.append(number)
            continue
        spread.add(all_quantities(settings, result))
        out = ensemble.left_out(number, training)
        if out:
            left_out += _compared(result, training.select(out), out)
    if spread.count < 2:
        say(f"ensemble: {spread.count} members are too few for a standard deviation; none is written")
        return
    write_volumes(settings.out, [*all_quantities(settings, main), *spread.volumes()])
    about: dict[str, Any] = {
        "members": spread.count, "diverged": diverged, "noise": source, "leave_one_out": ensemble.leave_one_out,
        "left_out": left_out, "seconds": time.monotonic() - started,
    }  # fmt: skip
    update_json(settings.out / METRICS, {"ensemble": about})
    excess = next(v for v in spread.volumes() if v.quantity == "index_excess_std")
    largest = float(main.volume(excess.grid).values.abs().max())
    rms = float(excess.values.square().mean().sqrt())
    say(f"ensemble of {spread.count}: rms standard deviation of n {rms:.3g}, {rms / largest:.2%} of the largest excess")
    for v in left_out:
        say(f"left out {v['name']}: CC {v['cc']:.4f}, rms error {v['rms_px']:.4f} px")


def _noise(training: Measurement, main: Reconstruction) -> tuple[torch.Tensor, str]:
    """Standard deviation of the noise of every pixel, px: that of the file, else the rms residual of each view."""
    if training.sigma is not None:
        return training.sigma.nan_to_num(0.0, 0.0, 0.0), "sigma of the measurement"
    rms = torch.tensor([v["rms_px"] for v in _compared(main, training)])
    say("ensemble: the measurement has no sigma; noise of the size of each view's rms residual is added")
    # NaN for a view of which no ray crosses the box
    return rms.nan_to_num(0.0)[:, None, None, None].expand(training.displacement.shape).clone(), "rms residual"


def _compared(result: Reconstruction, data: Measurement, held_out: Collection[str] = ()) -> list[dict[str, Any]]:
    """How well the views of some data are predicted."""
    return evaluate_views(reproject(result.field, data, held_out, result.device, model=result.model))


def _member(
    settings: Reconstruct,
    ensemble: Ensemble,
    number: int,
    training: Measurement,
    noise: torch.Tensor,
    start: Field | None,
) -> Reconstruction:
    """One member: read if it is there already, made by the same settings from the same data; else reconstructed."""
    folder: Path = settings.out / ENSEMBLE / f"{number:02d}"
    reconstructor, noisy = ensemble.member(number, settings.reconstructor, training, noise)
    asked_for = _fingerprint(settings, reconstructor, noisy)
    if (folder / FIELD).is_file() and (folder / ASKED).is_file() and (folder / ASKED).read_text() == asked_for:
        try:
            field, box, n_ambient = read_field(folder)
            kept = Outcome("converged", "read from disc")
            return Reconstruction(field, box, n_ambient, [], kept, dataclasses.asdict(reconstructor), device="cpu")  # type: ignore[call-overload]
        except InputError as error:
            say(f"{error}; this member is done again")
    out = "".join(f", without {name}" for name in ensemble.left_out(number, training))
    title = f"member {number} of {ensemble.members}{out}"
    with interruptible() as asked, progress_bar(title) as bar:
        result = reconstructor(noisy, compose(bar, lambda _: asked[0]), None, start)  # type: ignore[arg-type]
    if result.outcome.reason != "interrupted" and not result.outcome.failed:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ASKED).unlink(missing_ok=True)
        write_field(folder, result)
        (folder / ASKED).write_text(asked_for)
    return result


def _fingerprint(settings: Reconstruct, reconstructor: Reconstructor, data: Measurement) -> str:
    """What a member was made by and from, as text: another one of either gives another text."""
    seen = hashlib.sha256()
    for values in (data.displacement, data.sigma, data.usable):
        if values is not None:
            seen.update(values.contiguous().numpy().tobytes())
    asked = {
        "views": data.names,
        "data": seen.hexdigest(),
        "start_from": str(settings.start_from),
        **dataclasses.asdict(reconstructor),  # type: ignore[call-overload]
    }
    return json.dumps(asked, indent=1, default=str) + "\n"
