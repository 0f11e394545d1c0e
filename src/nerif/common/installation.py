"""The distribution that this program is installed by: not `nerif`, a name that another project has on PyPI."""

from __future__ import annotations

__all__ = ["DISTRIBUTION", "install", "stranger"]

DISTRIBUTION = "nerif-bost"
COMMAND = "nerif.cli.cli:main"
"""What the command `nerif` of this program runs, under whatever name it was installed."""


def install(extra: str) -> str:
    """Return the command that installs an extra of pyproject.toml."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def stranger() -> str:
    """Return a line that names the other project's package and the remedy, where that is installed; else nothing."""
    from importlib.metadata import distributions

    for found in distributions(name="nerif"):
        if COMMAND not in {entry.value for entry in found.entry_points}:
            return (
                f"the package nerif {found.version} of another project is installed, which is imported by the same "
                "name; pip uninstall nerif, then install this program again"
            )
    return ""
