"""How far a study is: a bar in a terminal, a line a reconstruction elsewhere, with the time left."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

__all__ = ["progress_of_cases"]


@contextmanager
def progress_of_cases(total: int) -> Iterator[Callable[[int, str, float], None]]:
    """Give a callable that is told how many cases are done, what is being done, and the share of that."""
    console = Console(stderr=True)
    columns = (BarColumn(bar_width=20), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, disable=not console.is_terminal, refresh_per_second=4) as bar:
        task = bar.add_task("", total=total)
        clock = Clock(total)

        def tell(done: int, what: str, share: float) -> None:
            if clock.moved(done) and not console.is_terminal:
                print(f"study {done}/{total} {what}{clock.left}", file=sys.stderr, flush=True)
            bar.update(task, completed=done, description=f"{what} {share:4.0%}{clock.left}")

        yield tell


class Clock:
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
