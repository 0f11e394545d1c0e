"""Backgrounds and calibration targets as files to print at true size."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import atomic
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.patterns import Background

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["paper_for", "print_pattern"]

MARGIN = 8.0  # mm of paper around a pattern, for its scale bar
PAGES = {"A4": (297, 210), "A3": (420, 297), "A2": (594, 420), "A1": (841, 594), "A0": (1189, 841)}  # mm
LARGEST = 400e6  # pixels of a raster: more would not fit into the memory of a laptop


def print_pattern(path: Path, pattern: Background | CalibrationTarget, dpi: float = 600.0) -> None:
    """Write a pattern at true size: PNG (with its resolution in the file) or PDF (with a scale bar to check the print).

    Parameters
    ----------
    path : NAME.png or NAME.pdf
    pattern : what to print
    dpi : of the printer; the raster is coarser where the pattern has no use for so many

    Raises
    ------
    InputError
        If the name ends in neither, or the raster would be too large.
    """
    if path.suffix not in (".pdf", ".png"):
        raise InputError(f"out: expected a name ending in .pdf or .png, got '{path.name}'")
    if not dpi > 0:
        raise InputError(f"dpi: expected a positive number, got {dpi}")
    pixel = pattern.raster_pixel(25.4 / dpi)
    width, height = pattern.size
    pixels = width * height / pixel**2
    if pixels > LARGEST:
        raise InputError(f"width, height: expected at most {LARGEST:.0e} pixels, got {pixels:.1e}; give fewer --dpi")
    raster = pattern.raster(pixel)
    with atomic(path) as part:
        if path.suffix == ".png":
            import imageio.v3 as iio

            iio.imwrite(part, np.round(raster * 255).astype(np.uint8), dpi=(25.4 / pixel, 25.4 / pixel))
        else:
            _page(raster, pixel, pattern.label).savefig(part)


def paper_for(path: Path, pattern: Background | CalibrationTarget) -> str:
    """Return the smallest paper on which the file of a pattern fits: A4 to A0, or a plotter's."""
    margin = 2 * MARGIN if path.suffix == ".pdf" else 0
    short, long = sorted(length + margin for length in pattern.size)
    return next((name for name, (a, b) in PAGES.items() if long <= a and short <= b), "a plotter")


def _page(raster: np.ndarray, pixel: float, label: str) -> Figure:
    """A page of the pattern's own size with a margin, one millimetre of data to a millimetre of paper."""
    from matplotlib.figure import Figure

    height, width = (n * pixel for n in raster.shape)
    page = width + 2 * MARGIN, height + 2 * MARGIN
    figure = Figure(figsize=(page[0] / 25.4, page[1] / 25.4), dpi=25.4 / pixel)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, page[0]), ylim=(page[1], 0), autoscale_on=False)
    axes.axis("off")
    extent = (MARGIN, MARGIN + width, MARGIN + height, MARGIN)
    axes.imshow(raster, cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="none", aspect="auto")
    bar = next((b for b in (100.0, 50.0, 20.0, 10.0) if b <= width), width)
    y = page[1] - 0.6 * MARGIN
    axes.plot([MARGIN, MARGIN + bar], [y, y], color="black", linewidth=1, solid_capstyle="butt")
    axes.text(MARGIN, y + 0.45 * MARGIN, f"{bar:g} mm   {label}", fontsize=6)
    return figure
