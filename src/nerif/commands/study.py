"""nerif study: the paper's numerical study, repeated here and set beside the paper's own figures."""

from __future__ import annotations

import shlex
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import tyro

from nerif import __version__
from nerif.commands.output import say
from nerif.commands.result_files import versions
from nerif.commands.settings import Settings, read_settings
from nerif.conventions import InputError
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.presets import preset
from nerif.study.cases import FULL, QUICK, Case, Scale, cases, check_sections
from nerif.study.page import write_page
from nerif.study.running import read_record, run_cases

__all__ = ["Study", "main", "run"]

PAGE_EVERY = 180.0  # seconds between pages while the study goes on


@dataclass(frozen=True)
class Study(Settings):
    """Repeat the paper's numerical study and write study.md and study.html; done again, it goes on where it was.

    Sections: tables, slices, curves, cost, network, encoding, sampling, differentiation, model, resolution, views and
    speed.
    """

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/study")
    """Directory to write; what is in it already is not done again."""
    quick: bool = False
    """A small version: views of 48 x 48 pixels, 350 steps of training."""
    only: tuple[str, ...] = ()
    """Sections to do; default: all."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, ..."""
    preset: str = "auto"
    """Settings of NeRIF that the study starts from."""
    time_limit: float | None = None
    """Seconds of training of each NeRIF reconstruction; default: 120; --quick stops after 350 steps, at most 30 s."""
    pixels: int | None = None
    """Of an edge of each view; default: 200 as in the paper, with --quick 48."""
    page_only: bool = False
    """Write the page from what is there, and reconstruct nothing."""


def run(settings: Study) -> Path:
    """Run the cases that are missing, write the page as they come in, and return where it is."""
    scale = _scale(settings)
    sections = check_sections(settings.only)
    todo = cases(scale, sections)
    if settings.out.is_file():
        raise InputError(f"{settings.out}: expected a directory for --out, got a file")
    settings.out.mkdir(parents=True, exist_ok=True)
    about = _about(settings, scale, sections)
    if settings.page_only:
        return _page(settings.out, todo, about)
    started = written = time.monotonic()
    failed = []
    try:
        with _bar(len(todo)) as tell:
            for case, record in zip(todo, run_cases(todo, settings.out, tell), strict=True):
                if "failed" in record:
                    failed.append(f"{case.key}: {record['failed']}")
                if time.monotonic() - written > PAGE_EVERY:
                    _page(settings.out, todo, about)
                    written = time.monotonic()
    except KeyboardInterrupt:
        say(f"{_page(settings.out, todo, about)}: the page of what is done; the same command goes on from here")
        raise
    page = _page(settings.out, todo, about)
    minutes = (time.monotonic() - started) / 60
    say(f"{len(todo) - len(failed)} of {len(todo)} reconstructions are there, after {minutes:.1f} min")
    for line in failed:
        say(f"failed: {line}")
    say(f"Open {page} in a browser.")
    return page


def _scale(settings: Study) -> Scale:
    """What the settings make of the full study or the quick one."""
    scale = QUICK if settings.quick else FULL
    device = resolve_device(settings.device)  # one that is not here is refused before the long work
    preset(settings.preset)
    changes: dict[str, Any] = {"preset": settings.preset, "device": str(device)}
    if settings.time_limit is not None:
        if not settings.time_limit > 0:
            raise InputError(f"time_limit: expected seconds above 0, got {settings.time_limit}")
        changes["seconds"] = settings.time_limit
    if settings.pixels is not None:
        if settings.pixels < 8:
            raise InputError(f"pixels: expected at least 8, got {settings.pixels}")
        changes["pixels"] = settings.pixels
    return replace(scale, **changes)


def _about(settings: Study, scale: Scale, sections: tuple[str, ...]) -> dict[str, Any]:
    """What stands at the head of the page."""
    found = versions()
    return {
        **asdict(scale),
        "scale": scale.name,
        "command": shlex.join(["nerif", "study", *(word for word in sys.argv[2:] if word != "--page-only")]),
        "machine": _machine(scale.device, found["machine"]),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "nerif": __version__,
        "torch": found["torch"],
        "sections": sections,
    }


def _machine(device: str, otherwise: str) -> str:
    import torch

    return torch.cuda.get_device_name(device) if device.startswith("cuda") else otherwise


def _page(folder: Path, todo: list[Case], about: dict[str, Any]) -> Path:
    return write_page(folder, [(case, read_record(folder, case)) for case in todo], about)


@contextmanager
def _bar(total: int) -> Iterator[Callable[[int, str, float], None]]:
    """A bar of all cases: how many are done, what is being done, and the time left by those that were done now."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (BarColumn(bar_width=20), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, disable=not console.is_terminal, refresh_per_second=4) as bar:
        task = bar.add_task("", total=total)
        clock = _Clock(total)

        def tell(done: int, what: str, share: float) -> None:
            if clock.moved(done) and not console.is_terminal:
                print(f"study {done}/{total} {what}{clock.left}", file=sys.stderr, flush=True)
            bar.update(task, completed=done, description=f"{what} {share:4.0%}{clock.left}")

        yield tell


class _Clock:
    """How long is left, by the last cases that were done (those read from disk take no time)."""

    def __init__(self, total: int) -> None:
        self.total, self.done, self.last = total, -1, time.monotonic()
        self.seconds: deque[float] = deque(maxlen=12)

    def moved(self, done: int) -> bool:
        """Take note of the number of cases done, and say whether it is another."""
        if done == self.done:
            return False
        now = time.monotonic()
        if done > 0 and now - self.last > 0.5:
            self.seconds.append(now - self.last)
        self.done, self.last = done, now
        return True

    @property
    def left(self) -> str:
        """In words, empty while nothing is known."""
        if not self.seconds:
            return ""
        return f" | {(self.total - self.done) * sum(self.seconds) / len(self.seconds) / 60:.0f} min left"


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Study(), arguments, "study"))
