"""Callbacks during a long computation, called in its own thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["at_pauses", "pause"]

_thread = threading.local()


def pause() -> None:
    """Call the listeners of this thread; work calls it at least about once a second."""
    for listener in getattr(_thread, "listeners", ()):
        listener()


@contextmanager
def at_pauses(listener: Callable[[], None]) -> Iterator[None]:
    """Call `listener` at every pause of this thread within the block."""
    before = getattr(_thread, "listeners", ())
    _thread.listeners = (*before, listener)
    try:
        yield
    finally:
        _thread.listeners = before
