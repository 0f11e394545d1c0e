"""Numbers and tables in words, as the page of a study has them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

__all__ = ["NOTHING", "bare", "cc", "duration", "factor", "listed", "markdown_table", "memory", "share"]

NOTHING = "–"
"""What is not there."""


def share(value: float | None) -> str:
    """Return an error in per cent, with the paper's three decimals."""
    return NOTHING if value is None else f"{value:.3%}"


def cc(value: float | None) -> str:
    """Return a correlation or similarity with the paper's four decimals."""
    return NOTHING if value is None else f"{value:z.4f}"


def duration(seconds: float | None) -> str:
    """Return a time in the unit that suits it."""
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
    """Return names with commas and an and; how many more where there are many."""
    known = list(names)
    if len(known) > most:
        known = [*known[: most - 1], f"{len(known) - most + 1} others"]
    return " and ".join([", ".join(known[:-1]), known[-1]] if len(known) > 1 else known)


def bare(text: object) -> str:
    """Return text of unknown origin so that Markdown shows it as it is, in one line."""
    return re.sub(r"([\\`*_{}\[\]<>#|~])", r"\\\1", " ".join(str(text).split())).replace("&", "&amp;")


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Return a table in Markdown, its first `left` columns to the left and the others to the right."""
    rule = ["---"] * left + ["--:"] * (len(head) - left)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *rows))
