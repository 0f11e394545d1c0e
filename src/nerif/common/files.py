"""Files and stores that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["atomic", "written"]

written: list[Path] = []
"""What this process has written, in that order."""


@contextmanager
def atomic(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path` that takes its name at the end, and is removed if anything goes wrong.

    The temporary name is hidden and keeps the ending, by which libraries choose a format. What is written may be a file
    or a directory; a file replaces a file, and a directory whatever stands at `path`.
    """
    path = Path(path)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    _remove(part)  # left by a process that was killed
    try:
        yield part
        if part.is_dir():
            _remove(path)
        os.replace(part, path)
        written.append(path)
    finally:
        _remove(part)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
