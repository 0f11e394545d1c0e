"""The ensemble of nerif reconstruct: its members one by one, each kept as soon as it is done, and their spread."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch

from nerif.commands.methods import Reconstruct
from nerif.commands.output import interruptible, progress_bar, say
from nerif.commands.result_files import ENSEMBLE, all_quantities, write_volumes
from nerif.conventions import InputError
from nerif.evaluation import evaluate_views, reproject, update_json
from nerif.measurement import Measurement
from nerif.reconstruction.base import Outcome, Reconstruction, compose
from nerif.reconstruction.ensemble import Ensemble, Spread
from nerif.reconstruction.files import FIELD, read_field, write_field
from nerif.report.result import METRICS

__all__ = ["add_ensemble"]


def add_ensemble(settings: Reconstruct, measurement: Measurement, training: Measurement, main: Reconstruction) -> None:
    """Reconstruct the members, and write mean and standard deviation of every quantity beside the main result.

    Members that an interrupted run has left are not done again. An interruption leaves those done so far.
    """
    ensemble = Ensemble(settings.ensemble, settings.leave_one_out)
    noise, source = _noise(training, main)
    spread, left_out, started = Spread(), [], time.monotonic()
    for number in range(1, ensemble.members + 1):
        result = _member(settings, ensemble, number, training, noise)
        if result is None:
            say(f"ensemble: interrupted after {spread.count} of {ensemble.members} members; --resume goes on")
            break
        spread.add(all_quantities(settings, result))
        out = ensemble.left_out(number, training)
        if out:
            left_out += evaluate_views(reproject(result.field, training.select(out), out, result.device))
    if spread.count < 2:
        return
    write_volumes(settings.out, [*all_quantities(settings, main), *spread.volumes()])
    about: dict[str, Any] = {
        "members": spread.count, "noise": source, "leave_one_out": ensemble.leave_one_out, "left_out": left_out,
        "seconds": time.monotonic() - started,
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
    rms = [v["rms_px"] for v in evaluate_views(reproject(main.field, training, (), main.device))]
    say("ensemble: the measurement has no sigma; noise of the size of each view's rms residual is added")
    return torch.tensor(rms)[:, None, None, None].expand(training.displacement.shape).clone(), "rms residual"


def _member(
    settings: Reconstruct, ensemble: Ensemble, number: int, training: Measurement, noise: torch.Tensor
) -> Reconstruction | None:
    """One member: read if it is there already, else reconstructed; None if interrupted on the way."""
    folder: Path = settings.out / ENSEMBLE / f"{number:02d}"
    if (folder / FIELD).is_file():
        try:
            field, box, n_ambient = read_field(folder)
            kept = Outcome("converged", "read from disc")
            return Reconstruction(field, box, n_ambient, [], kept, {}, device="cpu")
        except InputError as error:
            say(f"{error}; this member is done again")
    reconstructor, noisy = ensemble.member(number, settings.reconstructor, training, noise)
    out = "".join(f", without {name}" for name in ensemble.left_out(number, training))
    title = f"member {number} of {ensemble.members}{out}"
    with interruptible() as asked, progress_bar(title) as bar:
        result = reconstructor(noisy, compose(bar, lambda _: asked[0]))  # type: ignore[arg-type]
    if result.outcome.reason == "interrupted":
        return None
    folder.mkdir(parents=True, exist_ok=True)
    write_field(folder, result)
    return result
