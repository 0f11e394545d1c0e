"""nerif demo: from a measurement to a report by the commands of nerif, which are printed: simulated or real data."""

from __future__ import annotations

import importlib
import webbrowser
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from nerif.cli.output import say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError
from nerif.common.installation import command_line, install
from nerif.common.settings import Natural, Positional
from nerif.common.written_files import OwnFiles
from nerif.data.samples import SAMPLES, sample

__all__ = ["DEMOS", "Demo", "main", "run"]


@dataclass(frozen=True)
class Stage:
    """A command of a demo."""

    line: str  #: of the command, without `nerif`; {out} is the directory, {steps} the number of training steps
    files: tuple[str, ...] = ()  #: that it writes beside those of a result

    def words(self, out: Path, steps: int) -> list[str]:
        """Return the words of the command."""
        return [word.format(out=out, steps=steps) for word in self.line.split()]


@dataclass(frozen=True)
class Scenario:
    """The commands of a demo, and a number of training steps that suffices."""

    title: str
    steps: int
    stages: tuple[Stage, ...]


def _one_camera(name: str, steps: int) -> Scenario:
    """Return the way from the images of one camera, whose lengths are plausible guesses, to a report."""
    return Scenario(
        f"{SAMPLES[name].title} (real data, {SAMPLES[name].licence})",
        steps,
        (
            Stage(
                "calibrate {out} --simple --distance 1000 --background-distance 300 --mm-per-px 0.1 "
                "-o {out}/camera.toml --force",
                ("camera.toml", "camera.rig.png"),
            ),
            Stage(
                "displacement {out} --calibration {out}/camera.toml -o {out}/measurement.nc --no-images --force",
                ("measurement.nc", "measurement.png"),
            ),
            Stage(
                "reconstruct {out}/measurement.nc --out {out} --force --max-steps {steps} --symmetry axis "
                "--open-faces z- z+ --detail off"
            ),
        ),
    )


DEMOS = {
    "flame": Scenario(
        "turbulent Bunsen flame, simulated: twelve views, and a withheld thirteenth",
        400,
        (
            Stage(
                "simulate --phantom flame --views 12 --image-size 48 48 --pixel-pitch 0.0833 --noise 0.05 "
                "--truth-voxels 80 --extra-angles 100.5 -o {out}/measurement.nc --force",
                ("measurement.nc", "measurement.truth.nc"),
            ),
            Stage(
                "reconstruct {out}/measurement.nc --out {out} --force --preset fast --precision float32 --threads 1 "
                "--max-steps {steps} --withhold 100.5deg --voxels 80 --no-report"
            ),
            Stage("evaluate {out} --truth {out}/measurement.truth.nc"),
            Stage("report {out}"),
        ),
    ),
    "jet": _one_camera("jet", 400),
    "blowtorch": _one_camera("blowtorch", 200),
    "spray": Scenario(
        f"{SAMPLES['spray'].title} (real data, {SAMPLES['spray'].licence})",
        300,
        (Stage("reconstruct {out}/measurement.nc --out {out} --force --max-steps {steps} --samples 24 40"),),
    ),
}


@dataclass(frozen=True)
class Demo(Settings):
    """Reconstruct a simulated flame or a real flow that comes with nerif, by the commands that are printed."""

    name: Annotated[Literal[*DEMOS], Positional] = "flame"  # type: ignore[valid-type]
    """Name of the demo; --list describes them."""
    out: Path | None = None
    """Directory to write (default: out/NAME)."""
    steps: Natural = 0
    """Training steps (0: as many as the demo needs)."""
    list: bool = False
    """List the demos, and end."""
    open: bool = False
    """Open the report in the browser at the end."""
    force: bool = False
    """Overwrite an existing directory."""


def run(settings: Demo) -> None:
    """Run the commands of a demo, and print where the report is and what to try next."""
    from nerif.results.directory import REPORT, ResultDirectory

    if settings.list:
        for name, demo in DEMOS.items():
            say(f"nerif demo {name:<10} {demo.title}")
        return
    demo, out = DEMOS[settings.name], settings.out or Path("out") / settings.name
    directory = ResultDirectory(out, say)
    directory.check_free(settings.force)
    out.mkdir(parents=True, exist_ok=True)
    if settings.name in SAMPLES:
        sample(settings.name, out)
    for stage in demo.stages:
        words = stage.words(out, settings.steps or demo.steps)
        say(f"\n$ {command_line(words)}")
        with ExitStack() as stack:
            for file in stage.files:
                stack.enter_context(OwnFiles(out, say).writing(file))
            importlib.import_module(f"nerif.cli.commands.{words[0]}").main(words[1:])
    _print_next(settings.name, out)
    if settings.open and not webbrowser.open((out / REPORT).resolve().as_uri()):
        raise InputError("no browser on this machine; open the page above in one", field="open")


def _print_next(name: str, out: Path) -> None:
    from nerif.results.directory import REPORT

    other = "flame" if name == "jet" else "jet"
    commands = {
        command_line(["figures", str(out)]): "figures for print, as PDF and PNG",
        command_line(["app", str(out)]): f"in the browser ({install('app')})",
        f"nerif demo {other}": f"{DEMOS[other].title} (nerif demo --list: all)",
    }
    say(f"\nReport: {(out / REPORT).resolve().as_uri()}")
    say("Next:")
    width = max(map(len, commands))
    for line, text in commands.items():
        say(f"  {line:<{width}}  {text}")


main = command("demo", Demo, run)
