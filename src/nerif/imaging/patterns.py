"""Backgrounds (random dots, wavelet noise, multi-scale noise) and calibration targets, printed at true size.

A pattern is a raster of reflectance, 0 black to 1 white. The dot size is the length of its smallest features on paper;
in the image it should be 2 to 5 px (Raffel, Background-oriented schlieren techniques, Exp. Fluids 56 (2015)).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from annotated_types import Gt, Le, Lt

from nerif.common.conventions import InputError
from nerif.common.files import atomic, ending
from nerif.common.settings import check_settings
from nerif.imaging.calibration.targets import CalibrationTarget

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["KINDS", "Background", "paper_for", "print_pattern"]

Length = Annotated[float, Gt(0), Lt(1e5)]
KINDS = ("dots", "wavelet", "multiscale")
MAX_PIXELS_PER_DOT = 12  # finer rasters look the same


@dataclass(frozen=True)
class Background:
    """A printed background.

    Sources: wavelet noise: Cook & DeRose, ACM Trans. Graph. 24 (2005) 803; its use for schlieren, and features on all
    scales: Atcheson et al., Exp. Fluids 46 (2009) 467.
    """

    kind: Literal[*KINDS] = "dots"  # type: ignore[valid-type]
    """dots (random, hardly overlapping), wavelet (band-limited noise) or multiscale (noise on all scales)."""
    width: Length = 200.0
    """Width of the pattern, mm."""
    height: Length = 200.0
    """Height of the pattern, mm."""
    dot: Length = 1.0
    """Diameter of a dot, or the smallest feature of a noise, mm: 2 to 5 px in the image (nerif design)."""
    fill: Annotated[float, Gt(0), Le(0.6)] = 0.35
    """Share of the paper covered by dots."""
    seed: int = 0
    """Seed of the pattern; different for each camera."""

    def __post_init__(self) -> None:
        check_settings(self)
        if 4 * self.dot > (edge := min(self.width, self.height)):
            raise InputError(f"expected a quarter of the pattern ({edge:g} mm) or less, got {self.dot}", field="dot")

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, mm."""
        return self.width, self.height

    @property
    def label(self) -> str:
        """Description in one line."""
        return f"{self.kind}, {self.dot:g} mm, seed {self.seed}"

    def raster_pixel(self, pixel: float) -> float:
        """Return the edge of the raster's pixels, mm: `pixel`, or larger if the pattern allows it."""
        return max(pixel, self.dot / MAX_PIXELS_PER_DOT)

    def raster(self, pixel: float) -> np.ndarray:
        """Return the pattern as reflectance (row, column) from 0 to 1 on pixels of `pixel` mm."""
        if not 0 < pixel <= self.dot / 2:
            raise InputError(f"expected half the dot size ({self.dot / 2:g} mm) or less, got {pixel} mm", field="pixel")
        shape = (max(1, round(self.height / pixel)), max(1, round(self.width / pixel)))
        if self.kind == "dots":
            return self._draw_dots(shape, pixel)
        noise = self._wavelet(shape, pixel) if self.kind == "wavelet" else self._multiscale(shape, pixel)
        return np.asarray(np.clip(0.5 + noise / (4 * noise.std()), 0, 1))  # two standard deviations fill the range

    def dots(self) -> np.ndarray:
        """Return the centres (n, 2) of the dots, mm from the upper left corner; none nearer than 0.9 diameters."""
        from scipy.spatial import cKDTree

        count = round(self.fill * self.width * self.height / (np.pi * self.dot**2 / 4))
        rng = np.random.default_rng(self.seed)
        size = np.array([self.width, self.height])
        centres = np.empty((0, 2))
        for _ in range(60):  # drop the later one of any two that are too close
            if count <= len(centres):
                break
            candidates = np.concatenate([centres, rng.random((count - len(centres), 2)) * size])
            pairs = cKDTree(candidates).query_pairs(0.9 * self.dot, output_type="ndarray")
            keep = np.ones(len(candidates), dtype=bool)
            keep[pairs.max(axis=1)] = False
            centres = candidates[keep]
        return centres

    def _draw_dots(self, shape: tuple[int, int], pixel: float) -> np.ndarray:
        """Dots with edges blurred over one pixel."""
        image = np.ones(shape)
        radius = self.dot / 2 / pixel
        reach = int(np.ceil(radius + 1))
        offsets = np.arange(-reach, reach + 1)
        for x, y in self.dots() / pixel - 0.5:
            i, j = round(y), round(x)
            rows, columns = i + offsets, j + offsets
            rows, columns = rows[(rows >= 0) & (rows < shape[0])], columns[(columns >= 0) & (columns < shape[1])]
            distance = np.hypot(rows[:, None] - y, columns[None, :] - x)
            patch = image[rows[:, None], columns]
            image[rows[:, None], columns] = np.minimum(patch, np.clip(distance - radius + 0.5, 0, 1))
        return image

    def _wavelet(self, shape: tuple[int, int], pixel: float) -> np.ndarray:
        """One octave of noise: white noise minus its part on a lattice of twice the spacing."""
        from scipy.ndimage import zoom

        cells = [max(8, 2 * int(np.ceil(n * pixel / self.dot / 2)) + 8) for n in shape]
        white = np.random.default_rng(self.seed).standard_normal(cells)
        coarse = zoom(white, 0.5, order=3, mode="grid-wrap", grid_mode=True)
        band = white - zoom(coarse, 2, order=3, mode="grid-wrap", grid_mode=True)
        return _spread(band, shape, self.dot / pixel)

    def _multiscale(self, shape: tuple[int, int], pixel: float) -> np.ndarray:
        """Octaves of smoothed white noise of equal strength, from the dot size to a quarter of the pattern."""
        total = np.zeros(shape)
        size, octave = self.dot, 0
        while octave == 0 or size <= min(self.width, self.height) / 4:
            rng = np.random.default_rng([self.seed, octave])
            cells = [int(np.ceil(n * pixel / size)) + 8 for n in shape]
            noise = _spread(rng.standard_normal(cells), shape, size / pixel)
            total += noise / noise.std()
            size, octave = 2 * size, octave + 1
        return total


def _spread(cells: np.ndarray, shape: tuple[int, int], spacing: float) -> np.ndarray:
    """Interpolate a lattice with a border of cells to the pixels by cubic splines."""
    from scipy.ndimage import map_coordinates

    rows, columns = ((np.arange(n) + 0.5) / spacing + 3 for n in shape)
    return np.asarray(map_coordinates(cells, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="nearest"))


MARGIN = 8.0  # of paper around a pattern, for its scale bar, mm
PAGES = {"A4": (297, 210), "A3": (420, 297), "A2": (594, 420), "A1": (841, 594), "A0": (1189, 841)}  # mm
MAX_PIXELS = 400e6  # of a raster, limited by the memory of a laptop


def print_pattern(path: Path, pattern: Background | CalibrationTarget, dpi: float = 600.0) -> None:
    """Write a pattern at true size: NAME.png with its resolution, or NAME.pdf with a scale bar to check the print.

    `dpi` is an upper limit of the resolution, which coarse patterns do not need.
    """
    if ending(path) not in (".pdf", ".png"):
        raise InputError(f"expected a name ending in .pdf or .png, got '{path.name}'", field="out")
    if not dpi > 0:
        raise InputError(f"expected a positive number, got {dpi}", field="dpi")
    pixel = pattern.raster_pixel(25.4 / dpi)
    width, height = pattern.size
    pixels = width * height / pixel**2
    if pixels > MAX_PIXELS:
        raise InputError(f"expected up to {MAX_PIXELS:.0e} pixels, got {pixels:.1e}; lower dpi", field="width, height")
    raster = pattern.raster(pixel)
    with atomic(path) as part:
        if ending(path) == ".png":
            from PIL import Image

            resolution = 25.4 / pixel
            Image.fromarray(np.round(raster * 255).astype(np.uint8)).save(part, "PNG", dpi=(resolution, resolution))
        else:
            _page(raster, pixel, pattern.label).savefig(part)


def paper_for(path: Path, pattern: Background | CalibrationTarget) -> str:
    """Return the smallest paper for the file of a pattern: A4 to A0, or a plotter."""
    margin = 2 * MARGIN if ending(path) == ".pdf" else 0
    short, long = sorted(length + margin for length in pattern.size)
    return next((name for name, (a, b) in PAGES.items() if long <= a and short <= b), "a plotter")


def _page(raster: np.ndarray, pixel: float, label: str) -> Figure:
    """A page of the pattern's size with a margin, in coordinates of mm."""
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
