"""Output of the commands: lines, progress bars, Ctrl-C, and checks of output files."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from nerif.cli.closed_output import is_closed_output, silence
from nerif.common.conventions import printable
from nerif.common.interruption import SIGNALS, received
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.reconstructor import OnStep, Step, compose

__all__ = ["MONITOR", "counting_bar", "figures_bar", "say"]

SAME_SIGNAL = 0.5  # s, within which a second Ctrl-C is the first one, passed on by a launcher such as torchrun
FIRST_LINE, LINE_INTERVAL = 2.0, 15.0  # s, of progress without a terminal


def say(text: str) -> None:
    """Print a line, of which control characters from files become escapes."""
    print(printable(text), flush=True)


def _say_safely(text: str) -> None:
    """Print a line of long work, which continues if standard output is closed."""
    try:
        say(text)
    except OSError as error:
        if not is_closed_output(error):
            raise
        silence()


@contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C into a request to stop, given by a callable; the second one interrupts."""
    times: list[float] = []

    def handler(number: int, frame: object) -> None:
        received.append(number)
        times.append(time.monotonic())
        if len(times) == 1:
            print("\nstopping after this step; Ctrl-C again to interrupt", file=sys.stderr, flush=True)
        elif times[-1] - times[0] > SAME_SIGNAL:
            raise KeyboardInterrupt

    try:
        before = {number: signal.signal(number, handler) for number in SIGNALS}
    except ValueError:  # signals reach the main thread only
        yield lambda: False
        return
    try:
        yield lambda: bool(times)
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextmanager
def counting_bar(title: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """Give a callback (done, total) that updates a progress bar, or lines of text without a terminal."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import MofNCompleteColumn, Progress

    console = Console(stderr=True)
    if not console.is_terminal:
        with _counting_lines(title, total) as update:
            yield update
        return
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())  # title, bar, percent, time left; m/n
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(escape(title), total=total)

        def update(done: int, of: int | None = None) -> None:
            bar.update(task, completed=done, total=of or total)

        yield update


@contextmanager
def _counting_lines(title: str, total: int | None) -> Iterator[Callable[..., None]]:
    """Print progress at intervals from a thread, also between counts."""
    count, finished = [""], threading.Event()

    def update(done: int, of: int | None = None) -> None:
        count[0] = f" {done}" + (f"/{of or total}" if of or total else "")

    def print_lines() -> None:
        start, wait = time.monotonic(), FIRST_LINE
        while not finished.wait(wait):
            print(f"{title}{count[0]}, {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)
            wait = LINE_INTERVAL

    thread = threading.Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield update
    finally:
        finished.set()
        thread.join()


@contextmanager
def figures_bar(title: str) -> Iterator[Callable[[float, str, float], None]]:
    """Give a callback (progress from 0 to 1, figures, seconds) that updates a bar with figures beside it."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(bar_width=20), TextColumn("{task.percentage:3.0f}% {task.fields[figures]}"))
    last_line = 0.0
    bar = Progress(
        *columns, console=console, disable=not console.is_terminal, refresh_per_second=4,
        redirect_stdout=sys.stdout.isatty(),  # not where standard output is a file
    )  # fmt: skip
    task = bar.add_task(title, total=1.0, figures="")

    def update(progress: float, figures: str, seconds: float) -> None:
        nonlocal last_line
        bar.start()
        bar.update(task, completed=progress, figures=figures)
        if not console.is_terminal and (progress >= 1 or seconds - last_line >= LINE_INTERVAL):
            last_line = seconds
            print(f"{title} {progress:4.0%} {figures}", file=sys.stderr, flush=True)

    try:
        yield update
    finally:
        bar.stop()


@contextmanager
def progress_bar(title: str) -> Iterator[OnStep]:
    """Give a callback for each Step that shows epoch, loss terms, rays/s and remaining time."""
    with figures_bar(title) as bar:

        def update(step: Step) -> None:
            terms = " ".join(f"{k} {v:.3g}" for k, v in step.losses.items())
            figures = f"epoch {step.epoch:.1f} | {terms} | {step.rays_per_second:.3g} rays/s"
            if step.progress > 0.001:  # else unknown
                figures += f" | {step.seconds * (1 / step.progress - 1):.0f} s left"
            bar(step.progress, figures, step.seconds)

        yield update


@contextmanager
def _training(title: str) -> Iterator[OnStep]:
    """Give a callback for each Step that shows progress, prints notes, and stops after Ctrl-C."""

    def print_note(step: Step) -> None:
        if step.note:
            _say_safely(step.note)

    with _interruptible() as stop, progress_bar(title) as bar:
        yield compose(bar, print_note, lambda _: stop())


MONITOR = Monitor(_say_safely, _training, counting_bar)
"""Progress on the terminal."""
