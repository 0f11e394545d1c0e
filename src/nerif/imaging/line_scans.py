"""Scans by parallel rays, angle by angle and position by position, as X-ray sources and line cameras give them.

    A(theta, x) = integral mu along the line at distance x - x_axis from the axis of rotation

A reading is -ln of an intensity with an offset that is not known, the axis is somewhere, and where A is large harmonics
of the source, scatter and the detector let it seem smaller. What the scan itself tells of all three:

    offset   median of the readings at both ends of every angle, beside the medium
    axis     x_axis of the sinusoid x_axis + a cos(theta) + b sin(theta) through the centres of mass
    bend     k of A + k A^2, by which the total of every angle that holds all of the medium is most nearly the same
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement, measurement_of
from nerif.forward.absorption import Absorption
from nerif.geometry import Box, Camera
from nerif.geometry.camera import TELECENTRIC

__all__ = ["LineScan", "Told"]

ENDS = 3  # readings at either end of an angle that are beside the medium
EMPTY = 0.02  # of the largest reading, below which an end is beside the medium
LARGEST_BEND, BENDS = 0.3, 301  # tried
DIGITS = 1e-4  # of the largest reading, to which no scan is better
NAMED = 10  # digits of an angle in the name of its view: rounding of radians lies beyond, no two angles look alike
EVEN = 1e-3  # of a step: how far positions may be from evenly spaced


@dataclass(frozen=True)
class Told:
    """What a scan tells of itself.

    Parameters
    ----------
    offset : reading beside the medium
    noise : standard deviation of the readings there
    bend : k of A + k A^2
    scatter, scatter_after : of the totals of complete angles, as a share, before the bend is undone and after
    axis : position of the axis of rotation, mm
    """

    offset: float
    noise: float
    bend: float
    scatter: float
    scatter_after: float
    axis: float

    def __str__(self) -> str:
        return (
            f"offset {self.offset:.4f}, noise beside the medium {self.noise:.1e}, axis at {self.axis:.3f} mm, readings "
            f"A - {self.bend:.3f} A²; totals of the angles scatter by {self.scatter:.1%}, {self.scatter_after:.1%} "
            "once that is undone"
        )


@dataclass(frozen=True)
class LineScan:
    """Readings of one slice.

    Parameters
    ----------
    angles : (a,) of the rotation, rad
    positions : (p,) of the rays across it, evenly spaced, mm
    readings : (a, p) absorbance

    Raises
    ------
    InputError
        If shapes disagree, positions are not evenly spaced, or there are too few angles to find the axis.
    """

    angles: Float[np.ndarray, " a"]
    positions: Float[np.ndarray, " p"]
    readings: Float[np.ndarray, "a p"]

    def __post_init__(self) -> None:
        shape = (len(self.angles), len(self.positions))
        if self.readings.shape != shape:
            raise InputError(
                f"expected one for each angle and position {shape}, got {self.readings.shape}", field="readings"
            )
        if min(shape) < 4:
            raise InputError(f"expected four angles and positions or more, got {shape}", field="readings")
        steps = np.diff(self.positions)
        if not (steps.mean() > 0 and np.abs(steps - steps.mean()).max() < EVEN * steps.mean()):
            raise InputError(
                "expected evenly spaced, rising positions in mm; interpolate them first", field="positions"
            )

    @property
    def spacing(self) -> float:
        """Between positions, mm."""
        return float(np.diff(self.positions).mean())

    def select(self, angles: Sequence[int]) -> LineScan:
        """Return the scan of some angles, by number."""
        return replace(self, angles=self.angles[angles], readings=self.readings[angles])

    @property
    def offset(self) -> float:
        """Reading beside the medium."""
        return float(np.median(np.concatenate([self.readings[:, :ENDS], self.readings[:, -ENDS:]])))

    def without_offset(self, offset: float) -> LineScan:
        """Return the scan with readings that much less: 0 beside the medium."""
        return replace(self, readings=self.readings - offset)

    def tell(self) -> Told:
        """Return offset, bend and axis, each once those before it are undone."""
        scan = self.without_offset(self.offset)
        bend, scatter, scatter_after = scan.bend()
        return Told(self.offset, self.noise, bend, scatter, scatter_after, scan.unbent(bend).axis())

    @property
    def noise(self) -> float:
        """Standard deviation of the readings beside the medium, robustly: 1.48 times the median deviation."""
        ends = np.concatenate([self.readings[:, :ENDS], self.readings[:, -ENDS:]])
        return float(1.4826 * np.median(np.abs(ends - np.median(ends))))

    @property
    def complete(self) -> Int[np.ndarray, " c"]:
        """Numbers of the angles that hold all of the medium: both ends are beside it."""
        least = EMPTY * self.readings.max()
        inside = (self.readings[:, :2].max(axis=1) < least) & (self.readings[:, -2:].max(axis=1) < least)
        return np.flatnonzero(inside)

    def bend(self) -> tuple[float, float, float]:
        """Return k, and how much the totals of complete angles scatter, as a share, without it and with it."""
        chosen = self.readings[self.complete]
        if len(chosen) < 3:
            raise InputError(
                f"expected three angles or more that hold all of the medium, got {len(chosen)}", field="readings"
            )
        tried = np.linspace(0, LARGEST_BEND, BENDS)
        totals = [(chosen + k * chosen**2).sum(axis=1) for k in tried]
        scatter = [float(t.std() / t.mean()) for t in totals]
        best = int(np.argmin(scatter))
        return float(tried[best]), scatter[0], scatter[best]

    def unbent(self, k: float) -> LineScan:
        """Return the scan with readings A + k A^2."""
        return replace(self, readings=self.readings + k * self.readings**2)

    @staticmethod
    def bent(absorbance: Float[np.ndarray, "*n"], k: float) -> Float[np.ndarray, "*n"]:
        """Return the readings that absorbances give: the inverse of A + k A^2."""
        return absorbance if k == 0 else (np.sqrt(1 + 4 * k * np.clip(absorbance, 0, None)) - 1) / (2 * k)

    def axis(self) -> float:
        """Return the position of the axis of rotation, mm."""
        return self._sinusoid()[0]

    def shifts(self) -> dict[int, float]:
        """Return how far the centre of mass of each complete angle is from the sinusoid through them all, mm."""
        return dict(zip(self.complete.tolist(), self._sinusoid()[1].tolist(), strict=True))

    def _sinusoid(self) -> tuple[float, Float[np.ndarray, " c"]]:
        """Its middle, and how far the complete angles are from it, mm."""
        chosen = self.complete
        if len(chosen) < 4:
            raise InputError(
                f"expected four angles or more that hold all of the medium, got {len(chosen)}", field="readings"
            )
        total = self.readings[chosen].sum(axis=1)
        centre = (self.readings[chosen] * self.positions).sum(axis=1) / total
        turn = np.stack([np.ones(len(chosen)), np.cos(self.angles[chosen]), np.sin(self.angles[chosen])], axis=1)
        fitted = np.linalg.lstsq(turn, centre, rcond=None)[0]
        return float(fitted[0]), centre - turn @ fitted

    def measurement(self, axis: float) -> Measurement:
        """Return the slice as a measurement of absorption: a telecentric camera of one row of pixels for every angle.

        The axis of rotation is the z axis, the slice as thick as a step between positions.

        Parameters
        ----------
        axis : position of the axis of rotation, mm

        Raises
        ------
        InputError
            If two angles are the same.
        """
        half = float(np.abs(self.positions - axis).max()) + self.spacing / 2
        thickness = self.spacing / 2
        cameras = [self._camera(float(angle), axis) for angle in self.angles]
        name, times = Counter(camera.name for camera in cameras).most_common(1)[0]
        if times > 1:
            raise InputError(
                f"expected different angles, got {name} {times} times; average their readings", field="angles"
            )
        values = torch.from_numpy(self.readings).float()[:, None, :, None]
        measurement = measurement_of(
            {Absorption: values}, cameras, Box((-half, -half, -thickness), (half, half, thickness)), 1.0
        )
        least = max(self.noise, DIGITS * float(np.abs(self.readings).max()))
        return measurement.observed({Absorption.name: values}, {Absorption.name: torch.full_like(values, least)})

    def _camera(self, angle: float, axis: float) -> Camera:
        across, along = (np.cos(angle), np.sin(angle), 0.0), (-np.sin(angle), np.cos(angle), 0.0)
        rotation = torch.tensor([across, (0.0, 0.0, -1.0), along], dtype=torch.float64)
        scale, centre = 1 / self.spacing, (axis - float(self.positions[0])) / self.spacing
        return Camera(
            intrinsics=torch.tensor([[scale, 0, centre], [0, scale, 0], [0, 0, 1]], dtype=torch.float64),
            rotation=rotation,
            translation=torch.zeros(3, dtype=torch.float64),
            image_size=(1, len(self.positions)),
            background=None,
            distortion=torch.zeros(5, dtype=torch.float64),
            name=f"{np.degrees(angle):.{NAMED}g}deg",
            projection=TELECENTRIC,
        )
