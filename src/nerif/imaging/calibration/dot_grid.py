"""Grids of dots in an image: centres of the dots, and their columns and rows, counted from the image.

A grid grows from a dot near the middle: from each dot to the dots that lie one step along either axis of the grid, with
the steps measured beside it, so that perspective and distortion change them slowly. Dots that are in no line of the
grid, such as marks beside it, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

__all__ = ["DotGrid", "dot_grid", "find_dots"]

MAX_OFFSET = 0.3  # of a dot from its place by the step beside it, in steps
MAX_RATIO = 1.5  # between the diameters of neighbours
MIN_SINE = 0.5  # of the angle between the axes
MAX_DIAMETER = 0.6  # of the dots of an asymmetric grid, in steps: the squares of a blurred chessboard have 0.8
SEEDS = 5
MAX_FILL = 0.88  # median area of the dots over that of rectangles around them: 0.79 of ellipses, 1 of squares


@dataclass(frozen=True)
class DotGrid:
    """A complete grid of dots."""

    centres: Float[np.ndarray, "row column 2"]
    """Of a regular grid, px; columns and rows run as those of an image (not mirrored)."""
    count: int  #: number of dots
    asymmetric: bool = False  #: every second row is shifted by half a step; the centres are not sorted then


def find_dots(image: np.ndarray, count: int) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Return centres and diameters of the dark dots in an image of 8 bit, px; none where most are square.

    `count`, the number of dots expected, limits their area.
    """
    import cv2

    parameters = cv2.SimpleBlobDetector.Params()
    parameters.maxArea = image.size / count
    parameters.collectContours = True
    detector = cv2.SimpleBlobDetector.create(parameters)
    dots = detector.detect(image)
    if dots and np.median([_fill(contour) for contour in detector.getBlobContours()]) > MAX_FILL:
        dots = []  # squares of a chessboard, or markers
    centres = np.array([d.pt for d in dots], dtype=np.float64).reshape(-1, 2)
    return centres, np.array([d.size for d in dots], dtype=np.float64)


def _fill(contour: Any) -> float:
    import cv2

    width, height = cv2.minAreaRect(contour)[1]
    return float(cv2.contourArea(contour) / max(width * height, 1.0))


def dot_grid(centres: Float[np.ndarray, "n 2"], diameters: Float[np.ndarray, " n"]) -> DotGrid | None:
    """Return the largest grid of these dots, or None if none is complete."""
    if len(centres) < 4:
        return None
    middle = np.median(centres, axis=0)
    seeds = np.argsort(np.linalg.norm(centres - middle, axis=1))[:SEEDS]
    places = max((_grow(centres, diameters, int(seed)) for seed in seeds), key=len)
    lines = np.array([[*place, index] for place, index in places.items()], dtype=np.int64)
    return _regular(lines, centres) or _asymmetric(lines, centres, diameters)


def _grow(
    centres: Float[np.ndarray, "n 2"], diameters: Float[np.ndarray, " n"], seed: int
) -> dict[tuple[int, int], int]:
    """Dots by their column and row, from the dot `seed`, which is at (0, 0)."""
    from scipy.spatial import KDTree

    tree = KDTree(centres)
    _, near = tree.query(centres[seed], k=min(9, len(centres)))
    vectors = centres[near[1:]] - centres[seed]
    first = vectors[0]
    sines = np.abs(first[0] * vectors[:, 1] - first[1] * vectors[:, 0])
    sines = sines / (np.linalg.norm(first) * np.linalg.norm(vectors, axis=1))
    if not (sines > MIN_SINE).any():
        return {(0, 0): seed}
    second = vectors[int(np.argmax(sines > MIN_SINE))]
    if first[0] * second[1] < first[1] * second[0]:
        second = -second
    places, taken_dots = {(0, 0): seed}, {seed}
    front = [((0, 0), np.stack([first, second]))]
    while front:
        (column, row), steps = front.pop(0)
        here = places[column, row]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            place = (column + sign * (axis == 0), row + sign * (axis == 1))
            if place in places:
                continue
            reach = MAX_OFFSET * float(np.linalg.norm(steps[axis]))
            _, there = tree.query(centres[here] + sign * steps[axis], distance_upper_bound=reach)
            there = int(there)
            if there == len(centres) or there in taken_dots:
                continue
            if not 1 / MAX_RATIO < diameters[there] / diameters[here] < MAX_RATIO:
                continue
            beside = steps.copy()
            beside[axis] = sign * (centres[there] - centres[here])
            places[place] = there
            taken_dots.add(there)
            front.append((place, beside))
    return places


def _regular(lines: Int[np.ndarray, "lines 3"], centres: Float[np.ndarray, "n 2"]) -> DotGrid | None:
    """The grid if its lines are all complete, but for lines less than half full at its edges."""
    lines = _trimmed(lines)
    if len(lines) < 4:
        return None
    column, row, index = (lines - [*lines[:, :2].min(axis=0), 0]).T
    columns, rows = int(column.max()) + 1, int(row.max()) + 1
    if len(lines) != columns * rows or min(columns, rows) < 2:
        return None
    grid = np.empty((rows, columns, 2))
    grid[row, column] = centres[index]
    return DotGrid(grid, len(lines))


def _trimmed(lines: Int[np.ndarray, "lines 3"]) -> Int[np.ndarray, "trimmed 3"]:
    """The dots without those in lines at the edges that are less than half full."""
    while len(lines):
        for axis, end in ((0, 0), (0, -1), (1, 0), (1, -1)):
            numbers, counts = np.unique(lines[:, axis], return_counts=True)
            if counts[end] < 0.5 * counts.max():
                lines = lines[lines[:, axis] != numbers[end]]
                break
        else:
            return lines
    return lines


def _asymmetric(
    lines: Int[np.ndarray, "lines 3"], centres: Float[np.ndarray, "n 2"], diameters: Float[np.ndarray, " n"]
) -> DotGrid | None:
    """The grid if its diagonals are the rows and columns of a complete asymmetric grid."""
    dots = lines[:, 2]
    steps = np.linalg.norm(centres[dots][:, None] - centres[dots][None], axis=-1)
    if np.median(diameters[dots] / np.sort(steps, axis=1)[:, 1:2].T) > MAX_DIAMETER:
        return None
    sums, differences = lines[:, 0] + lines[:, 1], lines[:, 0] - lines[:, 1]
    for along, across in ((sums, differences), (differences, sums)):
        rows, counts = np.unique(across, return_counts=True)
        spans = {int(np.ptp(along[across == row])) for row in rows}
        complete = len(set(counts)) == 1 and np.ptp(rows) == len(rows) - 1 and spans == {2 * (int(counts[0]) - 1)}
        if complete and counts[0] > 1 and len(rows) > 2:
            return DotGrid(np.empty((0, 0, 2)), len(dots), asymmetric=True)
    return None
