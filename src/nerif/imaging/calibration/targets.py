"""Calibration targets: chessboard, ChArUco board, grid of circles; to print, and to detect in images with OpenCV."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from nerif.common.conventions import InputError
from nerif.common.settings import check_settings
from nerif.imaging.calibration.dot_grid import dot_grid, find_dots

__all__ = [
    "KINDS", "CalibrationTarget", "Detection", "TargetDetections", "eight_bit", "marker_parameters", "marker_squares",
    "saddle_points",
]  # fmt: skip

KINDS = ("chessboard", "charuco", "circles")
DICTIONARY = "DICT_4X4_250"
MARKER = 0.6  # edge of a marker over that of a square
MIN_POINTS = 6  # of a detection
MIN_BEYOND = 2  # markers by which a ChArUco board is larger than in the settings
MAX_OFFSET = 0.25  # of a marker from its square, in squares
MIN_EDGE = 8.0  # of a marker, px
TURN = np.radians(20.0)  # of a grid of dots in the image, least ambiguous


@dataclass(frozen=True)
class Detection:
    """The points of a target in an image."""

    ids: Int[np.ndarray, " n"]  #: (n,) their numbers on the target
    pixels: Float[np.ndarray, "n 2"]  #: (n, 2) their places in the image, px
    points: Float[np.ndarray, "n 3"]  #: (n, 3) their places on the target, mm
    negative: bool = False  #: the target is white on black


@dataclass(frozen=True)
class TargetDetections:
    """Detections in the images of one camera."""

    name: str
    size: tuple[int, int]  #: (height, width) of its images, px
    poses: Mapping[str, Detection]  #: the target free in space, by the name of the pose, which cameras share
    background: Mapping[str, Detection]  #: the target on the background, by the name of the image
    diagnosis: str = ""  #: why few images of the target have a detection; empty if many have

    def without(self, names: Collection[str]) -> TargetDetections:
        """Return the detections except those in images of these names, such as cam1/target/7."""
        poses, background = (
            {pose: d for pose, d in detections.items() if f"{self.name}/{source}/{pose}" not in names}
            for source, detections in (("target", self.poses), ("background", self.background))
        )
        return replace(self, poses=poses, background=background)


@dataclass(frozen=True)
class CalibrationTarget:
    """A flat calibration target.

    Its points lie in z = 0 of its own frame, x along columns, y along rows down the page, so z points into the page. A
    chessboard needs one odd and one even number of squares: otherwise it looks the same turned by 180 degrees, and
    cameras that see it from both sides of a rig would disagree. A grid of circles always does, so it serves for a
    single camera, or where all cameras are upright.
    """

    kind: Literal[*KINDS] = "charuco"  # type: ignore[valid-type]
    """chessboard, charuco or circles (a regular grid of dots, black on white or white on black)."""
    columns: int = 12
    """Number of squares (circles: dots) along a row."""
    rows: int = 9
    """Number of squares (circles: dots) along a column."""
    pitch: float = 10.0
    """Edge length of a square, or distance between dots, mm."""
    marker: float = 0.0
    """Edge length of a ChArUco marker, mm; 0: 0.6 of a square."""
    dictionary: str = DICTIONARY
    """Dictionary of the markers, by its name in OpenCV."""
    legacy: bool = False
    """ChArUco board in the layout of OpenCV before version 4.6."""

    def __post_init__(self) -> None:
        check_settings(self)
        size, minimum = f"{self.columns} x {self.rows}", 2 if self.kind == "circles" else 4
        if self.columns < minimum or self.rows < minimum:
            raise InputError(f"expected at least {minimum} columns and rows, got {size}", field="target")
        if not self.pitch > 0 or not 0 <= self.marker < self.pitch:
            got = f"{self.pitch} and {self.marker}"
            raise InputError(f"expected pitch > 0 mm and a marker smaller than it, got {got}", field="target")
        if self.kind == "chessboard" and (self.columns + self.rows) % 2 == 0:
            raise InputError(
                f"expected a chessboard of one odd and one even number of squares (13 x 10, say), got {size}, which "
                "looks the same turned by 180 degrees; or use ChArUco",
                field="target",
            )
        if self.kind == "charuco" and self.dictionary != DICTIONARY:
            import cv2

            if not hasattr(cv2.aruco, self.dictionary):
                name = self.dictionary
                raise InputError(f"expected an OpenCV name such as {DICTIONARY}, got '{name}'", field="dictionary")

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of columns and rows of points."""
        return (self.columns, self.rows) if self.kind == "circles" else (self.columns - 1, self.rows - 1)

    @property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """All points in the target's frame, mm; its origin is the middle of the target."""
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
        """Kind, numbers and pitch in a line."""
        return f"{self.kind} {self.columns} x {self.rows}, pitch {self.pitch:g} mm"

    def scaled(self, factor: float) -> CalibrationTarget:
        """Return the same target printed `factor` times as large."""
        if not factor > 0:
            raise InputError(f"expected a positive number, got {factor}", field="background_scale")
        return replace(self, pitch=factor * self.pitch, marker=factor * self.marker)

    def raster(self, pixel: float) -> Float[np.ndarray, "row column"]:
        """Return the reflectance of the printed target on pixels of about `pixel` mm (a whole number per square)."""
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
        """Return the exact pixel size of `raster`, mm."""
        return self.pitch / max(8, round(self.pitch / pixel))

    def detect(self, image: np.ndarray, negative: bool = False) -> Detection | None:
        """Return the target in an image (8 to 16 bit or float), black on white or (first, if `negative`) inverse."""
        image = eight_bit(image)
        if self.kind == "chessboard":
            return self._chessboard(image)
        detect = self._circles if self.kind == "circles" else self._charuco
        for inverse in (negative, not negative):
            if detection := detect(255 - image if inverse else image):
                return replace(detection, negative=inverse)
        return None

    def _chessboard(self, image: np.ndarray) -> Detection | None:
        import cv2

        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        success, corners = cv2.findChessboardCornersSB(image, self.shape, flags=flags)
        if not success:
            return None
        pixels = _from_black_square(image, corners.reshape(-1, 2).astype(np.float64), self.shape)
        return self._refined(image, np.arange(len(pixels)), pixels, 0.5)

    def _circles(self, image: np.ndarray) -> Detection | None:
        grid = dot_grid(*find_dots(image, self.columns * self.rows))
        pixels = None if grid is None else _upright(grid.centres, self.shape)
        return None if pixels is None else Detection(np.arange(len(pixels)), pixels, self.points)

    def _charuco(self, image: np.ndarray) -> Detection | None:
        import cv2

        detector = cv2.aruco.CharucoDetector(self._board(), detectorParams=marker_parameters(image))
        corners, ids, markers, numbers = detector.detectBoard(image)
        if ids is None or len(ids) < MIN_POINTS:
            return None
        ids, pixels = ids.ravel().astype(np.int64), corners.reshape(-1, 2).astype(np.float64)
        centres = np.array([marker.reshape(4, 2).mean(axis=0) for marker in markers])
        if self._continues(ids, pixels, numbers.ravel(), centres):
            return None
        gap = (1 - (self.marker or MARKER * self.pitch) / self.pitch) / 2
        return self._refined(image, ids, pixels, gap)

    def _continues(self, ids: np.ndarray, pixels: np.ndarray, numbers: np.ndarray, centres: np.ndarray) -> bool:
        """Whether markers below the last row continue the board, which then has another middle."""
        import cv2

        beyond = numbers >= self.columns * self.rows // 2
        if beyond.sum() < MIN_BEYOND:
            return False
        squares = marker_squares(self.columns, self.legacy and self.rows % 2 == 0, int(numbers.max()) + 1)
        to_pitches, _ = cv2.findHomography(pixels, self.points[ids, :2] / self.pitch)
        if to_pitches is None:
            return False
        places = cv2.perspectiveTransform(centres[None].astype(np.float64), to_pitches)[0]
        offsets = places - (squares[numbers] - [(self.columns - 1) / 2, (self.rows - 1) / 2])
        return int((np.linalg.norm(offsets[beyond], axis=1) < MAX_OFFSET).sum()) >= MIN_BEYOND

    def _refined(self, image: np.ndarray, ids: np.ndarray, pixels: np.ndarray, room: float) -> Detection | None:
        """Corners at their saddle points, `room` pitches from other edges; None if too few are left."""
        corners, good = saddle_points(image, pixels, room * _spacing(pixels, ids, self.shape))
        return Detection(ids[good], corners[good], self.points[ids[good]]) if good.sum() >= MIN_POINTS else None

    def _board(self) -> Any:
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        markers = self.columns * self.rows // 2
        if markers > len(dictionary.bytesList):
            raise InputError(
                f"expected at least {markers} markers for {self.columns} x {self.rows} squares, "
                f"{self.dictionary} has {len(dictionary.bytesList)}",
                field="dictionary",
            )
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.pitch, self.marker or MARKER * self.pitch, dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board


def marker_parameters(image: np.ndarray, edge: float = MIN_EDGE) -> Any:
    """Return OpenCV's parameters for markers with edges of at least `edge` px; its own limit grows with the image."""
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = min(parameters.minMarkerPerimeterRate, 4 * edge / max(image.shape))
    return parameters


def marker_squares(columns: int, legacy: bool, count: int) -> Int[np.ndarray, "count 2"]:
    """Return column and row of the squares with the first `count` markers of a ChArUco board.

    Parameters
    ----------
    legacy : the layout of OpenCV before version 4.6 of an even number of rows; with an odd number it was the same
    """
    row, column = np.divmod(np.arange(2 * count + columns), columns)
    with_marker = (row + column) % 2 == (0 if legacy else 1)
    return np.stack([column, row], axis=-1)[with_marker][:count]


def eight_bit(image: np.ndarray) -> np.ndarray:
    """Stretch the image to eight bits."""
    low, high = np.percentile(image.astype(np.float64), (0.2, 99.8))
    scaled = (image.astype(np.float32) - low) * (255 / max(float(high - low), 1e-6))
    return np.clip(np.round(scaled), 0, 255).astype(np.uint8)


def _from_black_square(image: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Order corners so that the square within the first corner is black, as in `raster`."""
    columns, rows = shape
    grid = pixels.reshape(rows, columns, 2)
    (x1, y1), (x2, y2) = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if x1 * y2 - x2 * y1 < 0:  # columns to the right and rows down, not mirrored
        grid = grid[::-1]
    # of the inner squares next to the first corner along the first row, the first has to be the darker one
    first, second = (_sample(image, grid[0:2, i : i + 2].mean(axis=(0, 1))) for i in (0, 1))
    return (grid if first < second else grid[::-1, ::-1]).reshape(-1, 2)


def saddle_points(image: np.ndarray, pixels: np.ndarray, room: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the saddle points of the grey values next to corners, and which of them are near their corner.

    A quadratic surface is fitted by least squares under a Gaussian weight, repeatedly around the new point: 0.005 to
    0.02 px on rendered images, where OpenCV's own refinements leave 0.02 to 0.05 px.

    Source: Lucchese & Mitra, Using saddle points for subpixel feature detection, 2002.

    Parameters
    ----------
    room : reach of the fit, px: up to the markers, whose edges would bias it
    """
    from scipy.ndimage import map_coordinates, spline_filter

    half = int(np.clip(room, 2, 7))
    y, x = (g.ravel().astype(np.float64) for g in np.mgrid[-half : half + 1, -half : half + 1])
    weight = np.exp(-((x**2 + y**2) / (half / 2) ** 2) / 4)
    fit = np.linalg.pinv(np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=-1) * weight[:, None])
    spline = spline_filter(image.astype(np.float64))
    points = pixels.copy()
    for _ in range(8):
        around = [points[:, 1:] + y, points[:, :1] + x]
        grey = map_coordinates(spline, around, order=3, prefilter=False, mode="nearest") * weight
        a, b, c, d, e, _ = fit @ grey.T
        determinant = 4 * a * c - b * b
        determinant = np.where(determinant < 0, determinant, -np.inf)  # a maximum or minimum: no step
        step = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], axis=-1) / determinant[:, None]
        points = points + np.clip(step, -1, 1)
        if np.abs(step).max() < 1e-4:
            break
    return points, np.linalg.norm(points - pixels, axis=1) < max(2.0, 0.3 * half)


def _sample(image: np.ndarray, where: np.ndarray) -> float:
    """Mean of 3 x 3 pixels."""
    u, v = np.round(where).astype(int)
    return float(image[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].mean())


def _upright(centres: np.ndarray, shape: tuple[int, int]) -> np.ndarray | None:
    """Order dots so that columns go to the right and rows down in the image; None if the numbers differ.

    Where columns and rows are exchanged, columns go down, which is as far from a turn by 180 degrees.
    """
    columns, rows = shape
    turned = (np.rot90(centres, turns) for turns in range(4))
    grids = [grid for grid in turned if grid.shape[:2] == (rows, columns)]
    return max(grids, key=_turned_little).reshape(-1, 2) if grids else None


def _turned_little(grid: np.ndarray) -> float:
    """Cosine of the angle from TURN to the way of the columns in the image."""
    x, y = (grid[:, -1] - grid[:, 0]).mean(axis=0)
    return float((x * np.cos(TURN) + y * np.sin(TURN)) / np.hypot(x, y))


def _spacing(pixels: np.ndarray, ids: np.ndarray, shape: tuple[int, int]) -> float:
    """Shortest distance between neighbouring points in the image, px."""
    where = {int(i): p for i, p in zip(ids, pixels, strict=True)}
    columns, _ = shape
    gaps = [
        float(np.linalg.norm(where[i] - where[j]))
        for i in where
        for j in (i + 1, i + columns)
        if j in where and not (j == i + 1 and j % columns == 0)
    ]
    return min(gaps, default=8.0)
