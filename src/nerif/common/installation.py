"""The distribution name of this program; `nerif` on PyPI belongs to another project."""

from __future__ import annotations

__all__ = ["DISTRIBUTION", "install", "stranger"]

DISTRIBUTION = "nerif-bost"
COMMAND = "nerif.cli.cli:main"
"""Entry point of this program's command `nerif`."""


def install(extra: str) -> str:
    """Return the command that installs an extra of pyproject.toml."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def stranger() -> str:
    """Return a warning with the remedy if the other project's package `nerif` is installed, else an empty string."""
    from importlib.metadata import distributions

    for distribution in distributions(name="nerif"):
        if COMMAND not in {entry.value for entry in distribution.entry_points}:
            return (
                f"the package nerif {distribution.version} of another project is installed and uses the same import "
                "name; pip uninstall nerif, then install this program again"
            )
    return ""
