"""Ctrl-C with a message: which files are complete and how to continue."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["Interrupted", "if_interrupted"]


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, with one sentence on what is saved and how to continue."""


@contextmanager
def if_interrupted(message: Callable[[], str]) -> Iterator[None]:
    """Give a Ctrl-C inside the block the text that `message` returns; the innermost block takes precedence."""
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(message()) from None
