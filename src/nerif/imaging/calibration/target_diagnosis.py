"""Diagnosis of images in which the calibration target is not detected: another target, or the reason.

Tried in this order: ChArUco boards with the dictionaries of OpenCV, as they are and mirrored, chessboards of other
numbers of squares, and grids of dots. A board is named if its markers lie where a board of that size has them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nerif.imaging.calibration.dot_grid import dot_grid, find_dots
from nerif.imaging.calibration.targets import (
    MAX_OFFSET,
    CalibrationTarget,
    eight_bit,
    marker_parameters,
    marker_squares,
)
from nerif.imaging.readers.exposure import check_exposure

__all__ = ["Identification", "explain", "identify"]

MIN_MARKERS = 6  # of a board
MIN_SHARE = 0.75  # of the markers, in the layout of a board
MIN_COUNT = 12  # squares between the corners of a chessboard, or dots: fewer are found in any texture
MAX_SKEW = 0.1  # rms of the corners of markers, in squares; half of an edge is 0.2 to 0.45
UPRIGHT = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])  # corners of a marker about its middle
COUNTS = range(4, 41)  # of columns to try
IDS = 250  # of a dictionary that are tried, or as many as the board has
CANDIDATE_EDGE, CELL = 4.0, 2.0  # px: smallest square that could be a marker; least size of a cell to be read
MIN_CONTRAST = 3.0  # of a smoothed image, over the noise of its pixels; it is 1.3 in pure noise
MAX_EDGE_WIDTH = 8.0  # px, of sharp images
MAX_VARIANCE = 0.03  # of the squares of a chessboard, beside their two colours, over that of all
OVEREXPOSED = 0.25  # share of the pixels


@dataclass(frozen=True)
class Identification:
    """A target that fits an image."""

    target: CalibrationTarget | None
    """As in the settings, but for what differs; None if it is one that is not supported."""
    text: str  #: the target in words
    mirrored: bool = False  #: the image has to be flipped first


@dataclass(frozen=True)
class _Markers:
    """Markers of a family of dictionaries in an image."""

    family: tuple[str, ...]  #: names of the dictionaries with the same first markers, from the smallest
    ids: Int[np.ndarray, " n"]
    corners: Float[np.ndarray, "n 4 2"]  #: px, of each marker clockwise from its upper left one
    size: tuple[int, int]  #: height and width of the image, px


class _BoardLayout(NamedTuple):
    """The layout of a board.

    rows : number up to the last marker
    share : of the markers, that are in their squares
    whole : another row would be in the image
    """

    columns: int
    rows: int
    legacy: bool
    share: float
    whole: bool


def explain(images: Sequence[np.ndarray], target: CalibrationTarget, full: float, flip: str = "") -> str:
    """Return why a target is not detected in images: another one is there, they are mirrored, or they are too bad.

    Parameters
    ----------
    images : some of those without a detection
    full : full scale, grey values
    flip : that of the view's settings
    """
    identification = identify(images, target)
    if identification is None:
        return _no_target(images, target, full)
    if identification.target is None:
        return identification.text
    options = " ".join(_options(identification.target, target))
    parts = [f"the target is {identification.text}, not {_name(target)}: give {options}"] if options else []
    if identification.mirrored:
        remedy = (
            f'remove flip = "{flip}" from' if flip in ("horizontal", "vertical") else 'put flip = "horizontal" into'
        )
        parts.append(f"the images are mirrored: {remedy} views.toml")
    return "; ".join(parts) or _no_target(images, target, full)


def identify(images: Sequence[np.ndarray], target: CalibrationTarget) -> Identification | None:
    """Return the target that fits the images, or None."""
    pictures = [eight_bit(image) for image in images]
    for search in (_charuco, _chessboard, _circles):
        if identification := search(pictures, target):
            return identification
    return None


def _name(target: CalibrationTarget) -> str:
    text = f"{target.kind} {target.columns} x {target.rows}"
    if target.kind != "charuco":
        return text
    return f"{text} of {target.dictionary}{', legacy pattern' if target.legacy else ''}"


def _options(target: CalibrationTarget, settings: CalibrationTarget) -> Iterator[str]:
    """Options of the command line that turn the settings into the target."""
    for name in ("kind", "columns", "rows", "dictionary"):
        if getattr(target, name) != getattr(settings, name):
            yield f"--target.{name} {getattr(target, name)}"
    if target.legacy != settings.legacy:
        yield "--target.legacy" if target.legacy else "--target.no-legacy"


# -- ChArUco -------------------------------------------------------------------------------------------------------


def _charuco(images: Sequence[np.ndarray], target: CalibrationTarget) -> Identification | None:
    elsewhere: _Markers | None = None
    for image in images:
        for mirrored in (False, True):
            picture = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
            for markers in _markers(picture, target):
                if len(markers.ids) < MIN_MARKERS:
                    continue
                board = _board_of(markers, target)
                if board is not None:
                    return Identification(board, _name(board), mirrored)
                elsewhere = elsewhere or markers
    if elsewhere is None or len(set(elsewhere.ids)) < len(elsewhere.ids) / 2:
        return None
    return Identification(
        None,
        f"{len(elsewhere.ids)} markers of {elsewhere.family[-1]} (ids {elsewhere.ids.min()} to {elsewhere.ids.max()}) "
        "were detected, but not in the layout of a ChArUco board with ids from 0; grids of markers without a "
        "chessboard are not supported, print one with nerif pattern --kind charuco",
    )


@cache
def _families() -> tuple[tuple[str, ...], ...]:
    """Names of OpenCV's dictionaries; DICT_4X4_50 holds the first markers of DICT_4X4_100."""
    from cv2 import aruco

    values = {getattr(aruco, name): name for name in sorted(dir(aruco)) if name.startswith("DICT_")}  # one of aliases

    def family(name: str) -> str:
        return name if "APRILTAG" in name or "ARUCO" in name else name.rpartition("_")[0]

    names = sorted(values.values(), key=lambda n: (family(n), _size(n)))
    return tuple(tuple(group) for _, group in groupby(names, key=family))


def _dictionary(name: str) -> Any:
    from cv2 import aruco

    return aruco.getPredefinedDictionary(getattr(aruco, name))


def _size(name: str) -> int:
    return len(_dictionary(name).bytesList)


def _markers(image: np.ndarray, target: CalibrationTarget) -> list[_Markers]:
    """Markers of all dictionaries in an image, black on white or white on black; those with the most first."""
    from cv2 import aruco

    parameters = marker_parameters(image)
    parameters.detectInvertedMarker = True
    count = max(IDS, target.columns * target.rows // 2)
    shortened = []
    for family in _families():
        full = _dictionary(family[-1])
        shortened.append(aruco.Dictionary(full.bytesList[:count], full.markerSize, full.maxCorrectionBits))
    corners, ids, _, numbers = aruco.ArucoDetector(shortened, parameters).detectMarkersMultiDict(image)
    if ids is None or not len(ids):
        return []
    places = np.array(corners, dtype=np.float64).reshape(-1, 4, 2)
    ids, numbers = np.ravel(ids).astype(np.int64), np.ravel(numbers)
    groups = [_Markers(f, ids[numbers == i], places[numbers == i], image.shape) for i, f in enumerate(_families())]
    return sorted((g for g in groups if len(g.ids)), key=lambda g: -len(g.ids))


def _board_of(markers: _Markers, target: CalibrationTarget) -> CalibrationTarget | None:
    """The board whose layout most of the markers have, or None; of several, the one nearest the settings."""
    even = target.legacy and target.rows % 2 == 0
    columns = dict.fromkeys([target.columns, target.rows, *COUNTS])
    layouts = [_layout(markers, count, legacy) for count in columns for legacy in (even, not even)]
    best = max((layout for layout in layouts if layout), key=lambda layout: layout.share, default=None)
    if best is None:
        return None
    expected = {target.columns: target.rows, target.rows: target.columns}  # also with columns and rows exchanged
    rows = max(best.rows, 4, expected.get(best.columns, best.rows if best.whole else target.rows))
    if best.legacy and rows % 2:  # an odd number has no legacy layout: the last row is not in the image
        rows += 1
    dictionary = _smallest(markers.family, best.columns * rows // 2, target.dictionary)
    legacy = best.legacy if rows % 2 == 0 else target.legacy
    return replace(target, kind="charuco", columns=best.columns, rows=rows, dictionary=dictionary, legacy=legacy)


def _layout(markers: _Markers, columns: int, legacy: bool) -> _BoardLayout | None:
    """The layout with this number of columns if a homography maps markers to their squares, upright in them."""
    import cv2

    squares = marker_squares(columns, legacy, int(markers.ids.max()) + 1)[markers.ids].astype(np.float64)
    if len(np.unique(squares[:, 1])) < 2:
        return None
    homography, fits = cv2.findHomography(markers.corners.mean(axis=1), squares, cv2.RANSAC, MAX_OFFSET)
    if homography is None or fits.mean() < MIN_SHARE or fits.sum() < MIN_MARKERS:
        return None
    corners = cv2.perspectiveTransform(markers.corners[fits.ravel() > 0], homography)
    offsets = (corners - corners.mean(axis=1, keepdims=True)) * UPRIGHT
    if np.std(offsets) > MAX_SKEW:  # rows of a grid of markers only, or a mirrored one
        return None
    rows = int(squares[fits.ravel() > 0, 1].max()) + 1
    below = np.stack([np.arange(columns), np.full(columns, rows)], axis=-1)[None].astype(np.float64)
    places = cv2.perspectiveTransform(below, np.linalg.inv(homography))[0]
    inside = ((places > 0) & (places < markers.size[::-1])).all(axis=1)
    return _BoardLayout(columns, rows, legacy, float(fits.mean()), float(inside.mean()) > 0.5)


def _smallest(family: tuple[str, ...], count: int, preferred: str) -> str:
    """The dictionary of the settings if it has these markers, else the smallest one that has enough."""
    from cv2 import aruco

    for name in family:
        if getattr(aruco, name) == getattr(aruco, preferred, None) and _size(name) >= count:
            return preferred
    return next((name for name in family if _size(name) >= count), family[-1])


# -- chessboards and dots ------------------------------------------------------------------------------------------


def _chessboard(images: Sequence[np.ndarray], target: CalibrationTarget) -> Identification | None:
    """The chessboard of most of the images; that of a ChArUco board whose markers are not sharp is none."""
    import cv2

    sizes: dict[tuple[int, int], None] = {}  # numbers of corners
    for image in images:
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
        success, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
        if success:
            rows, columns = sorted(meta.shape)
            # the margin of the paper may add a line of corners
            sizes |= dict.fromkeys((columns - i, rows - j) for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))
    if sizes:  # the numbers of the settings may be those of corners
        sizes = {(max(target.columns, target.rows), min(target.columns, target.rows)): None} | sizes
    for size in sizes:
        if not _in_most(images, size):
            continue
        columns, rows = sorted((size[0] + 1, size[1] + 1), reverse=target.columns >= target.rows)
        if target.kind == "charuco" and (columns, rows) == (target.columns, target.rows):
            return None
        if (columns + rows) % 2 == 0:
            return Identification(
                None,
                f"the target is a chessboard of {columns} x {rows} squares, which looks the same turned by 180 degrees "
                "and is not supported; use one of an odd and an even number of squares, or ChArUco",
            )
        board = replace(target, kind="chessboard", columns=columns, rows=rows)
        return Identification(board, _name(board))
    return None


def _in_most(images: Sequence[np.ndarray], size: tuple[int, int]) -> bool:
    """Whether at least half of the images have a chessboard of this number of corners."""
    failures = 0
    for image in images:
        failures += not _is_chessboard(image, size)
        if failures > len(images) / 2:
            return False
    return True


def _is_chessboard(image: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether corners are detected, lie in a flat grid, and the squares between them are black and white in turn.

    The detector alone finds small chessboards in textures, and parts of a ChArUco board.
    """
    import cv2

    columns, rows = size
    if min(size) < 3 or (columns - 1) * (rows - 1) < MIN_COUNT:
        return False
    success, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not success:
        return False
    row, column = np.mgrid[:rows, :columns]
    grid = np.stack([column, row], axis=-1).reshape(-1, 2).astype(np.float64)
    homography, _ = cv2.findHomography(grid, corners.reshape(-1, 2))
    if homography is None:
        return False
    places = cv2.perspectiveTransform(corners.reshape(1, -1, 2).astype(np.float64), np.linalg.inv(homography))[0]
    if np.linalg.norm(places - grid, axis=1).max() > MAX_OFFSET:
        return False
    inner = (row < rows - 1) & (column < columns - 1)
    middles = cv2.perspectiveTransform(grid[None] + 0.5, homography)[0][inner.ravel()].astype(np.float32)
    grey = cv2.remap(cv2.GaussianBlur(image, (0, 0), 1.5), middles[:, 0], middles[:, 1], cv2.INTER_LINEAR).ravel()
    colour = np.where((row + column) % 2, 1.0, -1.0)[inner]
    light = np.stack([np.ones_like(colour), column[inner], row[inner]])  # unevenly lit, in both colours
    model = np.concatenate([light, colour * light]).T
    residual = grey - model @ np.linalg.lstsq(model, grey, rcond=None)[0]
    return float(np.var(residual)) < MAX_VARIANCE * float(np.var(grey))


def _circles(images: Sequence[np.ndarray], target: CalibrationTarget) -> Identification | None:
    for image in images:
        for picture in (image, 255 - image):
            grid = dot_grid(*find_dots(picture, target.columns * target.rows))
            if grid is None or grid.count < min(MIN_COUNT, target.columns * target.rows):
                continue
            if grid.asymmetric:
                return Identification(
                    None,
                    f"the target is an asymmetric grid of {grid.count} dots, which is not supported; use a regular "
                    "grid of dots, or print a board with nerif pattern --kind charuco",
                )
            rows, columns = grid.centres.shape[:2]
            numbers = sorted((columns, rows), reverse=target.columns >= target.rows)
            regular = replace(target, kind="circles", columns=numbers[0], rows=numbers[1])
            return Identification(regular, _name(regular))
    return None


# -- images without a target ---------------------------------------------------------------------------------------


def _no_target(images: Sequence[np.ndarray], target: CalibrationTarget, full: float) -> str:
    """What was detected of the target, and what is wrong with the images, as far as it can be measured."""
    pictures = [eight_bit(image) for image in images]
    if target.kind == "charuco":
        best = max((m for p in pictures for m in _markers(p, target)), key=lambda m: len(m.ids), default=None)
        if best is None or len(best.ids) < MIN_MARKERS:
            text = "no marker of any dictionary of OpenCV was detected, no chessboard, no grid of dots"
        else:
            text = (
                f"at most {len(best.ids)} markers of {best.family[-1]} were detected in an image, too few for a board"
            )
    elif target.kind == "circles":
        count = target.columns * target.rows
        dots = max(len(find_dots(p, count)[0]) for picture in pictures for p in (picture, 255 - picture))
        text = f"{dots} dots were detected in an image, in no complete grid, and no other target"
    else:
        text = "no chessboard of any number of squares was detected, and no other target"
    faults = [_fault(image, picture, target, full) for image, picture in zip(images, pictures, strict=True)]
    return f"{text}; {next(filter(None, faults), 'is it in focus, evenly lit and large enough, and in the images?')}"


def _fault(image: np.ndarray, picture: np.ndarray, target: CalibrationTarget, full: float) -> str:
    """The fault of an image, and of the same in eight bits."""
    import cv2

    if exposure := check_exposure(image, full, "exposure", OVEREXPOSED):
        return exposure
    smooth = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.0)
    contrast = float(np.ptp(np.percentile(smooth, (1, 99))))
    curvature = np.diff(picture.astype(np.float32), n=2, axis=1)
    noise = float(np.median(np.abs(curvature))) / (0.6745 * np.sqrt(6))
    if contrast < MIN_CONTRAST * noise:
        return "the contrast of an image is as low as its noise; is it lit, and in focus?"
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8))
    width = contrast / max(float(np.percentile(slope, 99.9)), 1e-6)
    if width > MAX_EDGE_WIDTH:
        return f"the sharpest edges in an image are {width:.0f} px wide: out of focus, or the target moved"
    if target.kind != "charuco":
        return ""
    dictionary = _dictionary(target.dictionary)
    detector = cv2.aruco.ArucoDetector(dictionary, marker_parameters(picture, CANDIDATE_EDGE))
    _, _, candidates = detector.detectMarkers(picture)
    least = CELL * (dictionary.markerSize + 2)
    if len(candidates) < max(MIN_MARKERS, target.columns * target.rows // 8):  # noise has some
        return ""
    edge = float(np.percentile([np.sqrt(cv2.contourArea(c)) for c in candidates], 25))  # squares are larger
    if edge < least:
        return f"the markers in an image are about {edge:.0f} px wide, and need {least:.0f} px or more"
    return ""
