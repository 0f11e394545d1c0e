"""Atomic writing of files, TOML and JSON."""

from __future__ import annotations

import difflib
import errno
import functools
import itertools
import json
import math
import os
import platform
import re
import shutil
import time
import tomllib
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError

__all__ = [
    "DISK_FULL", "WINDOWS", "atomic", "check_file", "check_known", "ending", "instead_of_file", "is_file_name",
    "is_near", "local_path", "read_json", "read_toml", "read_yaml", "reading", "recorded", "write_json", "write_toml",
    "written",
]  # fmt: skip

WINDOWS = os.name == "nt"
CONTROL = re.compile(r"[\x00-\x1f]")
"""Characters of no path: \\t, \\n and others that TOML makes of C:\\tmp\\new in double quotes."""
DRIVE = re.compile(r"[A-Za-z]:[\\/]|\\\\")
"""Beginning of an absolute path of Windows."""
RESERVED = re.compile(r'[<>:"|?*]|[. ]$|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)', re.IGNORECASE)
"""Signs and names of no file of Windows; cam:1.png is there a hidden stream of the file cam."""
DISK_FULL = tuple(getattr(errno, name) for name in ("ENOSPC", "EDQUOT", "EFBIG") if hasattr(errno, name))
"""Errors of a write for which there is no space: on the disk, in the quota, or within a limit of the system."""
ATTEMPTS_AFTER = (0.05, 0.1, 0.2, 0.4, 0.8)  # s, to rename a file over one that is open
MOST_VALUES = 1_000_000  # of a YAML file
ESCAPES = "in double quotes a backslash begins an escape: write paths with /, or in single quotes"

PART = re.compile(r"\..*\.([0-9a-f]{8})-(\d+)-\d+\.part(\.[^.]*)?")
"""Names of temporary files: machine, process and number keep those of two runs apart."""

written: deque[Path] = deque(maxlen=100)
"""The last paths that this process has written, in order."""
_parts = itertools.count()


def ending(path: str | os.PathLike[str]) -> str:
    """Return the ending of a file name in small letters, such as ".nc": cameras and copies may write .NC."""
    return Path(path).suffix.lower()


def local_path(path: str | os.PathLike[str], base: Path, field: object) -> Path:
    """Return a path, relative to `base`, as this system writes it: a relative path of Windows holds everywhere."""
    text = os.fspath(path)
    if bad := CONTROL.search(text):
        raise InputError(f"expected a path, got {text!r} with {bad[0]!r} in it; {ESCAPES}", field=field)
    if WINDOWS or ("\\" not in text and not DRIVE.match(text)) or (base / text).exists():
        return Path(text)
    if DRIVE.match(text):
        raise InputError(
            f"expected a path of this system, got '{text}' of Windows; give a relative one, such as "
            "cam1/reference, or where the files are on this system",
            field=field,
        )
    return Path(text.replace("\\", "/"))


def is_near(path: str | os.PathLike[str], holder: Path) -> bool:
    """Return whether a path lies in the current folder or in that of `holder`, by its text and by its links."""
    places, texts = (Path.cwd(), holder.resolve().parent), (os.path.abspath, os.path.realpath)
    return any(all(Path(text(path)).is_relative_to(place) for text in texts) for place in places)


def recorded(path: str | os.PathLike[str], holder: Path) -> Path:
    """Return the path of a file that a result, the holder, names; InputError if it is not near.

    A result may come from another person, and its report would show the content of any file.
    """
    if not is_near(path, holder):
        raise InputError(
            f"outside of the current folder and of that of {holder}, which names it; start the command in a folder "
            "that contains it, or copy it beside",
            field=path,
        )
    return Path(path)


def is_file_name(name: str) -> bool:
    """Return whether a text can be the name of a file on this system, not a path."""
    if name in ("", ".", "..") or "/" in name or "\\" in name or CONTROL.search(name):
        return False
    return not (WINDOWS and RESERVED.search(name))


@contextmanager
def atomic(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path` that takes its name at the end, and is removed after an error.

    The temporary name is hidden, of this process only, and keeps the suffix, by which libraries choose a format. A file
    replaces a file; a directory replaces either. The error of a full disk names the file.
    """
    path = Path(path)
    _remove_rests(path.parent)
    part = path.with_name(f".{path.stem[:40]}.{_machine()}-{os.getpid()}-{next(_parts)}.part{path.suffix}")
    try:
        yield part
        if part.is_dir():
            _remove(path)
        _replace(part, path)
        written.append(path)
    except OSError as error:
        if error.errno is not None and error.errno in DISK_FULL:
            error.filename, error.strerror = str(path), os.strerror(error.errno)  # libraries name none, or the part
        raise
    finally:
        _remove(part)


@functools.cache
def _machine() -> str:
    return f"{zlib.crc32(platform.node().encode()):08x}"


@functools.lru_cache(256)  # directories, each looked through once by a process
def _remove_rests(directory: Path) -> None:
    """Remove temporary files left by processes of this machine that were killed."""
    with suppress(OSError):  # no such directory, or of another user
        for entry in os.scandir(directory):
            match = PART.fullmatch(entry.name)
            if match and match[1] == _machine() and not _exists(int(match[2])):
                _remove(Path(entry.path))


def _exists(pid: int) -> bool:
    import psutil

    return bool(psutil.pid_exists(pid))


def _replace(part: Path, path: Path) -> None:
    """Rename a file over another; on Windows, wait until programs such as a virus scanner have closed the other one."""
    for pause in ATTEMPTS_AFTER if WINDOWS else ():
        try:
            return os.replace(part, path)
        except PermissionError:
            time.sleep(pause)
    try:
        os.replace(part, path)
    except PermissionError as error:
        reason = "cannot be replaced; close it in other programs, or choose another name"
        raise PermissionError(error.errno, reason, str(path)) from None


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def instead_of_file(path: Path) -> str:
    """Return what a path is that is no regular file, in words."""
    if not path.exists():
        return "no such file"
    return "a folder" if path.is_dir() else "a pipe, socket or device; write its content to a file first"


def check_file(path: str | os.PathLike[str], expected: str = "file") -> None:
    """Raise InputError if a path is no regular file: a pipe would be waited for, a device has no end."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"no such {expected}", field=path)
    if not path.is_file():
        raise InputError(f"{instead_of_file(path)}; expected a {expected}", field=path)


@contextmanager
def reading(message: str, field: object = "") -> Iterator[None]:
    """Raise an InputError with `message` for any error inside; the block holds little but calls of a library."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # libraries raise anything on damaged files
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(f"{message} ({reason})", field=field) from None


def read_toml(path: str | os.PathLike[str], expected: str = "TOML file") -> dict[str, Any]:
    """Read a TOML file; `expected` is its content, for the message if there is none."""
    check_file(path, expected)
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        remedy = f"; {ESCAPES}" if str(error).startswith(("Unescaped", "Invalid hex value")) else ""
        raise InputError(f"not a TOML file ({error}){remedy}", field=path) from None


def read_yaml(path: Path) -> Any:
    """Read a YAML file whose aliases stand for at most MOST_VALUES values."""
    import yaml

    check_file(path)
    try:
        content = yaml.safe_load(Path(path).read_bytes())
        if _count(content, {}) > MOST_VALUES:
            raise ValueError(f"its aliases stand for more than {MOST_VALUES:,} values")
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"not a YAML file ({' '.join(str(error).split())})", field=path) from None
    return content


def _count(value: Any, counts: dict[int, float]) -> float:
    """Return the number of values in lists and tables, those of an alias each time; infinity if one contains itself."""
    if not isinstance(value, dict | list):
        return 1
    if id(value) not in counts:
        counts[id(value)] = math.inf
        counts[id(value)] = sum(_count(v, counts) for v in (value.values() if isinstance(value, dict) else value))
    return counts[id(value)]


def write_toml(path: str | os.PathLike[str], table: Mapping[str, Any], head: str = "") -> None:
    """Write a TOML file atomically, with `head` as leading comment."""
    import tomli_w

    with atomic(path) as part:
        part.write_text(head + tomli_w.dumps(table), encoding="utf-8")


def check_known(words: Iterable[str], names: Iterable[str], where: str, what: str = "key", more: str = "") -> None:
    """Raise an InputError that suggests the nearest name for a word that is not among the names."""
    names = list(names)
    for word in words:
        if word not in names:
            near = difflib.get_close_matches(word, names, n=1, cutoff=0)[0]
            raise InputError(f"unknown {what} '{word}'; the nearest known one is '{near}'{more}", field=where)


def read_json(path: Path) -> Any:
    """Read a JSON file."""
    check_file(path)
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"not a JSON file, or truncated ({error}); write or export it again", field=path) from None


def write_json(path: Path, entries: Mapping[str, Any]) -> None:
    """Write a JSON file atomically; NaN and infinity become null."""
    with atomic(path) as part:
        part.write_text(json.dumps(_plain(entries), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
