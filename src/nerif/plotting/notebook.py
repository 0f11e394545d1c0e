"""Notebook display: an image and a short table as self-contained HTML; and formatted numbers."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import percent, with_unit
from nerif.plotting.drawing import (
    Drawable,
    add_colour_bar,
    colour_range,
    draw_map,
    draw_slices,
    label_of,
    map_range,
    plain,
    plotted_values,
    style,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["figure_of_slices", "image", "number", "panel", "show_slices", "show_views", "span"]

SLICES = (8.5, 2.8)  # inches
VIEWS = 9  # to draw at most, evenly spaced
PIXELS = 120  # along an edge of a view, enough at its size on the page


def number(value: object, digits: int = 4) -> str:
    """Return a formatted number, with a power of ten if it is small or large; a dash for anything else."""
    if not isinstance(value, int | float) or not np.isfinite(value):
        return "–"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return f"{float(f'{value:.{digits}g}'):.10g}"
    mantissa, exponent = f"{value:.{max(digits - 1, 0)}e}".split("e")
    raised = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{float(mantissa):g} × 10{raised}"


def span(values: Float[np.ndarray, ...], unit: str = "1", digits: int = 3) -> str:
    """Return the values below and above which a thousandth is, with their unit, and the masked fraction (NaN)."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return "masked everywhere"
    share = 1 - finite.size / values.size
    masked = f"; {percent(share, 2)} masked" if share else ""
    low, high = (number(float(x), digits) for x in np.quantile(finite, [0.001, 0.999]))
    return f"{with_unit(f'{low} to {high}', unit)} (0.1 to 99.9 % of the voxels){masked}"


def panel(title: str, rows: Sequence[tuple[str, str]], *images: tuple[str, str]) -> str:
    """Return HTML of a title, images (data URL, description) and a table of names and values."""
    cells = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in rows
    )
    tags = "".join(
        f'<img src="{image}" alt="{escape(alt)}" style="display:block;max-width:100%">' for image, alt in images
    )
    return f"<div><p><b>{escape(title)}</b></p>{tags}<table><tbody>{cells}</tbody></table></div>"


def image(draw: Callable[[Figure], object], width: float, height: float, size: float = 8.0, form: str = "png") -> str:
    """Return a figure of a width and height (inches), with text of `size` points, as a data URL of a PNG or SVG."""
    from matplotlib.figure import Figure

    with style(size):
        figure = Figure(figsize=(width, height), layout="constrained")
        draw(figure)
        buffer = io.BytesIO()
        metadata = {"Date": None, "Creator": None} if form == "svg" else None  # the same page from the same result
        figure.savefig(buffer, format=form, dpi=110, metadata=metadata)
    return f"data:image/{'svg+xml' if form == 'svg' else form};base64," + base64.b64encode(buffer.getvalue()).decode()


def show_slices(volume: Drawable) -> str:
    """Return the three middle slices of a volume as a data URL of a PNG."""

    return image(lambda figure: _draw_slices(figure, volume), *SLICES)


def figure_of_slices(volume: Drawable) -> Figure:
    """Return the three middle slices of a volume as a figure of pyplot."""
    from matplotlib import pyplot

    with style(8.0):
        figure = pyplot.figure(figsize=SLICES, layout="constrained")
        _draw_slices(figure, volume)
    return figure


def _draw_slices(figure: Figure, volume: Drawable) -> None:
    line = list(figure.subplots(1, 3))
    draw_slices(line, volume, colour_range(plotted_values(volume)))
    add_colour_bar(line, label_of(volume.quantity))


def show_views(
    names: Sequence[str], maps: Sequence[Float[np.ndarray, "row column c"]], components: Sequence[str], label: str,
    signed: bool = True,
) -> str:  # fmt: skip
    """Return the maps of the views, one row per component, as a data URL of a PNG.

    Parameters
    ----------
    components : names of the channels
    label : of the colour bar, with the unit
    signed : whether values may be negative
    """
    indices = np.unique(np.linspace(0, len(names) - 1, min(len(names), VIEWS)).round().astype(int))
    limits = map_range(np.concatenate([m[np.isfinite(m)] for m in maps]), signed, 0.998)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(len(components), len(indices), squeeze=False)
        for column, view in enumerate(indices):
            for row, component in enumerate(components):
                axes = draw_map(grid[row, column], maps[view][..., row], limits)
                axes.set(xticks=[], yticks=[], xlabel="", ylabel="" if column else component)
            grid[0, column].set_title(plain(names[view]))
        add_colour_bar(list(grid.ravel()), label)

    return image(draw, min(9.5, 1.6 + 1.1 * len(indices)), 0.5 + 1.15 * len(components))
