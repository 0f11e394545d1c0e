"""Slices of volumes on one grid side by side, with one slider per axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import html, image
from nerif.app.forms.sliders import RangeSlider
from nerif.app.project.workspace import Workspace
from nerif.data.volume import Volume
from nerif.geometry import Grid
from nerif.report.slice_images import bar_image, slice_aspect, slice_axes, slice_image

__all__ = ["Panel", "SlicesView"]

NORMALS = "zyx"


@dataclass(frozen=True)
class Panel:
    """A volume and its display settings."""

    title: str
    volume: Volume  #: volume; all panels of a view have the same grid
    limits: tuple[float, float]  #: colour range, in `unit`
    unit: str  #: unit of the values
    colours: str  #: name of a Matplotlib colour map


class SlicesView:
    """Slices of panels normal to z, y and x."""

    def __init__(self, work: Workspace) -> None:
        self.work = work
        self.panels: Sequence[Panel] = ()
        self._at = dict.fromkeys(NORMALS, 0.5)  # position along each axis, relative to its length
        self._queue: set[str] = set()
        self._busy = False
        self._layout: tuple[Any, ...] = ()
        self._images: dict[tuple[str, int], Any] = {}
        self._bars = html()
        self._place = ui.element("div")

    async def show(self, panels: Sequence[Panel]) -> None:
        """Replace the panels; the slice positions stay."""
        self.panels = panels
        layout = tuple(p.title for p in panels), panels[0].volume.grid if panels else None
        if layout != self._layout:
            self._layout = layout
            self._build()
        self._bars.set_content(_bars(panels))
        self._queue |= set(NORMALS)
        await self._draw()

    def _build(self) -> None:
        self._place.clear()
        self._images = {}
        self._place.classes(replace=f"cuts {'many' if len(self.panels) > 1 else 'one'}")
        for normal in NORMALS if self.panels else "":
            with self._place, ui.element("div").classes("cut"):
                self._cut(normal, self.panels[0].volume.grid)

    def _cut(self, normal: str, grid: Grid) -> None:
        along = grid.axis(normal)

        async def move(index: int) -> None:
            self._at[normal] = (index + 0.5) / len(along)
            self._queue.add(normal)
            await self._draw()

        RangeSlider(
            f"Slice across {normal}", len(along) - 1, self._index(normal), lambda i: f"{float(along[i]):.2f} mm", move
        )
        with ui.element("div").classes("panels"):
            for number, panel in enumerate(self.panels):
                aspect = slice_aspect(panel.volume, normal)
                with ui.element("figure"):
                    style = f"aspect-ratio: {aspect:.4f}; --aspect: {aspect:.4f}"
                    self._images[normal, number] = image().style(style)
                    title = f"{panel.title}; " if len(self.panels) > 1 else ""
                    html(escape(f"{title}{slice_axes(grid.box, normal)}"), "figcaption")

    def _index(self, normal: str) -> int:
        count = self.panels[0].volume.grid.shape["zyx".index(normal)]
        return min(int(self._at[normal] * count), count - 1)

    async def _draw(self) -> None:
        """Draw the slices that have moved; of moves during the drawing, only the last position is drawn."""
        if self._busy:
            return
        self._busy = True
        try:
            while self._queue:
                normal = self._queue.pop()
                panels, index = self.panels, self._index(normal) if self.panels else 0
                addresses = await self.work.in_thread(_slice_addresses, panels, normal, index)
                if panels is not self.panels:
                    continue
                for number, (panel, address) in enumerate(zip(panels, addresses, strict=True)):
                    at = float(panel.volume.grid.axis(normal)[index])
                    text = f"{panel.title}, slice at {normal} = {at:.2f} mm"
                    self._images[normal, number].props.update({"src": address, "alt": text})
        finally:
            self._busy = False


def _slice_addresses(panels: Sequence[Panel], normal: str, index: int) -> list[str]:
    return [slice_image(p.volume, normal, index, p.limits, p.colours) for p in panels]


def _bars(panels: Sequence[Panel]) -> str:
    """Colour bars as HTML, one for all panels of the same range."""
    groups: dict[tuple[Any, ...], list[str]] = {}
    for panel in panels:
        groups.setdefault((panel.limits, panel.unit, panel.colours), []).append(panel.title)
    bars = []
    for ((low, high), unit, colours), titles in groups.items():
        text = " and ".join(titles)
        bars.append(
            f"<figure><figcaption>{escape(text)}{f' [{escape(unit)}]' if unit else ''}</figcaption>"
            f'<img src="{bar_image(colours)}" alt="Colours from {low:.3g} to {high:.3g} {escape(unit)}">'
            f"<span>{low + 0.0:.3g}</span><span>{high + 0.0:.3g}</span></figure>"  # no -0
        )
    return f"<div class=bars>{''.join(bars)}</div>"
