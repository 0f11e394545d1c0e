"""One slice of a scan by parallel rays, angle by angle and position by position (X-ray sources, line cameras).

    A(theta, x) = integral mu along the line at distance x - x_axis from the axis of rotation

A reading is -ln of an intensity with an unknown offset; the position of the axis is unknown, and where A is large,
harmonics of the source, scatter and the detector reduce the reading. All three are estimated from the scan:

    offset      median of the readings at both ends of every angle, outside the medium
    axis        x_axis of the sinusoid x_axis + a cos(theta) + b sin(theta) through the centres of mass
    saturation  k of A + k A^2 that makes the totals of angles with the whole medium most nearly equal

examples/spray.py reconstructs one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from nerif import Box, Camera, InputError, Measurement
from nerif.data.measurement import measurement_of
from nerif.forward.absorption import Absorption
from nerif.geometry.projection import TELECENTRIC

END_READINGS = 3  # at either end of an angle, outside the medium
EMPTY = 0.02  # of the largest reading, below which an end is outside the medium
SATURATIONS = np.linspace(0, 0.3, 301)  # values of k to compare
MIN_NOISE = 1e-4  # of the largest reading
DIGITS = 10  # of an angle in the name of its view: different angles get different names
EVEN = 1e-3  # largest deviation from even spacing, of a step


@dataclass(frozen=True)
class ScanEstimate:
    """Properties of a scan, estimated from its readings.

    Parameters
    ----------
    offset : reading outside the medium
    noise : standard deviation of the readings there
    saturation : k of A + k A^2
    scatter, corrected_scatter : relative, of the totals of complete angles, before and after correction of saturation
    axis : position of the axis of rotation, mm
    """

    offset: float
    noise: float
    saturation: float
    scatter: float
    corrected_scatter: float
    axis: float

    def __str__(self) -> str:
        return (
            f"offset {self.offset:.4f}, noise outside the medium {self.noise:.1e}, axis at {self.axis:.3f} mm, "
            f"readings A - {self.saturation:.3f} A²; scatter of the totals of the angles {self.scatter:.1%}, corrected "
            f"{self.corrected_scatter:.1%}"
        )


@dataclass(frozen=True)
class LineScan:
    """Readings of one slice.

    Parameters
    ----------
    angles : of the rotation, rad
    positions : of the rays across it, evenly spaced, mm
    readings : absorbance
    """

    angles: Float[np.ndarray, " a"]
    positions: Float[np.ndarray, " p"]
    readings: Float[np.ndarray, "a p"]

    def __post_init__(self) -> None:
        shape = (len(self.angles), len(self.positions))
        if self.readings.shape != shape or min(shape) < 4:
            raise InputError(
                f"expected one for each of at least 4 angles and positions {shape}, got {self.readings.shape}",
                field="readings",
            )
        steps = np.diff(self.positions)
        if not (steps.mean() > 0 and np.abs(steps - steps.mean()).max() < EVEN * steps.mean()):
            raise InputError("expected evenly spaced, rising positions in mm; interpolate to these", field="positions")

    @property
    def spacing(self) -> float:
        """Between positions, mm."""
        return float(np.diff(self.positions).mean())

    def select(self, angles: Sequence[int]) -> LineScan:
        """Return the scan of some angles, by number."""
        return replace(self, angles=self.angles[angles], readings=self.readings[angles])

    @property
    def _ends(self) -> Float[np.ndarray, "n e"]:
        return np.concatenate([self.readings[:, :END_READINGS], self.readings[:, -END_READINGS:]])

    @property
    def offset(self) -> float:
        """Reading outside the medium."""
        return float(np.median(self._ends))

    @property
    def noise(self) -> float:
        """Robust standard deviation of the readings outside the medium: 1.48 times the median deviation."""
        return float(1.4826 * np.median(np.abs(self._ends - np.median(self._ends))))

    def without_offset(self, offset: float) -> LineScan:
        """Return the scan with readings of 0 outside the medium."""
        return replace(self, readings=self.readings - offset)

    def estimate(self) -> ScanEstimate:
        """Estimate offset, saturation and axis, each after correction of the former."""
        scan = self.without_offset(self.offset)
        k, scatter, corrected = scan.saturation()
        return ScanEstimate(self.offset, self.noise, k, scatter, corrected, scan.corrected(k).axis())

    @property
    def complete(self) -> Int[np.ndarray, " c"]:
        """Numbers of the angles with the whole medium: both ends are outside it."""
        limit = EMPTY * self.readings.max()
        outside = (self.readings[:, :2].max(axis=1) < limit) & (self.readings[:, -2:].max(axis=1) < limit)
        return np.flatnonzero(outside)

    def _complete_readings(self, least: int) -> Float[np.ndarray, "c p"]:
        readings = self.readings[self.complete]
        if len(readings) < least:
            raise InputError(
                f"expected at least {least} angles with the whole medium, got {len(readings)}", field="readings"
            )
        return readings

    def saturation(self) -> tuple[float, float, float]:
        """Return k, and the relative scatter of the totals of complete angles without and with the correction."""
        readings = self._complete_readings(3)
        totals = [(readings + k * readings**2).sum(axis=1) for k in SATURATIONS]
        scatter = [float(t.std() / t.mean()) for t in totals]
        best = int(np.argmin(scatter))
        return float(SATURATIONS[best]), scatter[0], scatter[best]

    def corrected(self, k: float) -> LineScan:
        """Return the scan with readings A + k A^2."""
        return replace(self, readings=self.readings + k * self.readings**2)

    @staticmethod
    def saturate(absorbance: Float[np.ndarray, "*n"], k: float) -> Float[np.ndarray, "*n"]:
        """Return the readings of absorbances: the inverse of A + k A^2."""
        return absorbance if k == 0 else (np.sqrt(1 + 4 * k * np.clip(absorbance, 0, None)) - 1) / (2 * k)

    def axis(self) -> float:
        """Return the position of the axis of rotation, mm."""
        return self._sinusoid()[0]

    def shifts(self) -> dict[int, float]:
        """Return the distance of the centre of mass of each complete angle from the fitted sinusoid, mm."""
        return dict(zip(self.complete.tolist(), self._sinusoid()[1].tolist(), strict=True))

    def _sinusoid(self) -> tuple[float, Float[np.ndarray, " c"]]:
        """Mean of the sinusoid, and residuals of the centres of mass, mm."""
        readings, angles = self._complete_readings(4), self.angles[self.complete]
        centre = (readings * self.positions).sum(axis=1) / readings.sum(axis=1)
        waves = np.stack([np.ones(len(angles)), np.cos(angles), np.sin(angles)], axis=1)
        coefficients = np.linalg.lstsq(waves, centre, rcond=None)[0]
        return float(coefficients[0]), centre - waves @ coefficients

    def measurement(self, axis: float) -> Measurement:
        """Return the slice as a measurement of absorption: per angle a telecentric camera of one row of pixels.

        The axis of rotation, at the position `axis` (mm), is the z axis; the slice is one step between positions thick.
        """
        half = float(np.abs(self.positions - axis).max()) + self.spacing / 2
        thickness = self.spacing / 2
        cameras = [self._camera(float(angle), axis) for angle in self.angles]
        name, count = Counter(camera.name for camera in cameras).most_common(1)[0]
        if count > 1:
            raise InputError(
                f"expected different angles, got {name} {count} times; average their readings", field="angles"
            )
        values = torch.from_numpy(self.readings).float()[:, None, :, None]
        box = Box((-half, -half, -thickness), (half, half, thickness))
        measurement = measurement_of({Absorption: values}, cameras, box, 1.0)
        sigma = max(self.noise, MIN_NOISE * float(np.abs(self.readings).max()))
        return measurement.observed({Absorption.name: values}, {Absorption.name: torch.full_like(values, sigma)})

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
            name=f"{np.degrees(angle):.{DIGITS}g}deg",
            projection=TELECENTRIC,
        )
