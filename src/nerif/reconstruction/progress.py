"""Progress reporting: lines of text, and bars."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace

from nerif.reconstruction.reconstructor import OnStep, compose

__all__ = ["QUIET", "Monitor"]


def _quiet(*_: object) -> None: ...


@dataclass(frozen=True)
class Monitor:
    """Callbacks of long work; by default silent.

    `say` takes a line for the user; `training` and `counting` take a title and return a context that gives a callback
    for every Step of a reconstruction, and for (items done, all items).
    """

    say: Callable[[str], None] = _quiet
    training: Callable[[str], AbstractContextManager[OnStep]] = lambda title: nullcontext(_quiet)
    counting: Callable[[str], AbstractContextManager[Callable[[int, int], None]]] = lambda title: nullcontext(_quiet)

    def with_callback(self, on_step: OnStep) -> Monitor:
        """Return a monitor that also calls `on_step` with every Step."""

        @contextmanager
        def training(title: str) -> Iterator[OnStep]:
            with self.training(title) as callback:
                yield compose(on_step, callback)

        return replace(self, training=training)


QUIET = Monitor()
