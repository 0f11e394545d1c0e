"""The half plane beside the axis of a symmetric flow: every quantity over (r, h), read off the volumes of a result.

Of a planar flow it is the plane across the line on which nothing changes; r and h are measured along e1 and e3 there.
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
from nerif.data.volume import Volume, describe
from nerif.geometry.symmetry import Symmetry

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Meridian"]

AROUND = 12  # places of a ring
FINER = 2  # points along an edge of a voxel
FROM_ONE = ("n",)  # of which single precision would keep too few digits of n - 1


@dataclass(frozen=True)
class Meridian:
    """Quantities over (r, h).

    Parameters
    ----------
    r, h : (n), (m) distance from the axis, and along it from the point that is named, mm
    quantities : (m, n) by name, in the units of volumes; NaN outside the box, and where the volume is masked
    axial : whether about an axis
    """

    r: np.ndarray
    h: np.ndarray
    quantities: dict[str, np.ndarray]
    axial: bool = True

    @classmethod
    def of(cls, volumes: Mapping[str, Volume], symmetry: Symmetry) -> Meridian:
        """Read the volumes of a result between their voxels, the mean around the axis."""
        from scipy.ndimage import map_coordinates

        grid = next(iter(volumes.values())).grid
        size = max(grid.box.edges) / max(grid.shape) / FINER
        sides = tuple(face for face in FACES if symmetry.faces((face,)) == ("x+",)) if symmetry.axial else ()
        box = symmetry.reduced_box(grid.box, sides)
        r = np.arange(0 if symmetry.axial else box.lower[0], box.upper[0] + size / 2, size)
        h = np.arange(box.lower[2], box.upper[2] + size / 2, size)
        angles = 2 * math.pi * np.arange(AROUND if symmetry.axial else 1) / AROUND
        angle, height, distance = (torch.from_numpy(a) for a in np.meshgrid(angles, h, r, indexing="ij"))
        points = symmetry.places(distance, angle, height).numpy()
        at = (points - np.array(grid.box.lower)) / np.array(grid.spacing) - 0.5
        most = np.array(grid.shape[::-1]) - 0.5
        inside = ((at >= -0.5 - 1e-6) & (at <= most + 1e-6)).all(axis=-1)
        places = np.moveaxis(at, -1, 0)[::-1]
        found = {}
        for name, volume in volumes.items():
            values = volume.values.double().numpy()
            read = map_coordinates(values, places, order=1, mode="nearest")
            read[~inside] = np.nan
            known = np.isfinite(read)
            total = np.where(known, read, 0.0).sum(axis=0)
            count = known.sum(axis=0)
            found[name] = np.where(2 * count >= len(angles), total / np.maximum(count, 1), np.nan)
        return cls(r, h, found, symmetry.axial)

    def to_dataset(self) -> xr.Dataset:
        """Return what the file holds: quantities over h and r, mm, with their units and names."""
        import xarray as xr

        data = {}
        for name, values in self.quantities.items():
            unit, long_name = describe(name)
            kept = values if name in FROM_ONE else values.astype(np.float32)
            data[name] = (("h", "r"), kept, {"units": unit, "long_name": long_name})
        about = ("distance from the axis", "along the axis") if self.axial else ("along e1", "along e3")
        axes = {name: (name, at, {"units": "mm", "long_name": what})
                for name, at, what in zip("rh", (self.r, self.h), about, strict=True)}  # fmt: skip
        return xr.Dataset(data, axes)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write NAME.nc, atomically."""
        with atomic(path) as part:
            self.to_dataset().to_netcdf(part, engine="h5netcdf")

    def write_csv(self, path: str | os.PathLike[str]) -> None:
        """Write a table with a line a place: r and h in mm, and every quantity."""
        r, h = np.meshgrid(self.r, self.h)
        columns = [r, h, *self.quantities.values()]
        table = np.stack([c.ravel() for c in columns], axis=1)
        names = ("r_mm", "h_mm", *self.quantities)
        digits = ["%.12g" if name in FROM_ONE else "%.8g" for name in names]
        with atomic(path) as part:
            np.savetxt(part, table, digits, ",", header=",".join(names), comments="")

    def profile(self, quantity: str, height: float) -> np.ndarray:
        """Return a quantity over r at a height, mm, between the nearest two."""
        values = self.quantities[quantity]
        place = np.clip(np.interp(height, self.h, np.arange(len(self.h))), 0, len(self.h) - 1)
        low = min(int(place), len(self.h) - 2)
        share = place - low
        line: np.ndarray = (1 - share) * values[low] + share * values[low + 1]
        return line
