"""The file of a measurement (NetCDF-4, Conventions BOST-1.0): its variables, what is written and what is refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from nerif.conventions import COMPONENTS, DEFAULT_AMBIENT_FACES, InputError, parse_faces
from nerif.geometry import PERSPECTIVE, Box, Camera, Plane, projection_named
from nerif.netcdf import values

if TYPE_CHECKING:
    import xarray as xr

    from nerif.measurement import Measurement

__all__ = ["CONVENTIONS", "MAPS", "VARIABLES", "encoding", "from_dataset", "to_dataset"]

CONVENTIONS = "BOST-1.0"

VARIABLES = {
    "displacement": (("view", "row", "column", "component"), "px"),
    "sigma": (("view", "row", "column", "component"), "px"),
    "valid": (("view", "row", "column"), "1"),
    "flow_mask": (("view", "row", "column"), "1"),
    "intrinsics": (("view", "i", "j"), "px"),
    "distortion": (("view", "coefficient"), "1"),
    "rotation": (("view", "i", "j"), "1"),
    "translation": (("view", "i"), "mm"),
    "background_normal": (("view", "i"), "1"),
    "background_offset": (("view",), "mm"),
    "box": (("corner", "i"), "mm"),
    "image_size": (("view", "side"), "px"),
}
"""Dimensions and unit of every variable of the file."""

MAPS = ("displacement", "sigma", "valid", "flow_mask")
"""What is measured; the rest is known of the rig."""

OPTIONAL = ("sigma", "valid", "flow_mask", "distortion", "image_size")
SIZES = {"component": 2, "i": 3, "j": 3, "coefficient": 5, "corner": 2, "side": 2}
MOST_PIXELS = 1 << 32
"""Of all views together; a damaged file may claim any number."""


def encoding(dataset: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Return how the maps are packed: chunks within one view, so that one view is read without the others."""
    packed = {}
    for name, variable in dataset.data_vars.items():
        if variable.dims[:3] == ("view", "row", "column"):
            _, rows, columns, *rest = variable.shape
            chunks = (1, min(rows, 256), min(columns, 256), *rest)
            packed[str(name)] = {
                "zlib": True, "complevel": 1, "shuffle": True, "chunksizes": chunks, "_FillValue": None,
            }  # fmt: skip
    return packed


def to_dataset(measurement: Measurement) -> xr.Dataset:
    """Return the variables and attributes of the file; maps in single precision are not copied."""
    import xarray as xr

    def stack(values: list[Tensor]) -> np.ndarray:
        return torch.stack(values).numpy()

    cameras = measurement.cameras
    data: dict[str, np.ndarray] = {
        "intrinsics": stack([c.intrinsics for c in cameras]),
        "distortion": stack([c.distortion for c in cameras]),
        "rotation": stack([c.rotation for c in cameras]),
        "translation": stack([c.translation for c in cameras]),
        "background_normal": stack([c.plane.normal for c in cameras]),
        "background_offset": np.array([c.plane.offset for c in cameras]),
        "box": np.array([measurement.box.lower, measurement.box.upper]),
        "image_size": np.array([c.image_size for c in cameras], dtype=np.int32),
    }
    for name in MAPS:
        value = getattr(measurement, name)
        if value is not None:
            data[name] = (value.view(torch.int8) if value.dtype == torch.bool else value.float()).numpy()
    dataset = xr.Dataset({k: (VARIABLES[k][0], v, {"units": VARIABLES[k][1]}) for k, v in data.items()})
    dataset = dataset.assign_coords(view=list(measurement.names), component=list(COMPONENTS))
    dataset.attrs = {
        "Conventions": CONVENTIONS,
        "n_ambient": measurement.n_ambient,
        "ambient_faces": " ".join(measurement.ambient_faces),
    }
    kinds = [c.projection.name for c in cameras]
    if set(kinds) != {PERSPECTIVE.name}:
        dataset["projection"] = (("view",), np.array(kinds, dtype=object))
    if measurement.wavelength_nm is not None:
        dataset.attrs["wavelength_nm"] = measurement.wavelength_nm
    return dataset


def from_dataset(dataset: xr.Dataset) -> dict[str, Any]:
    """Return the arguments of a Measurement; maps are read view by view.

    Raises
    ------
    InputError
        If variables or attributes break the contract; the message names the variable.
    """
    found = dataset.attrs.get("Conventions")
    if not (isinstance(found, str) and found == CONVENTIONS):
        raise InputError(f"attribute Conventions: expected '{CONVENTIONS}', got '{found}'; is it a measurement?")
    _check_variables(dataset)
    faces = dataset.attrs.get("ambient_faces", " ".join(DEFAULT_AMBIENT_FACES))
    if not isinstance(faces, str):
        raise InputError(f"attribute ambient_faces: expected a text such as 'x- x+ y- y+', got {faces!r}")
    return {
        "cameras": _cameras(dataset),
        "box": _box(dataset),
        **{name: _map(dataset, name) for name in MAPS if name in dataset},
        "n_ambient": _number(dataset, "n_ambient", "the index around the flow, e.g. 1.00027"),
        "wavelength_nm": _number(dataset, "wavelength_nm", "nm") if "wavelength_nm" in dataset.attrs else None,
        "ambient_faces": parse_faces(faces, "attribute ambient_faces"),
    }


def _check_variables(dataset: xr.Dataset) -> None:
    """Refuse missing variables and wrong dimensions, sizes, types and units, by name."""
    for name, (dimensions, unit) in VARIABLES.items():
        if name not in dataset:
            if name in OPTIONAL:
                continue
            raise InputError(f"variable '{name}': expected on ({', '.join(dimensions)}) in {unit}, got none")
        variable = dataset[name]
        if sorted(map(str, variable.dims)) != sorted(dimensions):
            got = tuple(map(str, variable.dims))
            raise InputError(f"variable '{name}': expected dimensions {dimensions}, got {got}")
        for dimension in dimensions:
            size, given_size = SIZES.get(dimension), variable.sizes[dimension]
            if given_size == 0 or (size is not None and given_size != size):
                raise InputError(f"variable '{name}': expected {size or 'some'} along {dimension}, got {given_size}")
        given = variable.attrs.get("units", unit)
        if not (isinstance(given, str) and given == unit):
            raise InputError(f"variable '{name}': expected units '{unit}', got '{given}'")
    views, rows, columns = (dataset.sizes[name] for name in ("view", "row", "column"))
    if views * rows * columns > MOST_PIXELS:
        shape = f"{views} x {rows} x {columns}"
        raise InputError(f"variable 'displacement': expected views of some megapixels, got {shape}")


def _array(dataset: xr.Dataset, name: str) -> Tensor:
    """A small variable in double precision, in the order of its dimensions, every number finite."""
    numbers = values(dataset[name].transpose(*VARIABLES[name][0])).astype(np.float64)
    if not np.isfinite(numbers).all():
        raise InputError(f"variable '{name}': expected finite numbers, got {numbers[~np.isfinite(numbers)][0]}")
    return torch.from_numpy(np.ascontiguousarray(numbers))


def _map(dataset: xr.Dataset, name: str) -> Tensor:
    """A map: measured numbers in single precision, masks as booleans."""
    variable, (_, *dimensions) = dataset[name], VARIABLES[name][0]
    shape = [variable.sizes[d] for d in VARIABLES[name][0]]
    measured = dimensions[-1] == "component"
    result = torch.empty(shape, dtype=torch.float32 if measured else torch.bool)
    for i in range(shape[0]):
        numbers = values(variable.isel(view=i).transpose(*dimensions))
        if measured:
            with np.errstate(over="ignore"):  # too large for single precision is not a displacement either
                numbers = numbers.astype(np.float32, copy=False)
        elif numbers.dtype.kind == "f" and np.isnan(numbers).any():
            raise InputError(f"variable '{name}': expected 0 or 1, got NaN")
        else:
            numbers = numbers != 0
        result[i] = torch.from_numpy(np.ascontiguousarray(numbers))
    return result


def _box(dataset: xr.Dataset) -> Box:
    lower, upper = _array(dataset, "box").tolist()
    return Box(tuple(lower), tuple(upper))


def _cameras(dataset: xr.Dataset) -> tuple[Camera, ...]:
    views = dataset.sizes["view"]
    names = [str(n) for n in dataset["view"].values] if "view" in dataset.coords else [str(i) for i in range(views)]
    whole = torch.tensor([dataset.sizes["row"], dataset.sizes["column"]], dtype=torch.float64).expand(views, 2)
    sizes = _array(dataset, "image_size") if "image_size" in dataset else whole
    distortion = _array(dataset, "distortion") if "distortion" in dataset else torch.zeros(views, 5).double()
    intrinsics, rotation, translation = (_array(dataset, n) for n in ("intrinsics", "rotation", "translation"))
    normals, offsets = _array(dataset, "background_normal"), _array(dataset, "background_offset")
    kinds = dataset["projection"].values if "projection" in dataset else [PERSPECTIVE.name] * views
    cameras = []
    for i, name in enumerate(names):
        length = float(normals[i].norm())
        if not 0.99 < length < 1.01:
            raise InputError(f"background_normal of view '{name}': expected a unit vector, got length {length:g}")
        height, width = sizes[i].tolist()
        cameras.append(
            Camera(
                intrinsics=intrinsics[i],
                rotation=rotation[i],
                translation=translation[i],
                image_size=(int(height), int(width)),
                background=Plane(normals[i] / length, float(offsets[i]) / length),
                distortion=distortion[i],
                name=name,
                projection=projection_named(str(kinds[i]), f"projection of view '{name}'"),
            )
        )
    return tuple(cameras)


def _number(dataset: xr.Dataset, name: str, what: str) -> float:
    value = dataset.attrs.get(name)
    if not isinstance(value, int | float | np.number):
        got = "none" if value is None else repr(value)
        raise InputError(f"attribute {name}: expected a number ({what}), got {got}")
    return float(value)
