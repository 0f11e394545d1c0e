"""The files of a directory that this program wrote; it overwrites and removes no others.

written.json in the directory lists them: name, size in bytes, time of the last change in ns, and SHA-256.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nerif.common.files import read_json, write_json
from nerif.common.locks import locked

__all__ = ["WARN", "WRITTEN", "OwnFiles", "remove_empty"]

WRITTEN = "written.json"
ABOUT = "files that nerif wrote here and may overwrite or remove"
PENDING = {"pending": True}
WARN = logging.getLogger("nerif").warning


class OwnFiles:
    """The files that this program wrote into a directory and that are unchanged since.

    Parameters
    ----------
    directory : may not exist yet
    say : called with a line about each file that is renamed or left
    """

    def __init__(self, directory: str | os.PathLike[str], say: Callable[[str], None] = WARN) -> None:
        self.directory, self.say = Path(directory), say

    def __contains__(self, name: str) -> bool:
        return self._is_own(name, self._entries())

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Yield the path to write a file to and list the file afterwards; rename a foreign file of that name.

        Its entry is `pending` until then: a file of a process that was killed while it wrote is not foreign.
        """
        self.set_aside([name])
        path = self.directory / name
        if self.directory.is_dir():
            self._change_list({name: PENDING})
        try:
            yield path
        except BaseException:  # after which a file that comes to this name later is foreign
            with suppress(OSError):  # of the list on a full disk; the first error counts
                self._change_list({name: _identity(path) if path.is_file() else None})
            raise
        self._change_list({name: _identity(path)})

    def set_aside(self, names: Sequence[str]) -> None:
        """Rename foreign files to NAME.before.SUFFIX, NAME.before2.SUFFIX, ..., names that this program never uses."""
        entries = self._entries()
        for name in names:
            path = self.directory / name
            if os.path.lexists(path) and not self._is_own(name, entries):
                self._rename(path)

    def _rename(self, path: Path) -> None:
        new, number = path.with_name(f"{path.stem}.before{path.suffix}"), 1
        while os.path.lexists(new):
            number += 1
            new = path.with_name(f"{path.stem}.before{number}{path.suffix}")
        path.rename(new)
        self.say(f"{path}: not written by nerif, or changed since; renamed to {new.name}")

    def remove(self, names: Sequence[str] | None = None) -> None:
        """Remove files of this program that are unchanged; by default all, and the directory if it is then empty."""
        entries = self._entries()
        selection, changed = [name for name in entries if names is None or name in names], []
        for name in selection:
            path = self.directory / name
            if self._is_own(name, entries):
                path.unlink()
            elif os.path.lexists(path):
                changed.append(name)
        if changed:
            self.say(f"{self.directory}: changed since nerif wrote it, and not removed: {', '.join(changed)}")
        if selection:
            self._change_list(dict.fromkeys(selection))
        if names is None:
            remove_empty(self.directory)

    def _entries(self) -> dict[str, dict[str, Any]]:
        """Entries of the list by name; names outside the directory are ignored."""
        try:
            entries = self._content()["files"]
            return {name: dict(entry) for name, entry in entries.items() if Path(name).name == name}
        except (ValueError, KeyError, TypeError, AttributeError):
            return {}

    def _content(self) -> dict[str, Any]:
        """Content of the list; empty for a file of another program or format."""
        try:
            content = read_json(self.directory / WRITTEN)
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) and content.get("about") == ABOUT else {}

    def _is_own(self, name: str, entries: dict[str, dict[str, Any]]) -> bool:
        path, entry = self.directory / name, entries.get(name)
        if entry is None or path.is_symlink() or not path.is_file():
            return False
        now = path.stat()
        if entry == PENDING:
            return True
        if now.st_size != entry.get("bytes"):
            return False
        # a copy of the directory has other times
        return now.st_mtime_ns == entry.get("changed_ns") or _digest(path) == entry.get("sha256")

    def _change_list(self, changes: Mapping[str, dict[str, Any] | None]) -> None:
        """Replace entries of the list, or drop them (None); a foreign file of its name is renamed."""
        path = self.directory / WRITTEN
        with locked(path, wait=True):
            is_own = bool(self._content())
            entries = {name: entry for name, entry in {**self._entries(), **changes}.items() if entry is not None}
            if entries and not is_own and os.path.lexists(path):
                self._rename(path)
            if entries:
                write_json(path, {"about": ABOUT, "files": entries})
            elif is_own:
                path.unlink()


def remove_empty(directory: Path) -> None:
    """Remove a directory if it exists and is empty."""
    with suppress(FileNotFoundError, NotADirectoryError):
        if not any(directory.iterdir()):
            directory.rmdir()


def _identity(path: Path) -> dict[str, Any]:
    now = path.stat()
    return {"bytes": now.st_size, "changed_ns": now.st_mtime_ns, "sha256": _digest(path)}


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
