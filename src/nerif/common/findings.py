"""A finding: what is wrong with a measurement, as a code for programs and a sentence for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Finding"]


@dataclass(frozen=True)
class Finding:
    """A fault of a measurement.

    Parameters
    ----------
    code : one word for its kind.
        Of the rig: inside, beside, apart, small_box, large_box, moved.
        Of all views: unrelated, reordered, or what may have happened to one.
        Of a view: swapped, flipped, flipped_u, flipped_v, mirrored, upside_down, turned, transposed, quarter_turn,
        reversed_columns, reversed_rows, reversed_axes, exchanged, misscaled, unlike.
        Of the flow: open_face
    sentence : what it is, and what to do about it
    views : names of the views it concerns; none where it concerns the measurement as a whole
    """

    code: str
    sentence: str
    views: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.sentence

    @staticmethod
    def subject(views: Sequence[str], total: int) -> str:
        """Return what a sentence about some of `total` views begins with: view a; views a and b; all views."""
        if len(views) == total > 1:
            return "all views"
        names = " and ".join(filter(None, (", ".join(views[:-1]), views[-1])))
        return f"view{'s' if len(views) > 1 else ''} {names}"
