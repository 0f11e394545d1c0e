"""Numbers and tables as text of the study's page."""

from __future__ import annotations

import re
from collections.abc import Iterable

from benchmarks.runner import table

NOTHING = "–"
"""Missing value."""


def share(value: float | None) -> str:
    """Return an error in per cent, with the paper's three decimals."""
    return NOTHING if value is None else f"{value:.3%}"


def cc(value: float | None) -> str:
    """Return a correlation or similarity with the paper's four decimals."""
    return NOTHING if value is None else f"{value:z.4f}"


def count(value: float | None) -> str:
    """Return a number of epochs."""
    return NOTHING if value is None else f"{value:.3g}"


def duration(seconds: float | None) -> str:
    """Return a time in hours, minutes or seconds."""
    if seconds is None:
        return NOTHING
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} s"


def memory(size: float | None) -> str:
    """Return bytes in GB or MB, powers of ten."""
    if not size:
        return NOTHING
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def factor(value: float) -> str:
    """Return a ratio in two digits, without powers of ten."""
    return f"{float(f'{value:.2g}'):g}" if value < 1e4 else f"{value:.0f}"


def listed(names: Iterable[str], most: int = 6) -> str:
    """Return names with commas and an "and"; beyond `most` only their number."""
    words = list(names)
    if len(words) > most:
        words = [*words[: most - 1], f"{len(words) - most + 1} others"]
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def bare(text: object) -> str:
    """Return text in one line that Markdown shows literally."""
    return re.sub(r"([\\`*_{}\[\]<>#|~])", r"\\\1", " ".join(str(text).split())).replace("&", "&amp;")


def numbers_table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table whose columns after the first are aligned to the right."""
    return table(head, rows, left=1)
