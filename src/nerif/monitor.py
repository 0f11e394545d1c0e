"""Who is told how long work goes: lines of text, and bars. Quiet unless somebody listens."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

from nerif.reconstruction.base import OnStep

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


QUIET = Monitor()
