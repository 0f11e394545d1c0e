"""Backgrounds to print: random dots, wavelet noise, multi-scale noise.

A pattern is a raster of reflectance, 0 black to 1 white. The dot size is the length of its smallest features on paper;
seen by the camera it should cover 2 to 5 px (Raffel, Background-oriented schlieren techniques, Exp. Fluids 56 (2015)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerif.common.conventions import InputError

__all__ = ["KINDS", "Background"]

KINDS = ("dots", "wavelet", "multiscale")
FINEST = 12  # pixels over a dot: more would not show


@dataclass(frozen=True)
class Background:
    """A printed background.

    Raises
    ------
    InputError
        If the kind is unknown, a length is not positive, or fill is not between 0 and 0.6.

    Source: wavelet noise as in Cook & DeRose, ACM Trans. Graph. 24 (2005) 803; used for schlieren by Atcheson et al.,
    Exp. Fluids 46 (2009) 467, from where the idea of features on all scales comes too.
    """

    kind: str = "dots"
    """dots (random, hardly overlapping), wavelet (band-limited noise) or multiscale (noise on all scales)."""
    width: float = 200.0
    """Width of the pattern, mm."""
    height: float = 200.0
    """Height of the pattern, mm."""
    dot: float = 1.0
    """Diameter of a dot, or the smallest feature of a noise, mm: 2 to 5 px in the picture (nerif design)."""
    fill: float = 0.35
    """Share of the paper that dots cover."""
    seed: int = 0
    """Of the pattern: give each camera another one."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"kind: expected one of {', '.join(KINDS)}, got '{self.kind}'")
        for name in ("width", "height", "dot"):
            if not 0 < getattr(self, name) < 1e5:
                raise InputError(f"{name}: expected a positive length in mm, got {getattr(self, name)}")
        if not 0 < self.fill <= 0.6:
            raise InputError(f"fill: expected a share of the paper between 0 and 0.6, got {self.fill}")
        if 4 * self.dot > min(self.width, self.height):
            raise InputError(
                f"dot: expected a quarter of the pattern ({min(self.width, self.height):g} mm) or less, got {self.dot}"
            )

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, mm."""
        return self.width, self.height

    @property
    def label(self) -> str:
        """What it is, in a line."""
        return f"{self.kind}, {self.dot:g} mm, seed {self.seed}"

    def raster_pixel(self, pixel: float) -> float:
        """Edge of a pixel fine enough for the pattern and not finer than `pixel`, mm."""
        return max(pixel, self.dot / FINEST)

    def raster(self, pixel: float) -> np.ndarray:
        """Return the pattern as reflectance (row, column) from 0 to 1 on pixels of `pixel` mm.

        Raises
        ------
        InputError
            If a pixel is longer than half a dot, which it could not show.
        """
        if not 0 < pixel <= self.dot / 2:
            raise InputError(f"pixel: expected half the dot size ({self.dot / 2:g} mm) or less, got {pixel} mm")
        shape = (max(1, round(self.height / pixel)), max(1, round(self.width / pixel)))
        if self.kind == "dots":
            return self._draw_dots(shape, pixel)
        noise = self._wavelet(shape, pixel) if self.kind == "wavelet" else self._multiscale(shape, pixel)
        return np.asarray(np.clip(0.5 + noise / (4 * noise.std()), 0, 1))  # two standard deviations fill the range

    def dots(self) -> np.ndarray:
        """Return the centres (n, 2) of the dots, mm from the upper left corner; none nearer than 0.9 diameters."""
        from scipy.spatial import cKDTree

        wanted = round(self.fill * self.width * self.height / (np.pi * self.dot**2 / 4))
        rng = np.random.default_rng(self.seed)
        size = np.array([self.width, self.height])
        centres = np.empty((0, 2))
        for _ in range(60):  # draw, and drop the later one of any two that come too close
            missing = wanted - len(centres)
            if missing <= 0:
                break
            drawn = np.concatenate([centres, rng.random((missing, 2)) * size])
            pairs = cKDTree(drawn).query_pairs(0.9 * self.dot, output_type="ndarray")
            keep = np.ones(len(drawn), dtype=bool)
            keep[pairs.max(axis=1)] = False
            centres = drawn[keep]
        return centres

    def _draw_dots(self, shape: tuple[int, int], pixel: float) -> np.ndarray:
        """Dots with edges one pixel soft."""
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
        """One octave of noise: white noise less what a twice coarser lattice can hold."""
        from scipy.ndimage import zoom

        cells = [max(8, 2 * int(np.ceil(n * pixel / self.dot / 2)) + 8) for n in shape]
        white = np.random.default_rng(self.seed).standard_normal(cells)
        coarse = zoom(white, 0.5, order=3, mode="grid-wrap", grid_mode=True)
        band = white - zoom(coarse, 2, order=3, mode="grid-wrap", grid_mode=True)
        return _spread(band, shape, self.dot / pixel)

    def _multiscale(self, shape: tuple[int, int], pixel: float) -> np.ndarray:
        """Octaves of smoothed white noise from the dot size up to a quarter of the pattern, equally strong."""
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
    """Lay a lattice of values over the pixels by cubic splines; a border of cells is left over on each side."""
    from scipy.ndimage import map_coordinates

    rows, columns = ((np.arange(n) + 0.5) / spacing + 3 for n in shape)
    return np.asarray(map_coordinates(cells, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="nearest"))
