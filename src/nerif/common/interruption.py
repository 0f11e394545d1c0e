"""Ctrl-C, SIGTERM and a full disk with a message: which files are complete and how to continue.

A batch system, a container and a shutdown end a process by SIGTERM, which is handled as Ctrl-C is: temporary files and
keys are removed, and a training stops after its step with a checkpoint.
"""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from nerif.common.files import DISK_FULL

__all__ = [
    "OWN_GROUP", "SIGNALS", "DiskFull", "Interrupted", "handle_signals", "if_interrupted", "interrupt", "received",
]  # fmt: skip

NAMES = ("SIGINT", "SIGTERM", "SIGBREAK")
SIGNALS: tuple[int, ...] = tuple(getattr(signal, name) for name in NAMES if hasattr(signal, name))
"""Signals that interrupt a command: Ctrl-C, SIGTERM, and on Windows Ctrl-Break."""
received: list[int] = []
"""Signals that have interrupted this process, in order."""
OWN_GROUP: dict[str, Any] = {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
"""Arguments of subprocess.Popen for a process that `interrupt` reaches; Windows needs a group of its own."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, with one sentence on what is saved and how to continue."""


class DiskFull(OSError):
    """No space for a file, with the same sentence."""


def handle_signals() -> None:
    """Let SIGTERM, and Ctrl-Break of Windows, raise KeyboardInterrupt, as Ctrl-C does by default."""
    for number in SIGNALS:
        if number != signal.SIGINT:
            signal.signal(number, _raise)


def _raise(number: int, frame: object) -> None:
    received.append(number)
    raise KeyboardInterrupt


@contextmanager
def if_interrupted(message: Callable[[], str]) -> Iterator[None]:
    """Give a Ctrl-C or a full disk inside the block the text of `message`; the innermost block takes precedence."""
    try:
        yield
    except (Interrupted, DiskFull):
        raise
    except KeyboardInterrupt:
        raise Interrupted(message()) from None
    except OSError as error:
        if error.errno is None or error.errno not in DISK_FULL:
            raise
        raise DiskFull(error.errno, f"{os.strerror(error.errno)}; {message()}", error.filename) from error


def interrupt(pid: int) -> None:
    """Interrupt a process as Ctrl-C does; on Windows, where that ends it, by Ctrl-Break."""
    os.kill(pid, getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))
