"""nerif reconstruct: from a measurement file to a result directory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import tyro

from nerif.cli.commands.methods import RECORDS, Reconstruct
from nerif.cli.commands.output import MONITOR
from nerif.cli.commands.settings import flag_value, read_settings, value_given
from nerif.common.conventions import InputError
from nerif.common.installation import install
from nerif.reconstruction.base import OnStep, Reconstruction, Step
from nerif.reconstruction.neural.presets import preset
from nerif.results.directory import RUN
from nerif.workflow.pipeline import reconstruct_into

__all__ = ["main", "run"]

SCALARS_EVERY = 5.0  # seconds, where twenty steps take longer


def run(settings: Reconstruct) -> Reconstruction:
    """Reconstruct, and write everything that docs/formats.md lists."""
    with _scalars(settings) as scalars:
        return reconstruct_into(
            settings.out, settings.measurement, settings.reconstructor, settings.run,
            voxels=settings.volume_voxels, resume=settings.resume, force=settings.force, keep=settings.kept,
            on_step=scalars, monitor=MONITOR, live=settings.live,
        )  # fmt: skip


@contextmanager
def _scalars(settings: Reconstruct) -> Iterator[OnStep | None]:
    """Give the callback that writes TensorBoard scalars, if asked for."""
    if not settings.tensorboard:
        yield None
        return
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise InputError(f"not installed; {install('tensorboard')}", field="tensorboard") from None
    with ExitStack() as stack:
        writer: list[SummaryWriter] = []
        written = [0.0]

        def write(step: Step) -> None:
            if not writer:  # the directory is looked at before the first step, and must be as it was until then
                writer.append(stack.enter_context(SummaryWriter(str(settings.out / "tensorboard"))))
            if step.step % 20 == 0 or step.seconds - written[0] >= SCALARS_EVERY:
                written[0] = step.seconds
                for name, value in {**step.losses, "rays_per_second": step.rays_per_second}.items():
                    writer[0].add_scalar(name, value, step.step)

        yield write


def main(arguments: list[str]) -> None:
    """Parse and run."""
    file, out = None, flag_value(arguments, "-o", "--out")
    if "--resume" in arguments and flag_value(arguments, "--config") is None and out is not None:
        file = Path(out) / RUN
        if not file.is_file():
            raise InputError(f"expected an interrupted run to resume, got no {RUN} in it", field=out)
    method = value_given("method", arguments, "nerif", file)
    if method not in RECORDS:
        raise InputError(f"expected one of {', '.join(RECORDS)}, got '{method}'", field="method")
    chosen: dict[str, Any] = {"method": method}
    if method == "nerif":
        name = value_given("preset", arguments, "auto", file)
        # settings of a file are complete: there the preset has had its say already
        chosen |= {"preset": name, "reconstructor": preset(name)}
    default = RECORDS[method](measurement=tyro.MISSING, out=tyro.MISSING, **chosen)
    if run(read_settings(default, arguments, "reconstruct", file)).outcome.failed:
        raise SystemExit(1)
