"""Ctrl-C: what is there already, and how to go on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["Interrupted", "if_interrupted"]


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, with one sentence on what is saved and how to go on."""


@contextmanager
def if_interrupted(tell: Callable[[], str]) -> Iterator[None]:
    """Within it, a Ctrl-C carries what `tell` returns, unless something inside knew better.

    Parameters
    ----------
    tell : looks what is saved, once it is needed
    """
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(tell()) from None
