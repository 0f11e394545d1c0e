"""A measurement: its data (measurement_data.py) with the file, a summary and the display in a notebook."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import DEFAULT_AMBIENT_FACES, InputError
from nerif.common.files import ending
from nerif.common.netcdf import opened, write_dataset
from nerif.data.kinds import MEASUREMENT, reading_as
from nerif.data.measurement_data import MeasurementData, arguments_of
from nerif.data.measurement_file import CONVENTIONS, encoding, from_dataset, to_dataset
from nerif.data.measurement_summary import as_html, summary
from nerif.forward.forward_model import ForwardModel
from nerif.geometry import Box, Camera

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Measurement", "measurement_of"]


class Measurement(MeasurementData):
    # the docstring is that of its data
    def summary(self, withheld: int = 0) -> list[tuple[str, str]]:
        """Return names and values with units of a short description; `withheld`: number of views not used."""
        return summary(self, withheld)

    def _repr_html_(self) -> str:
        return as_html(self)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the file of docs/formats.md, atomically."""
        if ending(path) != ".nc":
            raise InputError(f"expected a name ending in .nc (NetCDF), got '{Path(path).name}'", field=path)
        dataset = self.to_dataset()
        write_dataset(path, dataset, encoding(dataset))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Measurement:
        """Read a measurement file."""
        with reading_as(path, MEASUREMENT), opened(path, f"a measurement (NetCDF-4, {CONVENTIONS})") as dataset:
            return cls.from_dataset(dataset)

    def to_dataset(self) -> xr.Dataset:
        """Return the variables and attributes of the file."""
        return to_dataset(self)

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> Measurement:
        """Return the measurement with such variables and attributes."""
        return cls(**from_dataset(dataset))


def measurement_of(
    values: Mapping[type[ForwardModel], Float[Tensor, "view row column c"]], cameras: Sequence[Camera], box: Box,
    n_ambient: float, wavelength_nm: float | None = None, ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES,
) -> Measurement:  # fmt: skip
    """Return a measurement of values by technique; with sigma 1 where there are several techniques."""
    maps = {kind.measured: value for kind, value in values.items()}
    if len(values) > 1:
        maps |= {kind.sigma: torch.ones_like(value) for kind, value in values.items()}
    return Measurement(
        tuple(cameras), box=box, n_ambient=n_ambient, wavelength_nm=wavelength_nm, ambient_faces=ambient_faces,
        **arguments_of(maps),
    )  # fmt: skip
