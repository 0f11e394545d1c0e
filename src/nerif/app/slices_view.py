"""Slices across z, y and x, of one volume or of several on one grid side by side: one slider an axis moves them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from nicegui import ui

from nerif.app.range_slider import RangeSlider
from nerif.app.workspace import Workspace
from nerif.data.volume import Volume
from nerif.geometry import Grid
from nerif.report.slice_images import bar_image, slice_aspect, slice_image

__all__ = ["Panel", "SlicesView"]

NORMALS = "zyx"


@dataclass(frozen=True)
class Panel:
    """One volume, as it is shown.

    Parameters
    ----------
    title : for people
    volume : all panels of a view have the same grid
    limits : ends of its colours, in `unit`
    unit : of the values
    colours : name of a Matplotlib colour map
    """

    title: str
    volume: Volume
    limits: tuple[float, float]
    unit: str
    colours: str


class SlicesView:
    """Slices of panels, where the page is being built."""

    def __init__(self, work: Workspace) -> None:
        self.work = work
        self.panels: Sequence[Panel] = ()
        self._at = dict.fromkeys(NORMALS, 0.5)  # along each axis, over its length
        self._waiting: set[str] = set()
        self._busy = False
        self._built: tuple[Any, ...] = ()
        self._images: dict[tuple[str, int], Any] = {}
        self._bars = ui.html("", sanitize=False)
        self._place = ui.element("div")

    async def show(self, panels: Sequence[Panel]) -> None:
        """Show these from now on, at the same places."""
        self.panels = panels
        built = tuple(p.title for p in panels), panels[0].volume.grid if panels else None
        if built != self._built:
            self._built = built
            self._build()
        self._bars.set_content(_bars(panels))
        self._waiting |= set(NORMALS)
        await self._draw()

    def _build(self) -> None:
        self._place.clear()
        self._images = {}
        many = len(self.panels) > 1
        self._place.classes(replace=f"cuts {'many' if many else 'one'}")
        if not self.panels:
            return
        with self._place:
            for normal in NORMALS:
                with ui.element("div").classes("cut"):
                    self._cut(normal, self.panels[0].volume.grid)

    def _cut(self, normal: str, grid: Grid) -> None:
        along = grid.axis(normal)

        async def move(index: int) -> None:
            self._at[normal] = (index + 0.5) / len(along)
            self._waiting.add(normal)
            await self._draw()

        RangeSlider(
            f"Slice across {normal}", len(along) - 1, self._index(normal), lambda i: f"{float(along[i]):.2f} mm", move
        )
        with ui.element("div").classes("panels"):
            for number, panel in enumerate(self.panels):
                aspect = slice_aspect(panel.volume, normal)
                with ui.element("figure"):
                    image = ui.element("img").style(f"aspect-ratio: {aspect:.4f}; --aspect: {aspect:.4f}")
                    self._images[normal, number] = image
                    if len(self.panels) > 1:
                        ui.html(f"<figcaption>{escape(panel.title)}</figcaption>", sanitize=False)

    def _index(self, normal: str) -> int:
        count = self.panels[0].volume.grid.shape["zyx".index(normal)]
        return min(int(self._at[normal] * count), count - 1)

    async def _draw(self) -> None:
        """Draw what has moved; what moves meanwhile is drawn after it, the last place only."""
        if self._busy:
            return
        self._busy = True
        try:
            while self._waiting:
                normal = self._waiting.pop()
                panels, index = self.panels, self._index(normal) if self.panels else 0
                plot = await self.work.beside(_drawn, panels, normal, index)
                if panels is self.panels:
                    self._put(normal, index, plot)
        finally:
            self._busy = False

    def _put(self, normal: str, index: int, plot: Sequence[str]) -> None:
        for number, (panel, address) in enumerate(zip(self.panels, plot, strict=True)):
            at = float(panel.volume.grid.axis(normal)[index])
            image = self._images[normal, number]
            image.props["src"] = address
            image.props["alt"] = f"{panel.title}, slice at {normal} = {at:.2f} mm"
            image.update()


def _drawn(panels: Sequence[Panel], normal: str, index: int) -> list[str]:
    return [slice_image(p.volume, normal, index, p.limits, p.colours) for p in panels]


def _bars(panels: Sequence[Panel]) -> str:
    """Colour bars: one for all panels that share it."""
    shared: dict[tuple[Any, ...], list[str]] = {}
    for panel in panels:
        shared.setdefault((panel.limits, panel.unit, panel.colours), []).append(panel.title)
    bars = []
    for ((low, high), unit, colours), titles in shared.items():
        text = " and ".join(titles)
        bars.append(
            f"<figure><figcaption>{escape(text)}{f' [{escape(unit)}]' if unit else ''}</figcaption>"
            f'<img src="{bar_image(colours)}" alt="Colours from {low:.3g} to {high:.3g} {escape(unit)}">'
            f"<span>{low + 0.0:.3g}</span><span>{high + 0.0:.3g}</span></figure>"  # no -0
        )
    return f"<div class=bars>{''.join(bars)}</div>"
