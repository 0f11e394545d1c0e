"""The distribution name of this program (`nerif` on PyPI belongs to another project), and its commands to copy."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from nerif.common.conventions import InputError
from nerif.common.files import WINDOWS

__all__ = ["DISTRIBUTION", "command_line", "install", "optional", "package_conflict", "quoted", "word_of"]

DISTRIBUTION = "nerif-bost"
COMMAND = "nerif.cli.cli:main"
"""Entry point of this program's command `nerif`."""
OPTION = re.compile(r"-(?![\d.])")
"""Beginning of a word that a command takes for an option, not for a number."""


def install(extra: str) -> str:
    """Return the command that installs an extra of pyproject.toml."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def optional(package: str, extra: str, field: str, remedy: str) -> Any:
    """Return an optional package; InputError with the command that installs it, and another remedy."""
    try:
        return import_module(package)
    except ImportError:
        text = f"expected the package {package}, which is not installed; {install(extra)}{remedy}"
        raise InputError(text, field=field) from None


def word_of(name: object) -> str:
    """Return the name of a file as an argument of a command, so that none is taken for an option."""
    return f"./{name}" if OPTION.match(str(name)) else str(name)


def command_line(arguments: Sequence[str]) -> str:
    """Return the command line of the arguments of nerif."""
    return " ".join(map(quoted, ("nerif", *arguments)))


def quoted(word: str) -> str:
    """Return a word as the shell of this system reads it."""
    if not WINDOWS:
        return shlex.quote(word)
    from subprocess import list2cmdline

    return list2cmdline([word])


def package_conflict() -> str:
    """Return a warning with the remedy if the other project's package `nerif` is installed, else an empty string."""
    from importlib.metadata import distributions

    for distribution in distributions(name="nerif"):
        if COMMAND not in {entry.value for entry in distribution.entry_points}:
            return (
                f"the package nerif {distribution.version} of another project is installed and uses the same import "
                "name; pip uninstall nerif, then install this program again"
            )
    return ""
