"""Changes of the views of an experiment or a measurement, such as crops or masks, with undo and redo."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import asdict
from typing import Any, Generic, TypeVar

from nicegui import ui

__all__ = ["Edits", "UndoButtons"]

T = TypeVar("T")

STEPS = 100  # that can be undone


class Edits(Generic[T]):
    """A value of each view, with the steps to undo and to redo.

    Parameters
    ----------
    original : values before all edits, by the name of the view: a dataclass or a tuple of some
    read : returns a value from its entries in the draft
    draft : `draft` of earlier edits; views that have gone are ignored
    """

    def __init__(
        self, original: Mapping[str, T], read: Callable[[Any], T], draft: Mapping[str, Any] | None = None
    ) -> None:
        self.original, draft = dict(original), draft or {}
        self.now = {name: read(draft.get("now", {}).get(name, _json(value))) for name, value in self.original.items()}
        self.past = [(name, read(entries)) for name, entries in draft.get("past", []) if name in self.now]
        self.future = [(name, read(entries)) for name, entries in draft.get("future", []) if name in self.now]

    @property
    def draft(self) -> dict[str, Any]:
        """The edits as JSON values, to be restored after a reload."""
        past, future = ([[name, _json(value)] for name, value in steps] for steps in (self.past, self.future))
        return {"now": {name: _json(value) for name, value in self.changes.items()}, "past": past, "future": future}

    @property
    def changes(self) -> dict[str, T]:
        """Values that differ from the original ones."""
        return {name: value for name, value in self.now.items() if value != self.original[name]}

    def put(self, name: str, value: T) -> None:
        """Change the value of a view."""
        if value == self.now[name]:
            return
        self.past = [*self.past, (name, self.now[name])][-STEPS:]
        self.future = []
        self.now[name] = value

    def step(self, back: bool) -> str:
        """Undo the last step, or repeat the last one that was undone, and return its view; empty if there is none."""
        origin, target = (self.past, self.future) if back else (self.future, self.past)
        if not origin:
            return ""
        name, value = origin.pop()
        target.append((name, self.now[name]))
        self.now[name] = value
        return name


class UndoButtons:
    """Buttons that undo and redo, added to the page under construction; enabled where there is a step.

    Parameters
    ----------
    edits : edits
    on_step : called with the view of a step
    """

    def __init__(self, edits: Edits[Any], on_step: Callable[[str], Awaitable[None] | None]) -> None:
        self._edits, self._on_step = edits, on_step
        self._undo = ui.button("Undo", icon="undo", on_click=lambda: self.step(True)).props("outline dense")
        self._redo = ui.button("Redo", icon="redo", on_click=lambda: self.step(False)).props("outline dense")
        self.show()

    def step(self, back: bool) -> Awaitable[None] | None:
        """Undo or redo a step, as by the button."""
        view = self._edits.step(back)
        return self._on_step(view) if view else None

    def show(self) -> None:
        """Enable the buttons that have a step."""
        self._undo.set_enabled(bool(self._edits.past))
        self._redo.set_enabled(bool(self._edits.future))


def _json(value: Any) -> Any:
    return [asdict(item) for item in value] if isinstance(value, tuple) else asdict(value)
