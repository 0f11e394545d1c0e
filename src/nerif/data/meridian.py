"""The meridional section of a symmetric flow: quantities over (r, h), from the volumes of a result.

For a planar flow, the plane normal to its line of symmetry, with r and h along e1 and e3.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from nerif.common.conventions import FACES
from nerif.common.files import atomic
from nerif.common.netcdf import write_dataset
from nerif.data.quantity_names import describe
from nerif.data.volume import Volume
from nerif.geometry.symmetry import Symmetry

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Meridian"]

AZIMUTHS = 12
POINTS_PER_VOXEL = 2  # along an edge
DOUBLE_PRECISION = ("n",)  # single precision has too few digits of n - 1


@dataclass(frozen=True)
class Meridian:
    """Quantities over (r, h)."""

    r: np.ndarray  #: (n) distance from the axis, mm
    h: np.ndarray  #: (m) coordinate along the axis from its point, mm
    quantities: dict[str, np.ndarray]
    """(m, n) by name, in the units of volumes; NaN outside the box and in masked voxels."""
    axial: bool = True  #: axisymmetric, not planar

    @classmethod
    def of(cls, volumes: Mapping[str, Volume], symmetry: Symmetry) -> Meridian:
        """Interpolate the volumes of a result linearly, and average over the azimuth."""
        from scipy.ndimage import map_coordinates

        grid = next(iter(volumes.values())).grid
        size = max(grid.box.edges) / max(grid.shape) / POINTS_PER_VOXEL
        sides = tuple(face for face in FACES if symmetry.faces((face,)) == ("x+",)) if symmetry.axial else ()
        box = symmetry.reduced_box(grid.box, sides)
        r = np.arange(0 if symmetry.axial else box.lower[0], box.upper[0] + size / 2, size)
        h = np.arange(box.lower[2], box.upper[2] + size / 2, size)
        angles = 2 * math.pi * np.arange(AZIMUTHS if symmetry.axial else 1) / AZIMUTHS
        angle, height, distance = (torch.from_numpy(a) for a in np.meshgrid(angles, h, r, indexing="ij"))
        points = symmetry.places(distance, angle, height).numpy()
        at = (points - np.array(grid.box.lower)) / np.array(grid.spacing) - 0.5
        inside = ((at >= -0.5 - 1e-6) & (at <= np.array(grid.shape[::-1]) - 0.5 + 1e-6)).all(axis=-1)
        coordinates = np.moveaxis(at, -1, 0)[::-1]
        quantities = {}
        for name, volume in volumes.items():
            values = map_coordinates(volume.values.double().numpy(), coordinates, order=1, mode="nearest")
            values[~inside] = np.nan
            finite = np.isfinite(values)
            total, count = np.where(finite, values, 0.0).sum(axis=0), finite.sum(axis=0)
            quantities[name] = np.where(2 * count >= len(angles), total / np.maximum(count, 1), np.nan)
        return cls(r, h, quantities, symmetry.axial)

    def to_dataset(self) -> xr.Dataset:
        """Return the variables of the file: quantities over h and r, mm."""
        import xarray as xr

        data = {}
        for name, values in self.quantities.items():
            unit, long_name = describe(name)
            array = values if name in DOUBLE_PRECISION else values.astype(np.float32)
            data[name] = (("h", "r"), array, {"units": unit, "long_name": long_name})
        about = ("distance from the axis", "along the axis") if self.axial else ("along e1", "along e3")
        axes = {name: (name, at, {"units": "mm", "long_name": what})
                for name, at, what in zip("rh", (self.r, self.h), about, strict=True)}  # fmt: skip
        return xr.Dataset(data, axes)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a NetCDF file, atomically."""
        write_dataset(path, self.to_dataset())

    def write_csv(self, path: str | os.PathLike[str]) -> None:
        """Write one line per point: r and h in mm, and every quantity."""
        r, h = np.meshgrid(self.r, self.h)
        columns = [r, h, *self.quantities.values()]
        table = np.stack([c.ravel() for c in columns], axis=1)
        names = ("r_mm", "h_mm", *self.quantities)
        digits = ["%.12g" if name in DOUBLE_PRECISION else "%.8g" for name in names]
        with atomic(path) as part:
            np.savetxt(part, table, digits, ",", header=",".join(names), comments="")

    def profile(self, quantity: str, height: float) -> np.ndarray:
        """Return a quantity over r at a height h, mm, interpolated linearly."""
        values = self.quantities[quantity]
        place = np.clip(np.interp(height, self.h, np.arange(len(self.h))), 0, len(self.h) - 1)
        low = min(int(place), len(self.h) - 2)
        share = place - low
        line: np.ndarray = (1 - share) * values[low] + share * values[low + 1]
        return line
