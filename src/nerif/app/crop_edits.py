"""Unsaved changes of crops, with undo and redo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from nerif.imaging.readers.crop import Crop

__all__ = ["CropEdits"]

STEPS = 100  # of undo


class CropEdits:
    """The crops of an experiment's views, with the steps to undo and to redo.

    Parameters
    ----------
    written : crops in the folder
    draft : `draft` of earlier edits
    """

    def __init__(self, written: Mapping[str, Crop], draft: Mapping[str, Any] | None = None) -> None:
        self.written = dict(written)
        draft = draft or {}
        self.now = {**self.written, **{k: c for k, c in _crops(draft.get("now", {})).items() if k in self.written}}
        self.past = [(n, Crop(**c)) for n, c in draft.get("past", []) if n in self.written]
        self.future = [(n, Crop(**c)) for n, c in draft.get("future", []) if n in self.written]

    @property
    def draft(self) -> dict[str, Any]:
        """The edits as JSON, to be restored after a reload."""
        steps = {name: [[n, asdict(c)] for n, c in getattr(self, name)] for name in ("past", "future")}
        return {"now": {name: asdict(crop) for name, crop in self.changed.items()}, **steps}

    @property
    def changed(self) -> dict[str, Crop]:
        """Crops that differ from those in the folder."""
        return {name: crop for name, crop in self.now.items() if crop != self.written[name]}

    def put(self, name: str, crop: Crop) -> None:
        """Change the crop of a view."""
        if crop == self.now[name]:
            return
        self.past = [*self.past, (name, self.now[name])][-STEPS:]
        self.future = []
        self.now[name] = crop

    def undo(self) -> str:
        """Undo the last step and return its view, empty if there is none."""
        return self._step(self.past, self.future)

    def redo(self) -> str:
        """Repeat the last step that was undone."""
        return self._step(self.future, self.past)

    def _step(self, source: list[tuple[str, Crop]], target: list[tuple[str, Crop]]) -> str:
        if not source:
            return ""
        name, crop = source.pop()
        target.append((name, self.now[name]))
        self.now[name] = crop
        return name


def _crops(table: Mapping[str, Mapping[str, Any]]) -> dict[str, Crop]:
    return {name: Crop(**crop) for name, crop in table.items()}
