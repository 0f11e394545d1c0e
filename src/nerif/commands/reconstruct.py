"""nerif reconstruct: from a measurement file to a result directory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import tyro

from nerif.atomic import atomic
from nerif.commands.members import add_ensemble
from nerif.commands.methods import METHODS, Reconstruct
from nerif.commands.output import check_directory, interruptible, progress_bar, say
from nerif.commands.report import write_report
from nerif.commands.result_files import clear, run_toml, write_result
from nerif.commands.settings import flag_value, read_settings, value_given
from nerif.conventions import InputError
from nerif.fields.base import Field
from nerif.geometry import Grid
from nerif.measurement import Measurement
from nerif.physics.quantities import GasSettings, derive
from nerif.reconstruction.base import OnStep, Reconstruction, Step, compose
from nerif.reconstruction.ensemble import Ensemble
from nerif.reconstruction.files import checkpoints, read_field, read_state
from nerif.reconstruction.parallel import Ranks
from nerif.reconstruction.presets import preset
from nerif.report.result import RUN
from nerif.volume import Volume

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractContextManager

__all__ = ["main", "run"]


def run(settings: Reconstruct) -> Reconstruction:
    """Reconstruct, and write everything that docs/formats.md lists."""
    if settings.volume_voxels < 1:
        raise InputError(f"voxels: expected at least 1, got {settings.volume_voxels}")
    measurement = Measurement.read(settings.measurement)
    training = _without(measurement, settings.hold_out)
    if settings.ensemble:
        Ensemble(settings.ensemble)  # refuses a wrong number before the long work
        if settings.leave_one_out and len(training.cameras) < 2:
            raise InputError("leave_one_out: expected two training views or more, got one, which cannot be left out")
    elif settings.leave_one_out:
        raise InputError("leave_one_out: expected together with --ensemble K, got no ensemble")
    if measurement.wavelength_nm is not None:
        settings = replace(settings, gas=replace(settings.gas, wavelength_nm=measurement.wavelength_nm))
    derive_check(settings.gas, measurement)
    if measurement.bad_pixels:
        say(f"{settings.measurement}: {measurement.bad_pixels} pixels left out whose displacement or sigma is NaN, infinite or impossible")
    resume = read_state(settings.out) if settings.resume else None
    start = _start(settings, measurement) if resume is None else None
    if not settings.resume:
        check_directory(settings.out, settings.force)
    ranks = Ranks.from_environment()
    if ranks.size > 1:
        check_parallel(settings)
    if not ranks.is_first:  # under torchrun the first process tells, and writes
        with interruptible():
            return settings.reconstructor(training, None, resume, start)
    begin = _begin(settings)
    with (
        interruptible() as asked,
        _scalars(settings) as scalars,
        progress_bar("training" if settings.method == "nerif" else "solving") as bar,
    ):
        keep = checkpoints(settings.out, settings.checkpoint_every)
        callbacks: list[OnStep] = [begin, bar, keep, lambda _: asked[0], *scalars]  # type: ignore[list-item]
        result = settings.reconstructor(training, compose(*callbacks), resume, start)
    say(f"{result.outcome.reason}: {result.outcome.message}")
    begin(None)
    write_result(settings, measurement, result)
    try:
        if settings.ensemble and result.outcome.reason != "interrupted":
            add_ensemble(settings, training, result, _start(settings, measurement))
    finally:  # the page of the main result, whatever becomes of the members
        if settings.report:
            write_report(settings.out)
    return result


def check_parallel(settings: Reconstruct) -> None:
    """Refuse what does not split its rays over the processes of torchrun."""
    if settings.method != "nerif":
        raise InputError(f"method: expected nerif under torchrun, got '{settings.method}', which runs in one process")
    if settings.ensemble:
        raise InputError("ensemble: expected none under torchrun; run the ensemble in one process")


def _without(measurement: Measurement, names: tuple[str, ...]) -> Measurement:
    for name in names:
        if name not in measurement.names:
            raise InputError(f"hold_out: expected views out of {', '.join(measurement.names)}, got '{name}'")
    kept = [name for name in measurement.names if name not in names]
    if not kept:
        raise InputError("hold_out: every view is held out, so none is left to reconstruct from")
    return measurement.select(kept)


def _start(settings: Reconstruct, measurement: Measurement) -> Field | None:
    """The field to start from, if one is named."""
    if settings.start_from is None:
        return None
    start, box, _ = read_field(settings.start_from)
    if box != measurement.box:
        raise InputError(
            f"{settings.start_from}: expected a reconstruction in the box of the measurement, "
            f"{measurement.box.lower} to {measurement.box.upper} mm, got {box.lower} to {box.upper}"
        )
    return start


def derive_check(gas: GasSettings, measurement: Measurement) -> None:
    """Refuse what density and temperature cannot be computed from before the long work, not after it."""
    grid = Grid(measurement.box, (1, 1, 1))
    ambient = Volume(torch.zeros(grid.shape), grid, attributes={"n_ambient": measurement.n_ambient})
    derive(ambient, "temperature", gas)


def _begin(settings: Reconstruct) -> Callable[[Step | None], None]:
    """Make the directory ready once the first step is done: input that is refused before leaves an old result alone."""
    done: list[bool] = []

    def prepare(step: Step | None) -> None:
        if done:
            return
        settings.out.mkdir(parents=True, exist_ok=True)
        if not settings.resume:
            clear(settings.out)
        with atomic(settings.out / RUN) as part:
            part.write_text(run_toml(settings))
        done.append(True)

    return prepare


def _scalars(settings: Reconstruct) -> AbstractContextManager[list[OnStep]]:
    """A context that gives the callback writing TensorBoard scalars, if asked for."""
    from contextlib import contextmanager

    @contextmanager
    def nothing() -> Iterator[list[OnStep]]:
        yield []

    @contextmanager
    def board() -> Iterator[list[OnStep]]:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise InputError("tensorboard: not installed; pip install 'nerif[tensorboard]'") from None
        with SummaryWriter(str(settings.out / "tensorboard")) as writer:

            def write(step: Step) -> None:
                if step.step % 20 == 0:
                    for name, value in {**step.losses, "rays_per_second": step.rays_per_second}.items():
                        writer.add_scalar(name, value, step.step)

            yield [write]

    return board() if settings.tensorboard else nothing()


def main(arguments: list[str]) -> None:
    """Parse and run."""
    file, out = None, flag_value(arguments, "-o", "--out")
    if "--resume" in arguments and flag_value(arguments, "--config") is None and out is not None:
        file = Path(out) / RUN
        if not file.is_file():
            raise InputError(f"{out}: expected an interrupted run to resume, got no {RUN} in it")
    method = value_given("method", arguments, "nerif", file)
    if method not in METHODS:
        raise InputError(f"method: expected one of {', '.join(METHODS)}, got '{method}'")
    chosen: dict[str, Any] = {"method": method}
    if method == "nerif":
        name = value_given("preset", arguments, "auto", file)
        # settings of a file are complete: there the preset has had its say already
        chosen |= {"preset": name, "reconstructor": preset(name)}
    default = METHODS[method](measurement=tyro.MISSING, out=tyro.MISSING, **chosen)
    run(read_settings(default, arguments, "reconstruct", file))
