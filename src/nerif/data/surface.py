"""Quantities on the surface of bodies: triangles with values at their vertices, and their files."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerif.common.files import ending
from nerif.common.netcdf import opened, values, write_dataset
from nerif.data.quantity_names import describe
from nerif.data.vti import write_vtp

__all__ = ["SurfaceMap"]


@dataclass(frozen=True)
class SurfaceMap:
    """Quantities at the vertices of triangles; NaN where they are unknown, as outside the box."""

    vertices: Float[Tensor, "n 3"]  #: (n, 3) mm, world frame
    faces: Int[Tensor, "m 3"]  #: (m, 3) vertices of each triangle
    quantities: dict[str, Float[Tensor, " n"]]  #: (n,) by name, such as density
    attributes: dict[str, float | str] = field(default_factory=dict)
    """Numbers and texts of the result, such as n_ambient."""

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a file for ParaView (.vtp) or NetCDF-4 (.nc), atomically."""
        if ending(path) == ".vtp":
            write_vtp(path, self.vertices, self.faces, self.quantities, self.attributes)
            return
        import xarray as xr

        dataset = xr.Dataset(
            {
                "vertices": (("vertex", "i"), self.vertices.numpy(), {"units": "mm"}),
                "faces": (("face", "corner"), self.faces.numpy().astype("int32"), {"units": "1"}),
                **{
                    name: (("vertex",), x.numpy(), {"units": describe(name)[0], "long_name": describe(name)[1]})
                    for name, x in self.quantities.items()
                },
            },
            attrs=self.attributes,
        )
        write_dataset(path, dataset)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> SurfaceMap:
        """Read a NetCDF-4 file."""
        with opened(path, "quantities on the surface of bodies (.nc)") as dataset:
            arrays = {str(name): torch.from_numpy(values(dataset[name])) for name in dataset.data_vars}
            attributes = {str(name): value for name, value in dataset.attrs.items()}
        return cls(arrays.pop("vertices"), arrays.pop("faces").long(), arrays, attributes)
