"""Mask shapes of the views of a measurement, with undo and redo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from nerif.imaging.masks import MaskShape

__all__ = ["MaskEdits"]

STEPS = 100  # that can be undone


class MaskEdits:
    """Shapes of each view and the history of their changes.

    Parameters
    ----------
    names : names of the views
    state : `state` of an earlier object
    """

    def __init__(self, names: Sequence[str], state: Mapping[str, Any] | None = None) -> None:
        state = state or {}
        shapes = {name: tuple(map(_shape, entries)) for name, entries in state.get("shapes", {}).items()}
        self.shapes: dict[str, tuple[MaskShape, ...]] = {name: shapes.get(name, ()) for name in names}
        self.past: list[tuple[str, tuple[MaskShape, ...]]] = []
        self.future: list[tuple[str, tuple[MaskShape, ...]]] = []
        for steps, history in ((self.past, state.get("past", [])), (self.future, state.get("future", []))):
            steps += [(name, tuple(map(_shape, entries))) for name, entries in history if name in self.shapes]

    @property
    def state(self) -> dict[str, Any]:
        """Shapes and history as JSON values."""
        steps = {k: [[n, [asdict(s) for s in shapes]] for n, shapes in getattr(self, k)] for k in ("past", "future")}
        return {"shapes": {name: [asdict(s) for s in shapes] for name, shapes in self.drawings.items()}, **steps}

    @property
    def drawings(self) -> dict[str, tuple[MaskShape, ...]]:
        """Views that have shapes."""
        return {name: shapes for name, shapes in self.shapes.items() if shapes}

    def put(self, name: str, shapes: Sequence[MaskShape]) -> None:
        """Replace the shapes of a view."""
        self.past = [*self.past, (name, self.shapes[name])][-STEPS:]
        self.future = []
        self.shapes[name] = tuple(shapes)

    def undo(self) -> str:
        """Undo the last step and return the name of its view, empty if there is no step."""
        return self._step(self.past, self.future)

    def redo(self) -> str:
        """Redo the last undone step and return the name of its view, empty if there is none."""
        return self._step(self.future, self.past)

    def _step(self, origin: list[Any], target: list[Any]) -> str:
        if not origin:
            return ""
        name, shapes = origin.pop()
        target.append((name, self.shapes[name]))
        self.shapes[name] = shapes
        return str(name)


def _shape(entries: Mapping[str, Any]) -> MaskShape:
    points = tuple((float(x), float(y)) for x, y in entries["points"])
    return MaskShape(**{**entries, "points": points})
