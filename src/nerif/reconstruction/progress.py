"""Who is told how long work goes: lines of text, and bars. Quiet unless somebody listens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace

from nerif.reconstruction.base import OnStep, compose

__all__ = ["QUIET", "Monitor"]


def _quiet(*_: object) -> None:
    return None


@dataclass(frozen=True)
class Monitor:
    """What is called while work goes on.

    Parameters
    ----------
    say : takes a line for the user
    training : takes a title, and gives a context in which every Step of a reconstruction is told
    counting : takes a title, and gives a context in which it is told how many are done, and out of how many
    """

    say: Callable[[str], None] = _quiet
    training: Callable[[str], AbstractContextManager[OnStep]] = lambda title: nullcontext(_quiet)
    counting: Callable[[str], AbstractContextManager[Callable[[int, int], None]]] = lambda title: nullcontext(_quiet)

    def telling(self, on_step: OnStep) -> Monitor:
        """Return a monitor that also calls that callback with every Step."""

        @contextmanager
        def training(title: str) -> Iterator[OnStep]:
            with self.training(title) as told:
                yield compose(on_step, told)

        return replace(self, training=training)


QUIET = Monitor()
