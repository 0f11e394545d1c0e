"""TOML files, written whole, read, and refused in words; and the keys that people mistype in them."""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError
from nerif.common.files import atomic

__all__ = ["check_known", "read_toml", "write_toml"]


def read_toml(path: str | os.PathLike[str], expected: str = "TOML file") -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    InputError
        If it is missing (`expected` says what should be there), or no TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such {expected}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, IsADirectoryError) as error:
        raise InputError(f"{path}: not a TOML file ({error})") from None


def write_toml(path: str | os.PathLike[str], table: Mapping[str, Any], head: str = "") -> None:
    """Write a TOML file, atomically, below a comment."""
    import tomli_w

    with atomic(path) as part:
        part.write_text(head + tomli_w.dumps(table), encoding="utf-8")


def check_known(words: Iterable[str], known: Iterable[str], where: str, what: str = "key", more: str = "") -> None:
    """Refuse a word that is not known.

    Raises
    ------
    InputError
        Naming the nearest known one.
    """
    known = list(known)
    for word in words:
        if word not in known:
            near = difflib.get_close_matches(word, known, n=1, cutoff=0)[0]
            raise InputError(f"{where}: unknown {what} '{word}'; the nearest known one is '{near}'{more}")
