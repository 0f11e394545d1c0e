"""Ctrl-C with a message: which files are complete and how to continue. Interruption of another process."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["OWN_GROUP", "SIGNALS", "Interrupted", "if_interrupted", "interrupt"]

SIGNALS: tuple[int, ...] = tuple(getattr(signal, name) for name in ("SIGINT", "SIGBREAK") if hasattr(signal, name))
"""Signals that interrupt a command: Ctrl-C, and on Windows Ctrl-Break."""
OWN_GROUP: dict[str, Any] = {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
"""Arguments of subprocess.Popen for a process that `interrupt` reaches; Windows needs a group of its own."""


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


def interrupt(pid: int) -> None:
    """Interrupt a process as Ctrl-C does; on Windows, where that ends it, by Ctrl-Break."""
    os.kill(pid, getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))
