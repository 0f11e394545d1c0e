"""Crops of views as they are edited: each step can be undone, and all is kept as it is typed, before it is written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from nerif.imaging.readers.crop import Crop

__all__ = ["CropEdits"]

STEPS = 100  # that can be undone


class CropEdits:
    """The crops of an experiment's views, with what was before and what was undone.

    Parameters
    ----------
    written : crops as they are in the folder
    kept : of `kept` of an earlier one
    """

    def __init__(self, written: Mapping[str, Crop], kept: Mapping[str, Any] | None = None) -> None:
        self.written = dict(written)
        kept = kept or {}
        self.now = {**self.written, **{k: c for k, c in _crops(kept.get("now", {})).items() if k in self.written}}
        self.past = [(n, Crop(**c)) for n, c in kept.get("past", []) if n in self.written]
        self.future = [(n, Crop(**c)) for n, c in kept.get("future", []) if n in self.written]

    @property
    def kept(self) -> dict[str, Any]:
        """What can be kept as JSON."""
        steps = {name: [[n, asdict(c)] for n, c in getattr(self, name)] for name in ("past", "future")}
        return {"now": {name: asdict(crop) for name, crop in self.changed.items()}, **steps}

    @property
    def changed(self) -> dict[str, Crop]:
        """Crops that are not as in the folder."""
        return {name: crop for name, crop in self.now.items() if crop != self.written[name]}

    def put(self, name: str, crop: Crop) -> None:
        """Change the crop of a view."""
        if crop == self.now[name]:
            return
        self.past = [*self.past, (name, self.now[name])][-STEPS:]
        self.future = []
        self.now[name] = crop

    def undo(self) -> str:
        """Take the last step back; returns the view whose it was, nothing if there is none."""
        return self._step(self.past, self.future)

    def redo(self) -> str:
        """Take the last step that was undone again."""
        return self._step(self.future, self.past)

    def _step(self, come_from: list[tuple[str, Crop]], go_to: list[tuple[str, Crop]]) -> str:
        if not come_from:
            return ""
        name, crop = come_from.pop()
        go_to.append((name, self.now[name]))
        self.now[name] = crop
        return name


def _crops(table: Mapping[str, Mapping[str, Any]]) -> dict[str, Crop]:
    return {name: Crop(**crop) for name, crop in table.items()}
