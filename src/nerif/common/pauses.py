"""Between two pieces of long work: whoever has something to look at meanwhile is called in the thread that does it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["at_pauses", "pause"]

_here = threading.local()


def pause() -> None:
    """Call what listens in this thread; to be called between pieces of work that take less than a second or so."""
    for listener in getattr(_here, "listeners", ()):
        listener()


@contextmanager
def at_pauses(listener: Callable[[], None]) -> Iterator[None]:
    """Within it, call `listener` at every pause of this thread."""
    before = getattr(_here, "listeners", ())
    _here.listeners = (*before, listener)
    try:
        yield
    finally:
        _here.listeners = before
