"""A lock on an output: of two runs that write to one place, the second is refused.

The system holds the lock and drops it when the process ends, however it ends. Between machines it holds on file systems
that pass locks on, such as NFS 4; on those without locks nothing is refused.
"""

from __future__ import annotations

import errno
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.common.files import WINDOWS

__all__ = ["LOCK", "locked"]

LOCK = ".nerif.lock"
HELD = (errno.EAGAIN, errno.EACCES)  # by another process; other errors: a file system without locks
ATTEMPTS = 1000  # at a lock that its holders remove; a few network file systems number a file differently each time
BYTE = 1 << 30  # that is locked on Windows, where nobody can read a locked byte: behind the text


@contextmanager
def locked(out: Path, inside: bool = False, wait: bool = False) -> Iterator[None]:
    """Hold the lock of an output; InputError if another process holds it.

    The lock is a hidden file, which is removed at the end, as are directories that were made for it and are empty.

    Parameters
    ----------
    out : file or directory
    inside : the lock lies in the directory `out`, which is made, not beside it
    wait : for the other process, instead of the error
    """
    lock = out / LOCK if inside else out.with_name(f".{out.name}{LOCK}")
    made = [folder for folder in (lock.parent, *lock.parent.parents) if not folder.exists()]
    file = _acquired(lock, out, wait)
    try:
        yield
    finally:
        if WINDOWS:  # which removes no open file
            os.close(file)
        with suppress(OSError):
            lock.unlink()
        if not WINDOWS:
            os.close(file)
        with suppress(OSError):  # not empty
            for folder in made:
                folder.rmdir()


def _acquired(lock: Path, out: Path, wait: bool) -> int:
    """Return the open lock file, which is locked and says by whom."""
    for last in [False] * ATTEMPTS + [True]:
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            file = os.open(lock, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        except (FileNotFoundError, FileExistsError):  # the holder has just removed the directory
            if lock.parent.is_file():
                raise
            continue
        try:
            _lock(file, wait)
        except OSError as error:
            if error.errno in HELD:
                holder = os.read(file, 100).decode(errors="replace")
                os.close(file)
                raise InputError(
                    f"another run writes to it ({holder}); wait for its end, stop it, or give another --out", field=out
                ) from None
        with suppress(FileNotFoundError):
            if last or os.path.samestat(os.fstat(file), os.stat(lock)):
                os.ftruncate(file, 0)
                os.write(file, f"process {os.getpid()} on {platform.node()}".encode())
                return file
        os.close(file)  # of a holder that has just removed it
    raise OSError(errno.EIO, "cannot be made", str(lock))


def _lock(file: int, wait: bool) -> None:
    if WINDOWS:
        import msvcrt

        os.lseek(file, BYTE, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        os.lseek(file, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
