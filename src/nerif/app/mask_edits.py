"""What was drawn into the masks of a measurement, view by view; each step can be undone, and all survives a reload."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from nerif.imaging.masks import MaskShape

__all__ = ["MaskEdits"]

STEPS = 100  # that can be undone


class MaskEdits:
    """Shapes of each view, with what was before and what was undone.

    Parameters
    ----------
    names : of the views
    kept : of `kept` of an earlier one
    """

    def __init__(self, names: Sequence[str], kept: Mapping[str, Any] | None = None) -> None:
        kept = kept or {}
        shapes = {name: tuple(map(_shape, own)) for name, own in kept.get("shapes", {}).items()}
        self.shapes: dict[str, tuple[MaskShape, ...]] = {name: shapes.get(name, ()) for name in names}
        self.past: list[tuple[str, tuple[MaskShape, ...]]] = []
        self.future: list[tuple[str, tuple[MaskShape, ...]]] = []
        for steps, found in ((self.past, kept.get("past", [])), (self.future, kept.get("future", []))):
            steps += [(name, tuple(map(_shape, own))) for name, own in found if name in self.shapes]

    @property
    def kept(self) -> dict[str, Any]:
        """What can be kept as JSON."""
        steps = {k: [[n, [asdict(s) for s in own]] for n, own in getattr(self, k)] for k in ("past", "future")}
        return {"shapes": {name: [asdict(s) for s in own] for name, own in self.drawn.items()}, **steps}

    @property
    def drawn(self) -> dict[str, tuple[MaskShape, ...]]:
        """Views that something was drawn in."""
        return {name: own for name, own in self.shapes.items() if own}

    def put(self, name: str, shapes: Sequence[MaskShape]) -> None:
        """Change what is drawn in a view."""
        self.past = [*self.past, (name, self.shapes[name])][-STEPS:]
        self.future = []
        self.shapes[name] = tuple(shapes)

    def undo(self) -> str:
        """Take the last step back; returns the view whose it was, nothing if there is none."""
        return self._step(self.past, self.future)

    def redo(self) -> str:
        """Take the last step that was undone again."""
        return self._step(self.future, self.past)

    def _step(self, come_from: list[Any], go_to: list[Any]) -> str:
        if not come_from:
            return ""
        name, shapes = come_from.pop()
        go_to.append((name, self.shapes[name]))
        self.shapes[name] = shapes
        return str(name)


def _shape(entries: Mapping[str, Any]) -> MaskShape:
    points = tuple((float(x), float(y)) for x, y in entries["points"])
    return MaskShape(**{**entries, "points": points})
