"""The files of a directory that this program wrote, so that nothing of a person's is overwritten or removed.

written.json in the directory lists them: name, size in bytes, time of the last change in ns, and SHA-256.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nerif.common.files import write_json

__all__ = ["WARN", "WRITTEN", "OwnFiles", "remove_empty"]

WRITTEN = "written.json"
WARN = logging.getLogger("nerif").warning

FIELDS = ("field.safetensors", "checkpoint.safetensors")
UNLISTED = {
    "run.toml": (
        "run.toml", "metrics.json", "history.csv", "volume.nc", "volume.vti", "reprojection.nc", "report.html",
        "meridian.nc", "meridian.csv", "live.json", "live.npz", *FIELDS,
    ),
    "asked.json": ("asked.json", "views.json", *FIELDS),
}  # fmt: skip
"""What versions without a list wrote for certain into a directory that has the file named first: a calibration or a
figure of such a directory may as well be a person's."""
HEADS = {"run.toml": b"# nerif reconstruct", "asked.json": b"{"}


class OwnFiles:
    """The files that this program wrote into a directory.

    A file that was changed since it was written is no longer one of them. Two processes that write at once may lose an
    entry of the list; the file then counts as somebody else's, and is left alone.

    Parameters
    ----------
    directory : which need not be there yet
    say : is given a line about each file that is renamed or left
    """

    def __init__(self, directory: str | os.PathLike[str], say: Callable[[str], None] = WARN) -> None:
        self.directory, self.say = Path(directory), say

    def __contains__(self, name: str) -> bool:
        return self._is_own(name, self._listed())

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Give the path to write a file to, and list the file once it is written; one of somebody else is renamed."""
        self.set_aside([name])
        path = self.directory / name
        yield path
        listed = self._listed()
        listed[name] = _identity(path)
        self._keep(listed)

    def set_aside(self, names: Sequence[str]) -> None:
        """Rename those of the files that somebody else wrote or changed: NAME.before.ENDING, or NAME.before2.ENDING.

        Such a name is never one of this program's, so the file stays for good.
        """
        listed = self._listed()
        for name in names:
            path = self.directory / name
            if not os.path.lexists(path) or self._is_own(name, listed):
                continue
            new = _free(path)
            path.rename(new)
            self.say(f"{path}: not written by nerif, or changed since; it is {new.name} now")

    def remove(self, names: Sequence[str] | None = None) -> None:
        """Remove files of this program, all that are listed by default; those changed since stay, which is said.

        The directory goes with the last file in it, if all were to be removed.
        """
        listed = self._listed()
        chosen = [name for name in listed if names is None or name in names]
        changed = []
        for name in chosen:
            path = self.directory / name
            if self._is_own(name, listed):
                path.unlink()
            elif os.path.lexists(path):
                changed.append(name)
            del listed[name]
        if changed:
            self.say(f"{self.directory}: changed since nerif wrote it, and left: {', '.join(changed)}")
        if chosen:
            self._keep(listed)
        if names is None:
            remove_empty(self.directory)

    def _listed(self) -> dict[str, Any]:
        """The list, by name; of names in the directory itself only, whoever wrote them there."""
        path = self.directory / WRITTEN
        if not os.path.lexists(path):
            return self._unlisted()
        try:
            found = json.loads(path.read_text())["files"]
            return {name: dict(entry) for name, entry in found.items() if Path(name).name == name}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return {}

    def _unlisted(self) -> dict[str, Any]:
        """What is there of a version that kept no list."""
        for mark, names in UNLISTED.items():
            path = self.directory / mark
            if path.is_file() and not path.is_symlink():
                with path.open("rb") as file:
                    known = file.read(len(HEADS[mark])) == HEADS[mark]
                return {n: _identity(self.directory / n) for n in names if (self.directory / n).is_file() and known}
        return {}

    def _is_own(self, name: str, listed: dict[str, Any]) -> bool:
        path, entry = self.directory / name, listed.get(name)
        if entry is None or path.is_symlink() or not path.is_file():
            return False
        now = path.stat()
        if now.st_size != entry.get("bytes"):
            return False
        # a copy of the directory has other times
        return now.st_mtime_ns == entry.get("changed_ns") or _digest(path) == entry.get("sha256")

    def _keep(self, listed: dict[str, Any]) -> None:
        path = self.directory / WRITTEN
        if listed:
            write_json(path, {"about": "files that nerif wrote here and may overwrite or remove", "files": listed})
        else:
            path.unlink(missing_ok=True)


def remove_empty(directory: Path) -> None:
    """Remove a directory, if it is there and nothing is in it."""
    with suppress(FileNotFoundError, NotADirectoryError):
        if not any(directory.iterdir()):
            directory.rmdir()


def _identity(path: Path) -> dict[str, Any]:
    now = path.stat()
    return {"bytes": now.st_size, "changed_ns": now.st_mtime_ns, "sha256": _digest(path)}


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _free(path: Path) -> Path:
    """A name that no file has: NAME.before.ENDING, NAME.before2.ENDING, ..."""
    number = 1
    while os.path.lexists(new := path.with_name(f"{path.stem}.before{number if number > 1 else ''}{path.suffix}")):
        number += 1
    return new
