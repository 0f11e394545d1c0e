"""Names of symmetries in settings: none, axis, axis+N (N harmonics of the azimuth), planar."""

from __future__ import annotations

import re

from nerif.common.conventions import InputError

__all__ = ["MAX_HARMONICS", "NO_SYMMETRY", "parse_symmetry"]

NO_SYMMETRY = "none"
MAX_HARMONICS = 8


def parse_symmetry(text: str) -> tuple[str, int] | None:
    """Return kind and number of harmonics of a symmetry (none, axis, axis+N or planar); None for none."""
    if text == NO_SYMMETRY:
        return None
    match = re.fullmatch(r"(planar)|axis(?:\+(\d+))?", text)
    if not match or int(match[2] or 0) > MAX_HARMONICS:
        raise InputError(
            f"expected {NO_SYMMETRY}, axis, axis+N (N harmonics of the azimuth, at most {MAX_HARMONICS}) or "
            f"planar, got '{text}'",
            field="symmetry",
        )
    return match[1] or "axis", int(match[2] or 0)
