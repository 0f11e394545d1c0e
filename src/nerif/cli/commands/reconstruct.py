"""nerif reconstruct: from a measurement file to a result directory."""

from __future__ import annotations

import dataclasses
import inspect
import io
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from nerif.cli.arguments import flag_value
from nerif.cli.output import MONITOR
from nerif.cli.settings import Settings, compute, read_settings, setting_of
from nerif.common.conventions import InputError
from nerif.common.installation import install
from nerif.common.settings import MISSING, Count, Flat, NoOption, Positional
from nerif.reconstruction.methods import METHODS
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.presets import PRESETS, preset
from nerif.reconstruction.reconstructor import OnStep, Reconstruction, Reconstructor, Step
from nerif.workflow.run_settings import RunSettings

__all__ = ["Reconstruct", "ReconstructNeRIF", "command_of", "main", "run"]

P = TypeVar("P", bound=Settings)

SCALAR_STEPS, SCALAR_SECONDS = 20, 5.0  # between TensorBoard scalars, whichever is shorter


@dataclass(frozen=True)
class Reconstruct(Settings):
    """Reconstruct the field of a measurement and write a result directory."""

    brief: ClassVar[bool] = True
    measurement: Annotated[Path, Positional]
    """Measurement file (.nc); may be omitted with --resume."""
    out: Path
    """Result directory to write."""
    method: Literal[*METHODS] = "nerif"  # type: ignore[valid-type]
    """Reconstruction method; --method NAME --help lists its options."""
    force: bool = False
    """Overwrite an existing result directory."""
    resume: bool = False
    """Continue an interrupted run in --out; limits such as --epochs or --iterations may be raised."""
    tensorboard: bool = False
    """Write TensorBoard scalars to OUT/tensorboard."""
    live: bool = False
    """Write OUT/live.json and OUT/live.npz during the run, for nerif app."""
    run: Annotated[RunSettings, Flat] = field(default_factory=RunSettings)
    reconstructor: Annotated[Reconstructor, NoOption] = field(default_factory=NeRIF)


@dataclass(frozen=True)
class ReconstructGridless(Reconstruct):
    """Settings for methods without voxels of their own."""

    voxels: Count = 100
    """Voxels of the written volume along the longest edge of the box."""


@dataclass(frozen=True)
class ReconstructNeRIF(ReconstructGridless):
    """Reconstruct the field of a measurement by a neural field and write a result directory."""

    preset: Literal["auto", *PRESETS] = "auto"  # type: ignore[valid-type]
    """Default settings: fast (CPU), best (GPU), paper, or auto (best with a GPU, else fast)."""
    reconstructor: Annotated[NeRIF, Flat] = field(default_factory=NeRIF)


def command_of(method: str) -> type[Reconstruct]:
    """Return the settings of the command for a method: the common ones and those of the method."""
    if method not in METHODS:
        raise InputError(f"expected one of {', '.join(METHODS)}, got '{method}'", field="method")
    kind = METHODS[method]
    return ReconstructNeRIF if kind is NeRIF else _command(method, kind)


@cache
def _command(method: str, kind: type[Reconstructor]) -> type[Reconstruct]:
    with_voxels = any(f.name == "voxels" for f in dataclasses.fields(kind))  # type: ignore[arg-type]
    common = Reconstruct if with_voxels else ReconstructGridless
    namespace = {
        "__module__": __name__,
        "__doc__": f"{inspect.getdoc(Reconstruct)}\n\n{kind.about()}",
        "__annotations__": {"method": Reconstruct.__annotations__["method"], "reconstructor": Annotated[kind, Flat]},
        "method": method,
        "reconstructor": field(default_factory=kind),
    }
    return dataclass(frozen=True)(type(f"Reconstruct{kind.__name__}", (common,), namespace))


def run(settings: Reconstruct) -> Reconstruction:
    """Reconstruct, and write the files of docs/formats.md."""
    import psutil

    from nerif.workflow.pipeline import reconstruct_into

    attributes = {"preset": getattr(settings, "preset", None), "tensorboard": settings.tensorboard}
    with _scalars(settings) as scalars:
        return reconstruct_into(
            settings.out, settings.measurement, settings.reconstructor, settings.run,
            voxels=getattr(settings, "voxels", None), resume=settings.resume, force=settings.force, keep=attributes,
            on_step=scalars, monitor=MONITOR, live=settings.live, since=psutil.Process().create_time(),
        )  # fmt: skip


@contextmanager
def _scalars(settings: Reconstruct) -> Iterator[OnStep | None]:
    """Give a callback that writes TensorBoard scalars, if requested."""
    if not settings.tensorboard:
        yield None
        return
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise InputError(f"not installed; {install('tensorboard')}", field="tensorboard") from None
    with ExitStack() as stack:
        writer: SummaryWriter | None = None
        last = 0.0

        def write(step: Step) -> None:
            nonlocal writer, last
            if writer is None:  # only now: the run checks and prepares the directory before its first step
                writer = stack.enter_context(SummaryWriter(str(settings.out / "tensorboard")))
            if step.step % SCALAR_STEPS == 0 or step.seconds - last >= SCALAR_SECONDS:
                last = step.seconds
                for name, value in {**step.losses, "rays_per_second": step.rays_per_second}.items():
                    writer.add_scalar(name, value, step.step)

        yield write


def main(arguments: list[str]) -> None:
    """Parse and run."""
    file, out = None, flag_value(arguments, "out")
    if "--resume" in arguments and flag_value(arguments, "config") is None and out is not None:
        from nerif.results.directory import RUN

        file = Path(out) / RUN
        if not file.is_file():
            raise InputError(f"expected an interrupted run to resume, got no {RUN} in it", field=out)
    method = setting_of("method", arguments, "nerif", file)
    default = command_of(method)(MISSING, MISSING, method=method)
    if isinstance(default, ReconstructNeRIF):
        settings: Reconstruct = read_with_preset(default, arguments, "reconstruct", file)
    else:
        settings = read_settings(default, arguments, "reconstruct", file)
    if compute(run, settings).outcome.failed:
        raise SystemExit(1)


def read_with_preset(default: P, arguments: list[str], name: str, file: Path | None = None) -> P:
    """Return the settings of a command that trains a network; its defaults are those of the preset."""
    choice = setting_of("preset", arguments, "auto", file)
    first = PRESETS["fast"] if choice == "auto" else preset(choice)
    changes: dict[str, Any] = {"preset": choice, "reconstructor": first}
    settings = read_settings(replace(default, **changes), arguments, name, file)
    if choice != "auto" or (best := preset("auto")) == first:  # whether there is a GPU is known to PyTorch only
        return settings
    with redirect_stderr(io.StringIO()):  # notes, for the second time
        return read_settings(replace(default, **changes | {"reconstructor": best}), arguments, name, file)
