"""Findings of the plausibility checks of a measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Finding"]


@dataclass(frozen=True)
class Finding:
    """A fault of a measurement."""

    code: str
    """Its kind, one word. Rig: inside, beside, apart, small_box, large_box, moved. All views: unrelated, reordered,
    or one of the codes of a view. One view: swapped, flipped, flipped_u, flipped_v, mirrored, upside_down,
    turned, transposed, quarter_turn, reversed_columns, reversed_rows, reversed_axes, exchanged, misscaled,
    unlike. Flow: open_face Film: late."""
    sentence: str  #: description and remedy
    views: tuple[str, ...] = ()  #: names of the views concerned; empty for the whole measurement

    def __str__(self) -> str:
        return self.sentence

    @staticmethod
    def subject(views: Sequence[str], total: int) -> str:
        """Return the subject of a sentence about some of `total` views: view a; views a and b; all views."""
        if len(views) == total > 1:
            return "all views"
        names = " and ".join(filter(None, (", ".join(views[:-1]), views[-1])))
        return f"view{'s' if len(views) > 1 else ''} {names}"
