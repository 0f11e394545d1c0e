"""Velocity over time (velocity.zarr): volumes of its components, pressure and residuals, which xarray can open.

Speed and vorticity follow from the components when they are read.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.kinds import VELOCITY, VELOCITY_KIND, kind_of
from nerif.data.quantity_names import FLOW_QUANTITIES
from nerif.data.volume import COMPONENTS, Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.geometry import Grid

__all__ = ["STANDARD_NAMES", "VelocitySequence", "open_volumes"]

DERIVED = ("speed", "vorticity")
STANDARD_NAMES = {"u": "eastward_wind", "v": "northward_wind", "w": "upward_air_velocity"}
"""CF standard names of components along x, y, z, of which CF knows those of the atmosphere only."""


class VelocitySequence(VolumeSequence):
    """A Zarr store of velocities in m/s on one grid; NaN where the data do not determine them."""

    kinds = (VELOCITY,)

    @classmethod
    def begin(
        cls, path: Path, times: Sequence[float], grid: Grid, quantities: Sequence[str], attributes: Mapping[str, Any]
    ) -> VelocitySequence:
        """Make a store without values, in place of an earlier one.

        Times are in s; beside the components u, v, w are quantities such as pressure; attributes hold physics and
        properties of the fluid, JSON.
        """
        about = {"title": "Velocity over time", "kind": VELOCITY_KIND, "n_ambient": 1.0, **attributes}
        store = cls.create(path, times, grid, (*COMPONENTS, *quantities), about["n_ambient"], about)
        for name, standard in STANDARD_NAMES.items():
            store.array(name).attrs["standard_name"] = standard
        return store

    @property
    def quantities(self) -> tuple[str, ...]:
        names = [name for base in FLOW_QUANTITIES for name in (base, f"{base}_std")]
        stored = super().quantities
        others = [name for name in stored if name not in names]
        return (*DERIVED, *(name for name in names if name in stored), *others)

    def volume(self, index: int, quantity: str) -> Volume:
        if quantity not in DERIVED:
            return super().volume(index, quantity)
        vectors = self.vectors(index)
        values = vectors.norm(dim=0) if quantity == "speed" else curl(vectors, self.grid).norm(dim=0)
        return Volume.of(values, self.grid, quantity, self.n_ambient)

    def vectors(self, index: int) -> Float[Tensor, "3 z y x"]:
        """Return the velocity of one frame along x, y, z, m/s."""
        return torch.stack([super(VelocitySequence, self).volume(index, name).values for name in COMPONENTS])

    def write_frame(self, index: int, arrays: Mapping[str, Tensor]) -> None:
        """Write the values of one frame by quantity."""
        if missing := {*super().quantities} - {*arrays}:
            raise InputError(f"expected all quantities of the store, got none of {', '.join(sorted(missing))}")
        for name, values in arrays.items():
            self.array(name)[index] = values.float().cpu().numpy()


def curl(vectors: Float[Tensor, "3 z y x"], grid: Grid) -> Float[Tensor, "3 z y x"]:
    """Return the vorticity of a velocity in m/s, 1/s, by central differences."""
    spacing = [h / 1e3 for h in grid.spacing[::-1]]
    slopes = [torch.gradient(component, spacing=spacing, dim=(0, 1, 2)) for component in vectors]  # by z, y, x
    (uz, uy, _), (vz, _, vx), (_, wy, wx) = slopes
    return torch.stack([wy - vz, uz - wx, vx - uy])


def open_volumes(path: str | os.PathLike[str]) -> VolumeSequence:
    """Open volumes over time, or velocities, whose quantities include speed and vorticity."""
    return VelocitySequence(path) if kind_of(path) is VELOCITY else VolumeSequence(path)
