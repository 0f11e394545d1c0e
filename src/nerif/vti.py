"""VTK image data files (.vti): what ParaView opens."""

from __future__ import annotations

import os
from typing import Any

import torch
from torch import Tensor

from nerif.atomic import atomic
from nerif.conventions import InputError
from nerif.geometry import Box, Grid

__all__ = ["read_vti", "write_vti"]


def write_vti(
    path: str | os.PathLike[str], arrays: dict[str, Tensor], grid: Grid, attributes: dict[str, float | str]
) -> None:
    """Write (z, y, x) arrays as point data of a VTK image, x fastest, atomically; lengths in mm."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkDoubleArray, vtkStringArray
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    nz, ny, nx = grid.shape
    image = vtkImageData()
    image.SetDimensions(nx, ny, nz)
    image.SetSpacing(*grid.spacing)
    image.SetOrigin(*(float(grid.axis(a)[0]) for a in "xyz"))
    for quantity, values in arrays.items():
        array = numpy_to_vtk(values.cpu().contiguous().numpy().ravel(), deep=True)
        array.SetName(quantity)
        image.GetPointData().AddArray(array)
    image.GetPointData().SetActiveScalars(next(iter(arrays)))
    for name, value in attributes.items():
        entry: Any = vtkStringArray() if isinstance(value, str) else vtkDoubleArray()
        entry.SetName(name)
        entry.InsertNextValue(value if isinstance(value, str) else float(value))
        image.GetFieldData().AddArray(entry)
    writer = vtkXMLImageDataWriter()
    with atomic(path) as part:
        writer.SetFileName(str(part))
        writer.SetInputData(image)
        writer.SetDataModeToAppended()
        writer.EncodeAppendedDataOff()
        if not writer.Write():
            raise InputError(f"{path}: could not be written; is the folder there, and the disk not full?")


def read_vti(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], Grid, dict[str, float | str]]:
    """Read the point data of a VTK image as (z, y, x) arrays, their grid and the field data.

    Raises
    ------
    InputError
        If the file is no VTK image, or is turned out of the axes.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    reader = vtkXMLImageDataReader()
    if not reader.CanReadFile(str(path)):
        raise InputError(f"{path}: not a VTK image file (.vti), or truncated")
    reader.SetFileName(str(path))
    reader.Update()
    image = reader.GetOutput()
    nx, ny, nz = image.GetDimensions()
    if nx * ny * nz == 0:
        raise InputError(f"{path}: expected a VTK image with voxels, got an empty or truncated one")
    spacing, extent = image.GetSpacing(), image.GetExtent()
    first = [o + s * e for o, s, e in zip(image.GetOrigin(), spacing, extent[::2], strict=True)]
    lower = [c - s / 2 for c, s in zip(first, spacing, strict=True)]
    upper = [c + s * n for c, s, n in zip(lower, spacing, (nx, ny, nz), strict=True)]
    grid = Grid(Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])), (nz, ny, nx))
    data = image.GetPointData()
    arrays = {}
    for i in range(data.GetNumberOfArrays()):
        if data.GetArray(i).GetNumberOfComponents() == 1:
            values = vtk_to_numpy(data.GetArray(i)).reshape(nz, ny, nx)
            arrays[data.GetArrayName(i)] = torch.from_numpy(values.copy())
    fields = image.GetFieldData()
    attributes: dict[str, float | str] = {}
    for i in range(fields.GetNumberOfArrays()):
        entry = fields.GetAbstractArray(i)
        if entry.GetNumberOfValues() == 1:
            attributes[entry.GetName()] = entry.GetValue(0)
    return arrays, grid, attributes
