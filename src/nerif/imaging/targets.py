"""Calibration targets: chessboard, ChArUco board, grid of circles; printed by us, found by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from nerif.conventions import InputError

__all__ = ["KINDS", "Detection", "Target"]

KINDS = ("chessboard", "charuco", "circles")
DICTIONARY = "DICT_4X4_250"
MARKER = 0.6  # of a square


@dataclass(frozen=True)
class Detection:
    """What was found of a target in a picture.

    Parameters
    ----------
    ids : (n,) which points of the target
    pixels : (n, 2) where, px
    points : (n, 3) where they are on the target, mm
    """

    ids: Int[np.ndarray, " n"]
    pixels: Float[np.ndarray, "n 2"]
    points: Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Target:
    """A flat calibration target.

    Parameters
    ----------
    kind : chessboard, charuco or circles (a regular grid of black dots)
    columns, rows : chessboard and charuco: number of squares; circles: number of dots
    pitch : edge of a square, or distance between dots, mm
    marker : edge of a ChArUco marker, mm; 0 is 0.6 of a square
    dictionary : of the markers, an OpenCV name
    legacy : ChArUco boards as OpenCV drew them before version 4.6

    Raises
    ------
    InputError
        If the kind is unknown, a size is impossible, or the target looks the same turned by 180 degrees.

    Notes
    -----
    Points lie in z = 0 of the target's own frame, x along columns, y along rows down the page, so that z points into
    the page. A chessboard needs one odd and one even number of squares: otherwise nobody can tell it from itself turned
    by 180 degrees, and cameras that see it from both sides of a rig would disagree. A grid of circles always is such a
    target, so it serves for a single camera, or where all cameras are upright.
    """

    kind: str = "charuco"
    columns: int = 12
    rows: int = 9
    pitch: float = 10.0
    marker: float = 0.0
    dictionary: str = DICTIONARY
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"target kind: expected one of {', '.join(KINDS)}, got '{self.kind}'")
        least = 2 if self.kind == "circles" else 4
        if self.columns < least or self.rows < least:
            raise InputError(f"target: expected at least {least} columns and rows, got {self.columns} x {self.rows}")
        if not self.pitch > 0 or not 0 <= self.marker < self.pitch:
            raise InputError(
                f"target: expected pitch > 0 mm and a marker smaller than it, got {self.pitch} and {self.marker}"
            )
        if self.kind == "chessboard" and (self.columns + self.rows) % 2 == 0:
            raise InputError(
                f"target: a chessboard of {self.columns} x {self.rows} squares looks the same turned by 180 degrees; "
                "take one odd and one even number of squares (13 x 10, say), or ChArUco"
            )
        if self.kind == "charuco":
            import cv2

            if not hasattr(cv2.aruco, self.dictionary):
                raise InputError(f"dictionary: expected an OpenCV name such as {DICTIONARY}, got '{self.dictionary}'")

    @property
    def shape(self) -> tuple[int, int]:
        """Columns and rows of points."""
        return (self.columns, self.rows) if self.kind == "circles" else (self.columns - 1, self.rows - 1)

    @property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """All points in the target's frame, mm; the middle of the target is the origin."""
        columns, rows = self.shape
        y, x = np.mgrid[:rows, :columns].astype(np.float64)
        x, y = x - (columns - 1) / 2, y - (rows - 1) / 2
        return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * self.pitch

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the printed target, mm, with a white margin of half a pitch."""
        return (self.columns + 1) * self.pitch, (self.rows + 1) * self.pitch

    def scaled(self, factor: float) -> Target:
        """Return the same target printed `factor` times as large."""
        if not factor > 0:
            raise InputError(f"background_scale: expected a positive number, got {factor}")
        return replace(self, pitch=factor * self.pitch, marker=factor * self.marker)

    def raster(self, pixel: float) -> Float[np.ndarray, "row column"]:
        """Return the target to print as reflectance on pixels of about `pixel` mm (a whole number a square)."""
        n = max(8, round(self.pitch / pixel))
        pad = n // 2
        if self.kind == "charuco":
            inner = self._board().generateImage((self.columns * n, self.rows * n), marginSize=0) / 255.0
        elif self.kind == "chessboard":
            i, j = np.mgrid[: self.rows * n, : self.columns * n] // n
            inner = ((i + j) % 2).astype(np.float64)
        else:
            v, u = np.mgrid[: self.rows * n, : self.columns * n]
            radius = np.hypot((v % n) - (n - 1) / 2, (u % n) - (n - 1) / 2)
            inner = np.clip(radius - 0.3 * n + 0.5, 0, 1)
        return np.pad(inner, pad, constant_values=1.0)

    def raster_pixel(self, pixel: float) -> float:
        """Exact edge of a pixel of `raster`, mm."""
        return self.pitch / max(8, round(self.pitch / pixel))

    def detect(self, image: np.ndarray) -> Detection | None:
        """Find the target in a picture (8 to 16 bit or float); None where it is not found."""
        import cv2

        picture = _eight_bit(image)
        if self.kind == "chessboard":
            flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
            found, corners = cv2.findChessboardCornersSB(picture, self.shape, flags=flags)
            if not found:
                return None
            pixels = _upright(picture, corners.reshape(-1, 2).astype(np.float64), self.shape)
            return self._refined(image, np.arange(len(pixels)), pixels, 0.5)
        if self.kind == "circles":
            found, corners = cv2.findCirclesGrid(picture, self.shape, flags=cv2.CALIB_CB_SYMMETRIC_GRID)
            if not found:
                return None
            pixels = _first_at_the_upper_left(corners.reshape(-1, 2).astype(np.float64), self.shape)
            return Detection(np.arange(len(pixels)), pixels, self.points)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(self._board()).detectBoard(picture)
        if ids is None or len(ids) < 6:
            return None
        gap = (1 - (self.marker or MARKER * self.pitch) / self.pitch) / 2
        return self._refined(image, ids.ravel().astype(np.int64), corners.reshape(-1, 2).astype(np.float64), gap)

    def _refined(self, image: np.ndarray, ids: np.ndarray, pixels: np.ndarray, room: float) -> Detection | None:
        """Corners moved to their saddle points; None if fewer than six are left."""
        found, good = _saddle_points(image, pixels, room * _spacing(pixels, ids, self.shape))
        return Detection(ids[good], found[good], self.points[ids[good]]) if good.sum() >= 6 else None

    def _board(self) -> Any:
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        needed = self.columns * self.rows // 2
        if needed > len(dictionary.bytesList):
            raise InputError(
                f"dictionary: expected at least {needed} markers for {self.columns} x {self.rows} squares, "
                f"{self.dictionary} has {len(dictionary.bytesList)}"
            )
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.pitch, self.marker or MARKER * self.pitch, dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board


def _eight_bit(image: np.ndarray) -> np.ndarray:
    """Stretch the picture to eight bits."""
    low, high = np.percentile(image, (0.2, 99.8))
    scaled = (image.astype(np.float32) - low) * (255 / max(float(high - low), 1e-6))
    return np.clip(np.round(scaled), 0, 255).astype(np.uint8)


def _upright(picture: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Order corners so that the first square, beyond the first corner, is the black one of our own print."""
    columns, rows = shape
    grid = pixels.reshape(rows, columns, 2)
    (x1, y1), (x2, y2) = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if x1 * y2 - x2 * y1 < 0:  # columns to the right and rows down, not mirrored
        grid = grid[::-1]
    means = []
    for i in (0, 1):  # the inner squares next to the first corner along the first row: black where i is even
        square = grid[0:2, i : i + 2].mean(axis=(0, 1))
        means.append(float(_sample(picture, square)))
    return (grid if means[0] < means[1] else grid[::-1, ::-1]).reshape(-1, 2)


def _saddle_points(image: np.ndarray, pixels: np.ndarray, room: float) -> tuple[np.ndarray, np.ndarray]:
    """Move corners to the saddle point of the grey values around them, and tell which stay near where they were.

    A quadratic surface is fitted by least squares under a Gaussian weight, again around each new point (Lucchese &
    Mitra, Using saddle points for subpixel feature detection, 2002): 0.005 to 0.02 px on rendered pictures, where
    OpenCV's own refinements leave 0.02 to 0.05 px. `room` is the reach (px) that the fit may have: up to the markers,
    whose own edges would pull at it.
    """
    from scipy.ndimage import map_coordinates, spline_filter

    half = int(np.clip(room, 2, 7))
    y, x = (g.ravel().astype(np.float64) for g in np.mgrid[-half : half + 1, -half : half + 1])
    weight = np.exp(-((x**2 + y**2) / (half / 2) ** 2) / 4)
    fit = np.linalg.pinv(np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=-1) * weight[:, None])
    spline = spline_filter(image.astype(np.float64))
    found = pixels.copy()
    for _ in range(8):
        around = [found[:, 1:] + y, found[:, :1] + x]
        grey = map_coordinates(spline, around, order=3, prefilter=False, mode="nearest") * weight
        a, b, c, d, e, _ = fit @ grey.T
        determinant = 4 * a * c - b * b
        determinant = np.where(determinant < 0, determinant, -np.inf)  # a hill or a hollow: stay
        step = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], axis=-1) / determinant[:, None]
        found = found + np.clip(step, -1, 1)
        if np.abs(step).max() < 1e-4:
            break
    return found, np.linalg.norm(found - pixels, axis=1) < max(2.0, 0.3 * half)


def _sample(picture: np.ndarray, where: np.ndarray) -> float:
    """Mean of 3 x 3 pixels."""
    u, v = np.round(where).astype(int)
    return float(picture[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].mean())


def _first_at_the_upper_left(pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Order circles so that rows go down and columns to the right in the picture."""
    columns, rows = shape
    grid = pixels.reshape(rows, columns, 2)
    if grid[0, 0, 1] + grid[0, -1, 1] > grid[-1, 0, 1] + grid[-1, -1, 1]:
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def _spacing(pixels: np.ndarray, ids: np.ndarray, shape: tuple[int, int]) -> float:
    """Shortest distance between neighbouring points in the picture, px."""
    where = {int(i): p for i, p in zip(ids, pixels, strict=True)}
    columns, _ = shape
    near = [
        float(np.linalg.norm(where[i] - where[j]))
        for i in where
        for j in (i + 1, i + columns)
        if j in where and not (j == i + 1 and j % columns == 0)
    ]
    return min(near, default=8.0)
