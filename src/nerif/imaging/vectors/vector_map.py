"""Vectors of one view at one instant, on a regular grid of positions in its images.

A vector on every k-th pixel is a pixel of an image of a k-th of the size:

    p' = (p - p0) / k,      d' = d / k,      window' = window / k

with p0 the position of the first vector.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera
from nerif.geometry import Camera, Lens
from nerif.geometry.lens import MAX_WINDOW

__all__ = ["VectorMap", "lattice", "neighbour_noise"]

Vectors = Float[np.ndarray, "row column 2"]
UNEVEN = 0.1  # of the step, by which a position may be off the grid
SQUARE = 0.02  # relative difference of the steps along x and y
LARGEST = 10  # ratio of grid points to vectors, above which the positions are no grid
MIN_DIFFERENCES = 16
LARGE, COVERED, CORNER, MOST_STEPS = 0.9, 0.6, 0.1, 8  # quantile of displacements, parts of an image, of a window
OVERLAP = 2.0  # windows overlap by half where nothing is stated
FLOOR = (
    0.01  # px of the images, least standard deviation of a vector: displacements by correlation lock to whole pixels
)


@dataclass(frozen=True)
class VectorMap:
    """Displacements on a regular grid, in pixels of the images."""

    displacement: Vectors  #: where a dot appears with flow minus without, px, u right, v down; NaN: no vector
    origin: tuple[float, float]  #: x, y of the first vector, px, (0, 0) the centre of the first pixel
    step: tuple[float, float]  #: between vectors, px
    sigma: Vectors | None = None  #: standard deviation of the noise, px
    window: float = 0.0  #: edge of the interrogation window, px; 0: unknown
    lag: float = 0.0
    """Share of the displacement by which its position lies before that on the flow image: 1 for a window of the image
    without flow, 1/2 for windows shifted symmetrically."""

    @classmethod
    def of_points(
        cls, x: np.ndarray, y: np.ndarray, u: np.ndarray, v: np.ndarray, valid: np.ndarray, place: object,
        sigma: np.ndarray | None = None, window: float = 0.0, lag: float = 0.0,
    ) -> VectorMap:  # fmt: skip
        """Return the map of single vectors (n,), in any order, missing ones excluded.

        Parameters
        ----------
        x, y : px, v and y down
        valid : (n,) False for vectors to ignore
        sigma : (n, 2) standard deviation, px, or None
        """
        (first_x, step_x, column), (first_y, step_y, row) = lattice(x, "x", place), lattice(y, "y", place)
        shape = (int(row.max()) + 1, int(column.max()) + 1)
        if shape[0] * shape[1] > LARGEST * len(x):
            raise InputError(
                f"expected vectors on a regular grid, got {len(x)} at positions of a grid of {shape[0]} x {shape[1]}",
                field=place,
            )
        if len(np.unique(row * shape[1] + column)) < len(x):
            raise InputError(
                "expected one vector at a position, got several; give a file of one view and one instant each",
                field=place,
            )
        maps = np.full((2, *shape, 2), np.nan, dtype=np.float32)
        values = np.stack([u, v], axis=-1)
        maps[0, row, column] = np.where((valid & np.isfinite(values).all(axis=-1))[:, None], values, np.nan)
        if sigma is not None:
            maps[1, row, column] = sigma
        return cls(maps[0], (first_x, first_y), (step_x, step_y), None if sigma is None else maps[1], window, lag)

    @property
    def valid(self) -> Bool[np.ndarray, "row column"]:
        """Whether there is a vector."""
        return np.isfinite(self.displacement).all(axis=-1)

    @property
    def windowed(self) -> float:
        """Edge of the interrogation window, px: as stated, or two steps of the grid."""
        return self.window or OVERLAP * self.pixel

    @property
    def pixel(self) -> float:
        """Geometric mean of the steps, px."""
        return math.sqrt(self.step[0] * self.step[1])

    def on_flow_image(self) -> VectorMap:
        """Return the displacements at positions of the flow image: d(p) = d0(p - l d0) = d0 - l (d0 . grad) d0.

        Where a neighbour is missing, the gradient is taken as 0.
        """
        if self.lag == 0 or min(self.displacement.shape[:2]) < 2:
            return replace(self, lag=0.0)
        d = self.displacement
        dv, du = (np.gradient(d, self.step[1 - axis], axis=axis) for axis in (0, 1))
        moved = d - self.lag * np.nan_to_num(d[..., :1] * du + d[..., 1:] * dv)
        return replace(self, displacement=moved.astype(np.float32), lag=0.0)

    def scaled(self) -> tuple[Vectors, Vectors | None]:
        """Return displacement and sigma in steps of the grid."""
        step = np.asarray(self.step, dtype=np.float32)
        return self.displacement / step, None if self.sigma is None else self.sigma / step

    def doubts(self, camera: CalibratedCamera) -> list[str]:
        """Return what is implausible, as of a wrong scale, window or calibration, a line each."""
        rows, columns = self.displacement.shape[:2]
        lines: list[str] = []
        if not self.valid.any():
            return lines
        largest = float(np.nanquantile(np.abs(self.displacement), LARGE))
        if largest > self.windowed:
            lines.append(
                f"displacements of {largest:.3g} px exceed the window of {self.windowed:.3g} px; check --scale, "
                "--time-step and units"
            )
        if self.window and not 1 <= self.window <= MOST_STEPS * self.pixel:
            lines.append(f"a window of {self.window:g} px with a vector on every {self.pixel:.3g} px; check --window")
        if camera.image_size is not None:
            ends = [o + s * n for o, s, n in zip(self.origin, self.step, (columns, rows), strict=True)]
            shares = [end / size for end, size in zip(ends, reversed(camera.image_size), strict=True)]
            if max(shares) < COVERED and max(self.origin) < CORNER * min(camera.image_size):
                lines.append(
                    f"vectors cover {shares[0]:.0%} x {shares[1]:.0%} of the camera's image from its first corner; "
                    "were the images of the calibration larger, or is --scale too large?"
                )
        return lines

    def camera(self, camera: CalibratedCamera, place: object) -> Camera:
        """Return the camera whose pixels are the vectors, and average over their windows.

        Raises
        ------
        InputError
            If vectors lie outside the camera's image.
        """
        rows, columns = self.displacement.shape[:2]
        last = [o + s * (n - 1) for o, s, n in zip(self.origin, self.step, (columns, rows), strict=True)]
        if camera.image_size is not None:
            height, width = camera.image_size
            far = max((last[0] + 1) / width, (last[1] + 1) / height)
            if far > 1 + 1e-6 or min(self.origin) < -1:
                ratio = f", {round(far)} times the size" if far > 1.5 else ""
                raise InputError(
                    f"expected vectors within the {height} x {width} px (height x width) of its camera, got positions "
                    f"x {self.origin[0]:.1f} to {last[0]:.1f} and y {self.origin[1]:.1f} to {last[1]:.1f} px{ratio}; "
                    "calibrate with images of the size of those that were correlated, or give --position-unit, "
                    "--scale and --origin of vectors in units of length",
                    field=place,
                )
        if self.pixel < 1:
            raise InputError(
                f"expected vectors at least a pixel apart, got {self.pixel:.3g} px; check --scale and --position-unit",
                field=place,
            )
        if camera.background is None:
            raise InputError(
                "its camera has no background plane, which displacements need; give nerif calibrate "
                "--background-distance",
                field=place,
            )
        change = torch.diag(torch.tensor([1 / self.step[0], 1 / self.step[1], 1.0], dtype=torch.float64))
        change[:2, 2] = -torch.tensor(self.origin, dtype=torch.float64) * change.diagonal()[:2]
        window = self.windowed / self.pixel
        if camera.image_size is not None and self.window > min(camera.image_size):
            raise InputError(f"expected less than the edge of the images, got {self.window:g} px", field="window")
        if window > MAX_WINDOW:
            raise InputError(
                f"expected at most {MAX_WINDOW:g} steps of {self.pixel:.3g} px, got {self.windowed:g} px",
                field="window",
            )
        lens = replace(camera.lens or Lens(), window=window)
        grid = replace(camera, intrinsics=change @ camera.intrinsics, image_size=(rows, columns), lens=lens)
        return grid.camera()


def lattice(values: np.ndarray, name: str, place: object) -> tuple[float, float, np.ndarray]:
    """Return first position, step and index of each of the positions along an axis, px; an even grid is required."""
    ordered = np.unique(values.astype(np.float64))
    if not len(ordered) or not np.isfinite(ordered).all():
        raise InputError(f"expected finite positions {name}, got {len(values)} of which some are not", field=place)
    gaps = np.diff(ordered)
    wide = gaps[gaps > UNEVEN * gaps.max(initial=0.0)] if len(gaps) else gaps  # rounding splits equal positions
    if not len(wide):
        raise InputError(
            f"expected vectors on a grid, got all at {name} = {ordered[0]:g}; are columns x and y exchanged?",
            field=place,
        )
    step = float(np.median(wide)) if wide.max() < 1.5 * wide.min() else float(wide.min())
    first = float(ordered[0])
    index = np.rint((ordered - first) / step)
    if len(ordered) > 2:  # steps are rounded in files: fit them
        step, first = map(float, np.polyfit(index, ordered, 1))
    off = np.abs(ordered - first - step * index).max() / step
    if off > UNEVEN:
        raise InputError(
            f"expected positions {name} at equal distances, got steps of {wide.min():g} to {wide.max():g}; resample "
            "the vectors on a regular grid",
            field=place,
        )
    return first, step, np.rint((values - first) / step).astype(int)


def neighbour_noise(d: Vectors, overlap: float) -> tuple[float, float]:
    """Return the standard deviation of the noise of u and v from differences among neighbours, px.

        e = second difference along rows of the second difference along columns of d
        sigma = 1.4826 median|e| / (6 - 8 r1 + 2 r2),      r_k = max(0, 1 - k lag / overlap)

    The median ignores where the flow is sharp. Windows that overlap share noise: r_k is the correlation of windows k
    lags apart. Neighbours (lag 1) are nearest in the flow, windows that do not overlap are independent whatever the
    program did with the vectors; the smaller of both results counts.

    Parameters
    ----------
    overlap : edge of the window over the step
    """
    results = []
    for lag in {1, max(1, math.ceil(overlap))}:
        r1, r2 = (max(0.0, 1 - k * lag / overlap) if overlap > 0 else 0.0 for k in (1, 2))
        e = d.astype(np.float64)
        for axis in (0, 1):
            first, middle, last = (
                np.take(e, np.arange(k * lag, e.shape[axis] - (2 - k) * lag), axis) for k in (0, 1, 2)
            )  # fmt: skip
            e = first - 2 * middle + last
        e = e[np.isfinite(e).all(axis=-1)]
        if len(e) >= MIN_DIFFERENCES:
            results.append(1.4826 * np.median(np.abs(e), axis=0) / (6 - 8 * r1 + 2 * r2))
    if not results:
        raise InputError("too few neighbours to estimate the noise from; give --sigma, px", field="noise")
    u, v = np.maximum(np.min(results, axis=0), FLOOR)
    return float(u), float(v)
