"""Where results go, and what is said on the way."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.reconstruction.base import OnStep, Step, compose
from nerif.reconstruction.progress import Monitor

__all__ = ["MONITOR", "check_file", "counting_bar", "figures_bar", "say", "silence"]

SAME_SIGNAL = 0.5  # seconds
SOON, EVERY = 2.0, 15.0  # seconds before the first line without a terminal, and between lines


def say(text: str) -> None:
    """Print a line for the user."""
    print(text, flush=True)


def say_on(text: str) -> None:
    """Print a line of long work, which goes on where nobody reads any more."""
    try:
        say(text)
    except BrokenPipeError:
        silence()


def silence() -> None:
    """Let what is still printed go nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def check_file(path: Path, force: bool, *others: Path) -> None:
    """Refuse an output file that exists (unless forced) or whose folder does not."""
    for file in (path, *others):
        if not file.parent.is_dir():
            raise InputError(f"the folder {file.parent} does not exist; make it first", field=file)
        if file.is_dir():
            raise InputError("expected the name of a file to write, got a folder", field=file)
        if file.exists() and not force:
            raise InputError("exists already and was left as it is; give another --out, or --force", field=file)


@contextmanager
def interruptible() -> Iterator[list[bool]]:
    """Turn the first Ctrl-C into a request to stop (the list becomes [True]); the second one breaks off.

    A second signal at once is the same Ctrl-C, passed on by a launcher such as torchrun.
    """
    asked, first = [False], [0.0]

    def handler(number: int, frame: object) -> None:
        if asked[0] and time.monotonic() - first[0] > SAME_SIGNAL:
            raise KeyboardInterrupt
        if asked[0]:
            return
        asked[0], first[0] = True, time.monotonic()
        print("\nstopping after this step; Ctrl-C again to break off", file=sys.stderr, flush=True)

    try:
        before = signal.signal(signal.SIGINT, handler)
    except ValueError:  # not in the main thread: nothing to catch here
        yield asked
        return
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def counting_bar(title: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """Show a bar that goes away when done: a callable that is told how many are done, and out of how many.

    Without a terminal it is a line after SOON seconds, and one EVERY so many, also between counts.
    """
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress

    console = Console(stderr=True)
    if not console.is_terminal:
        with _lines(title, total) as update:
            yield update
        return
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())  # title, bar, percent, time left; m/n
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=total)

        def update(done: int, of: int | None = None) -> None:
            bar.update(task, completed=done, total=total if of is None else of)

        yield update


@contextmanager
def _lines(title: str, total: int | None) -> Iterator[Callable[..., None]]:
    """Tell how far work is in lines, from a thread of their own: a callable as counting_bar gives it."""
    so_far, done = [""], threading.Event()

    def update(count: int, of: int | None = None) -> None:
        whole = total if of is None else of
        so_far[0] = f" {count}" + (f"/{whole}" if whole else "")

    def tell() -> None:
        begun, wait = time.monotonic(), SOON
        while not done.wait(wait):
            print(f"{title}{so_far[0]}, {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
            wait = EVERY

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield update
    finally:
        done.set()
        teller.join()


@contextmanager
def figures_bar(title: str) -> Iterator[Callable[[float, str, float], None]]:
    """Show a bar with figures beside it: a callable that is told the share done, the figures, and the seconds so far.

    Without a terminal it is a line every 15 s, and one at the end.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(bar_width=20), TextColumn("{task.percentage:3.0f}% {task.fields[figures]}"))
    last = [0.0]
    bar = Progress(
        *columns, console=console, disable=not console.is_terminal, refresh_per_second=4,
        redirect_stdout=sys.stdout.isatty(),  # a file gets its lines, the bar or none
    )  # fmt: skip
    task = bar.add_task(title, total=1.0, figures="")

    def update(share: float, figures: str, seconds: float) -> None:
        bar.start()
        bar.update(task, completed=share, figures=figures)
        if not console.is_terminal and (share >= 1 or seconds - last[0] >= 15):
            last[0] = seconds
            print(f"{title} {share:4.0%} {figures}", file=sys.stderr, flush=True)

    try:
        yield update
    finally:
        bar.stop()


@contextmanager
def progress_bar(title: str) -> Iterator[OnStep]:
    """Show a bar of the training: a callable for each Step, with epoch, loss terms, rays/s and time left."""
    with figures_bar(title) as bar:

        def update(step: Step) -> None:
            left = step.seconds * (1 / step.progress - 1) if step.progress > 0.001 else float("nan")
            terms = " ".join(f"{k} {v:.3g}" for k, v in step.losses.items())
            figures = f"epoch {step.epoch:.1f} | {terms} | {step.rays_per_second:.3g} rays/s | {left:.0f} s left"
            bar(step.progress, figures, step.seconds)

        yield update


@contextmanager
def _training(title: str) -> Iterator[OnStep]:
    """A bar of the training that Ctrl-C stops after the step it is in."""
    with interruptible() as asked, progress_bar(title) as bar:
        yield compose(bar, _say_note, lambda _: asked[0])


def _say_note(step: Step) -> None:
    if step.note:
        say_on(step.note)


MONITOR = Monitor(say_on, _training, counting_bar)
"""The terminal, as the library tells it how the work goes."""
