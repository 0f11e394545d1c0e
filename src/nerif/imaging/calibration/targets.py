"""Calibration targets: chessboard, ChArUco board, grid of circles; printed by us, found by OpenCV."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from nerif.common.conventions import InputError
from nerif.imaging.calibration.corners import (
    eight_bit,
    first_at_a_black_square,
    first_at_the_upper_left,
    saddle_points,
    spacing,
)

__all__ = ["KINDS", "CalibrationTarget", "Detection", "ViewImages"]

KINDS = ("chessboard", "charuco", "circles")
DICTIONARY = "DICT_4X4_250"
MARKER = 0.6  # of a square


@dataclass(frozen=True)
class Detection:
    """What was found of a target in an image.

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
class ViewImages:
    """What was found in the images of one camera.

    Parameters
    ----------
    name : of the camera
    size : (height, width) of its images, px
    poses : the target free in space, by the name of the pose, which cameras share
    background : the target laid on the background, by the name of the image
    """

    name: str
    size: tuple[int, int]
    poses: Mapping[str, Detection]
    background: Mapping[str, Detection]

    def without(self, names: Collection[str]) -> ViewImages:
        """Return what was found but for the images of these names."""
        poses, background = (
            {pose: d for pose, d in found.items() if f"{self.name}/{source}/{pose}" not in names}
            for source, found in (("target", self.poses), ("background", self.background))
        )
        return replace(self, poses=poses, background=background)


@dataclass(frozen=True)
class CalibrationTarget:
    """A flat calibration target.

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
    """chessboard, charuco or circles (a regular grid of black dots)."""
    columns: int = 12
    """Squares (dots of circles) along a row."""
    rows: int = 9
    """Squares (dots of circles) along a column."""
    pitch: float = 10.0
    """Edge of a square, or distance between dots, mm."""
    marker: float = 0.0
    """Edge of a ChArUco marker, mm; 0 is 0.6 of a square."""
    dictionary: str = DICTIONARY
    """Of the markers, an OpenCV name."""
    legacy: bool = False
    """ChArUco boards as OpenCV drew them before version 4.6."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"expected one of {', '.join(KINDS)}, got '{self.kind}'", field="target kind")
        least = 2 if self.kind == "circles" else 4
        if self.columns < least or self.rows < least:
            raise InputError(
                f"expected at least {least} columns and rows, got {self.columns} x {self.rows}", field="target"
            )
        if not self.pitch > 0 or not 0 <= self.marker < self.pitch:
            raise InputError(
                f"expected pitch > 0 mm and a marker smaller than it, got {self.pitch} and {self.marker}",
                field="target",
            )
        if self.kind == "chessboard" and (self.columns + self.rows) % 2 == 0:
            raise InputError(
                f"a chessboard of {self.columns} x {self.rows} squares looks the same turned by 180 degrees; "
                "take one odd and one even number of squares (13 x 10, say), or ChArUco",
                field="target",
            )
        if self.kind == "charuco":
            import cv2

            if not hasattr(cv2.aruco, self.dictionary):
                raise InputError(
                    f"expected an OpenCV name such as {DICTIONARY}, got '{self.dictionary}'", field="dictionary"
                )

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

    @property
    def label(self) -> str:
        """What it is, in a line."""
        return f"{self.kind} {self.columns} x {self.rows}, pitch {self.pitch:g} mm"

    def scaled(self, factor: float) -> CalibrationTarget:
        """Return the same target printed `factor` times as large."""
        if not factor > 0:
            raise InputError(f"expected a positive number, got {factor}", field="background_scale")
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
        """Find the target in an image (8 to 16 bit or float); None where it is not found."""
        import cv2

        image = eight_bit(image)
        if self.kind == "chessboard":
            flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
            found, corners = cv2.findChessboardCornersSB(image, self.shape, flags=flags)
            if not found:
                return None
            pixels = first_at_a_black_square(image, corners.reshape(-1, 2).astype(np.float64), self.shape)
            return self._refined(image, np.arange(len(pixels)), pixels, 0.5)
        if self.kind == "circles":
            found, corners = cv2.findCirclesGrid(image, self.shape, flags=cv2.CALIB_CB_SYMMETRIC_GRID)
            if not found:
                return None
            pixels = first_at_the_upper_left(corners.reshape(-1, 2).astype(np.float64), self.shape)
            return Detection(np.arange(len(pixels)), pixels, self.points)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(self._board()).detectBoard(image)
        if ids is None or len(ids) < 6:
            return None
        gap = (1 - (self.marker or MARKER * self.pitch) / self.pitch) / 2
        return self._refined(image, ids.ravel().astype(np.int64), corners.reshape(-1, 2).astype(np.float64), gap)

    def _refined(self, image: np.ndarray, ids: np.ndarray, pixels: np.ndarray, room: float) -> Detection | None:
        """Corners moved to their saddle points; None if fewer than six are left."""
        found, good = saddle_points(image, pixels, room * spacing(pixels, ids, self.shape))
        return Detection(ids[good], found[good], self.points[ids[good]]) if good.sum() >= 6 else None

    def _board(self) -> Any:
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        needed = self.columns * self.rows // 2
        if needed > len(dictionary.bytesList):
            raise InputError(
                f"expected at least {needed} markers for {self.columns} x {self.rows} squares, "
                f"{self.dictionary} has {len(dictionary.bytesList)}",
                field="dictionary",
            )
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.pitch, self.marker or MARKER * self.pitch, dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board
