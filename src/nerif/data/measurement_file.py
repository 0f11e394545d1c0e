"""The file of a measurement (NetCDF-4, Conventions BOST-1.1 or 1.0): its variables, what is written and what refused.

What a technique measures is a variable on view, row, column (and component, where it has several); its name is the
technique's. The rest is known of the rig.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from nerif.common.conventions import COMPONENTS, DEFAULT_AMBIENT_FACES, InputError, parse_faces
from nerif.common.netcdf import reading, values
from nerif.data.measurement import Measurement
from nerif.forward.base import ForwardModel
from nerif.forward.deflection import Deflection
from nerif.forward.registry import TECHNIQUES, technique
from nerif.geometry import PERSPECTIVE, Box, Camera, Lens, Plane, Projection, projection_named

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "CONVENTIONS", "PLAIN", "encoding", "from_dataset", "known_conventions", "map_names", "to_dataset", "variables",
]  # fmt: skip

PLAIN, CONVENTIONS = "BOST-1.0", "BOST-1.1"
"""Of files that hold what version 1.0 had, and of those that hold more."""

PIXELS = ("view", "row", "column")

RIG = {
    "valid": (PIXELS, "1"),
    "flow_mask": (PIXELS, "1"),
    "intrinsics": (("view", "i", "j"), "px"),
    "distortion": (("view", "coefficient"), "1"),
    "rotation": (("view", "i", "j"), "1"),
    "translation": (("view", "i"), "mm"),
    "background_normal": (("view", "i"), "1"),
    "background_offset": (("view",), "mm"),
    "box": (("corner", "i"), "mm"),
    "image_size": (("view", "side"), "px"),
    "aperture_diameter": (("view",), "mm"),
    "focus_distance": (("view",), "mm"),
    "window": (("view",), "px"),
    "pose_sigma": (("view", "parameter"), "rad rad rad mm mm mm"),
}
"""Dimensions and unit of what is known of the rig."""

SPELLED = {"px/mm": "px mm-1"}
"""How units are written that may be read in either spelling."""

MASKS = ("valid", "flow_mask")

NEEDED = ("intrinsics", "rotation", "translation", "box")
BACKGROUND = ("background_normal", "background_offset")
SIZES = {"i": 3, "j": 3, "coefficient": 5, "corner": 2, "side": 2, "parameter": 6}
MOST_PIXELS = 1 << 32
"""Of all views together; a damaged file may claim any number."""


def variables() -> dict[str, tuple[tuple[str, ...], str]]:
    """Return dimensions and unit of every variable that a file may have."""
    measured: dict[str, tuple[tuple[str, ...], str]] = {}
    for kind in TECHNIQUES.values():
        own = (len(kind.channels), kind.unit)
        for name, (channels, unit) in {kind.measured: own, kind.sigma: own, **kind.beside}.items():
            measured[name] = (PIXELS if channels == 1 else (*PIXELS, _component(channels)), unit)
    return {**measured, **RIG}


def _component(channels: int) -> str:
    """The dimension that so many channels stand along: those of one size share one."""
    return "component" if channels == len(COMPONENTS) else f"component_{channels}"


def map_names() -> tuple[str, ...]:
    """Return the names of what has a value a pixel."""
    return tuple(name for name, (dimensions, _) in variables().items() if dimensions[:3] == PIXELS)


def known_conventions(found: object) -> bool:
    """Return whether an attribute Conventions is that of a measurement."""
    return isinstance(found, str) and found in (PLAIN, CONVENTIONS)


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

    cameras, known = measurement.cameras, variables()
    data: dict[str, np.ndarray] = {
        "intrinsics": stack([c.intrinsics for c in cameras]),
        "distortion": stack([c.distortion for c in cameras]),
        "rotation": stack([c.rotation for c in cameras]),
        "translation": stack([c.translation for c in cameras]),
        "box": np.array([measurement.box.lower, measurement.box.upper]),
        "image_size": np.array([c.image_size for c in cameras], dtype=np.int32),
    }
    if any(c.background is not None for c in cameras):
        nowhere = torch.full((3,), torch.nan, dtype=torch.float64)
        data["background_normal"] = stack([nowhere if c.background is None else c.background.normal for c in cameras])
        data["background_offset"] = np.array([np.nan if c.background is None else c.background.offset for c in cameras])
    lenses = [c.lens for c in cameras if c.lens is not None]
    if any(lens.window > 0 for lens in lenses):
        data["window"] = np.array([lens.window for lens in lenses])
    if any(lens.diameter > 0 for lens in lenses):
        data["aperture_diameter"] = np.array([lens.diameter for lens in lenses])
    if any(lens.focus is not None for lens in lenses):
        data["focus_distance"] = np.array([np.nan if lens.focus is None else lens.focus for lens in lenses])
    if any(c.pose_sigma is not None for c in cameras):
        unknown = torch.full((6,), torch.nan, dtype=torch.float64)
        data["pose_sigma"] = stack([unknown if c.pose_sigma is None else c.pose_sigma for c in cameras])
    masks = {"valid": measurement.valid, "flow_mask": measurement.flow_mask}
    for name, value in {**measurement.measured_maps, **masks}.items():
        if value is not None:
            data[name] = (value.view(torch.int8) if value.dtype == torch.bool else value.float()).numpy()
    dataset = xr.Dataset({k: (known[k][0], v, {"units": known[k][1]}) for k, v in data.items()})
    scales = {c.projection.unit for c in cameras}
    if len(scales) == 1:
        dataset["intrinsics"].attrs["units"] = _spelled(scales.pop())
    dataset = dataset.assign_coords(view=list(measurement.names))
    if measurement.displacement is not None:
        dataset = dataset.assign_coords(component=list(COMPONENTS))
    names = [kind.name for kind in measurement.techniques]
    pinholes = all(c.projection == PERSPECTIVE for c in cameras)
    plain = names == [Deflection.name] and pinholes and not lenses and "pose_sigma" not in data
    dataset.attrs = {
        "Conventions": PLAIN if plain else CONVENTIONS,
        **({} if plain else {"technique": " ".join(names)}),
        "n_ambient": measurement.n_ambient,
        "ambient_faces": " ".join(measurement.ambient_faces),
    }
    if not pinholes:
        dataset["projection"] = (("view",), np.array([c.projection.name for c in cameras], dtype=object))
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
    if not known_conventions(found):
        raise InputError(
            f"expected '{PLAIN}' or '{CONVENTIONS}', got '{found}'; is it a measurement?", field="attribute Conventions"
        )
    _check_variables(dataset)
    faces = dataset.attrs.get("ambient_faces", " ".join(DEFAULT_AMBIENT_FACES))
    if not isinstance(faces, str):
        raise InputError(f"expected a text such as 'x- x+ y- y+', got {faces!r}", field="attribute ambient_faces")
    own = ("displacement", "sigma", *MASKS)
    maps = {name: _map(dataset, name) for name in map_names() if name in dataset and name not in own}
    for kind in TECHNIQUES.values():
        if kind.measured in maps:
            maps = kind.complete(maps, dataset.attrs)
    index = any(kind.quantity == Deflection.quantity for kind in _techniques(dataset))
    return {
        "cameras": _cameras(dataset),
        "box": _box(dataset),
        "displacement": None,
        **{name: _map(dataset, name) for name in own if name in dataset},
        "maps": maps,
        "n_ambient": _number(dataset, "n_ambient", "the index around the flow, e.g. 1.00027", None if index else 1.0),
        "wavelength_nm": _number(dataset, "wavelength_nm", "nm") if "wavelength_nm" in dataset.attrs else None,
        "ambient_faces": parse_faces(faces, "attribute ambient_faces"),
    }


def _techniques(dataset: xr.Dataset) -> tuple[type[ForwardModel], ...]:
    """The techniques of a file: those its attribute names, each of which needs its variable, else those it holds."""
    named = dataset.attrs.get("technique", "")
    if not isinstance(named, str):
        raise InputError(f"expected one of {', '.join(TECHNIQUES)}, got {named!r}", field="attribute technique")
    kinds = tuple(technique(name) for name in named.replace(",", " ").split())
    return kinds or tuple(k for k in TECHNIQUES.values() if k.measured in dataset) or (Deflection,)


def _check_variables(dataset: xr.Dataset) -> None:
    """Refuse missing variables and wrong dimensions, sizes, types and units, by name."""
    kinds = _techniques(dataset)
    needed = [*(kind.measured for kind in kinds), *NEEDED, *(BACKGROUND if any(k.background for k in kinds) else ())]
    sizes = SIZES | {_component(n): n for n in (len(kind.channels) for kind in TECHNIQUES.values()) if n > 1}
    for name, (dimensions, unit) in variables().items():
        if name not in dataset:
            if name not in needed:
                continue
            raise InputError(f"expected on ({', '.join(dimensions)}) in {unit}, got none", field=f"variable '{name}'")
        variable = dataset[name]
        if sorted(map(str, variable.dims)) != sorted(dimensions):
            got = tuple(map(str, variable.dims))
            raise InputError(f"expected dimensions {dimensions}, got {got}", field=f"variable '{name}'")
        for dimension in dimensions:
            size, given_size = sizes.get(dimension), variable.sizes[dimension]
            if given_size == 0 or (size is not None and given_size != size):
                raise InputError(
                    f"expected {size or 'some'} along {dimension}, got {given_size}", field=f"variable '{name}'"
                )
        given, units = variable.attrs.get("units", unit), [unit]
        if name == "intrinsics":
            units = list(dict.fromkeys([unit, *(_spelled(p.unit) for p in _projections(dataset))]))
        words = " ".join(given.replace(",", " ").split()) if isinstance(given, str) else ""
        if _spelled(words) not in units:
            raise InputError(f"expected units '{' or '.join(units)}', got '{given}'", field=f"variable '{name}'")
    views, rows, columns = (dataset.sizes[name] for name in ("view", "row", "column"))
    if views * rows * columns > MOST_PIXELS:
        shape = f"{views} x {rows} x {columns}"
        raise InputError(f"expected views of some megapixels, got {shape}", field=f"variable '{kinds[0].measured}'")


def _array(dataset: xr.Dataset, name: str, gaps: bool = False) -> Tensor:
    """A small variable in double precision, in the order of its dimensions, every number finite unless gaps may be."""
    numbers = values(dataset[name].transpose(*variables()[name][0])).astype(np.float64)
    if not gaps and not np.isfinite(numbers).all():
        raise InputError(
            f"expected finite numbers, got {numbers[~np.isfinite(numbers)][0]}", field=f"variable '{name}'"
        )
    return torch.from_numpy(np.ascontiguousarray(numbers))


def _map(dataset: xr.Dataset, name: str) -> Tensor:
    """A map: measured numbers in single precision, masks as booleans."""
    variable, whole = dataset[name], variables()[name][0]
    _, *dimensions = whole
    shape = [variable.sizes[d] for d in whole]
    measured = name not in MASKS
    result = torch.empty(shape, dtype=torch.float32 if measured else torch.bool)
    for i in range(shape[0]):
        numbers = values(variable.isel(view=i).transpose(*dimensions))
        if measured:
            with np.errstate(over="ignore"):  # too large for single precision is not a displacement either
                numbers = numbers.astype(np.float32, copy=False)
        elif numbers.dtype.kind == "f" and np.isnan(numbers).any():
            raise InputError("expected 0 or 1, got NaN", field=f"variable '{name}'")
        else:
            numbers = numbers != 0
        result[i] = torch.from_numpy(np.ascontiguousarray(numbers))
    return result


def _box(dataset: xr.Dataset) -> Box:
    lower, upper = _array(dataset, "box").tolist()
    return Box(tuple(lower), tuple(upper))


def _spelled(unit: str) -> str:
    return SPELLED.get(unit, unit)


def _texts(variable: xr.DataArray) -> list[str]:
    """Texts of any kind: of variable or fixed length, in characters or bytes, padded or not."""
    with reading(f"variable '{variable.name}': cannot be read; is the file damaged?"):
        found = variable.values.ravel()
    return [(v.decode(errors="replace") if isinstance(v, bytes) else str(v)).strip(" \0") for v in found]


def _names(dataset: xr.Dataset) -> list[str]:
    return _texts(dataset["view"]) if "view" in dataset.coords else [str(i) for i in range(dataset.sizes["view"])]


def _projections(dataset: xr.Dataset) -> list[Projection]:
    names = _names(dataset)
    if "projection" not in dataset:
        return [PERSPECTIVE] * len(names)
    found = dataset["projection"]
    if found.dims != ("view",):
        raise InputError(f"expected one name a view, got dimensions {found.dims}", field="variable 'projection'")
    return [projection_named(p, f"projection of view '{n}'") for n, p in zip(names, _texts(found), strict=True)]


def _cameras(dataset: xr.Dataset) -> tuple[Camera, ...]:
    views, names, projections = dataset.sizes["view"], _names(dataset), _projections(dataset)
    whole = torch.tensor([dataset.sizes["row"], dataset.sizes["column"]], dtype=torch.float64).expand(views, 2)
    sizes = _array(dataset, "image_size") if "image_size" in dataset else whole
    distortion = _array(dataset, "distortion") if "distortion" in dataset else torch.zeros(views, 5).double()
    intrinsics, rotation, translation = (_array(dataset, n) for n in ("intrinsics", "rotation", "translation"))
    nowhere = torch.full((views, 3), torch.nan, dtype=torch.float64), torch.full((views,), torch.nan)
    normals, offsets = (
        _array(dataset, n, True) if n in dataset else none for n, none in zip(BACKGROUND, nowhere, strict=True)
    )
    lenses = _lenses(dataset, names)
    sure = _array(dataset, "pose_sigma", True) if "pose_sigma" in dataset else torch.full((views, 6), torch.nan)
    cameras = []
    for i, name in enumerate(names):
        height, width = sizes[i].tolist()
        cameras.append(
            Camera(
                intrinsics=intrinsics[i],
                rotation=rotation[i],
                translation=translation[i],
                image_size=(int(height), int(width)),
                background=_plane(normals[i], offsets[i], name),
                distortion=distortion[i],
                name=name,
                projection=projections[i],
                lens=lenses[i],
                pose_sigma=None if bool(sure[i].isnan().all()) else sure[i],
            )
        )
    return tuple(cameras)


def _lenses(dataset: xr.Dataset, names: list[str]) -> list[Lens | None]:
    """The lenses of all views, and their windows; none of any where no aperture and no window is known."""
    nought = torch.zeros(len(names))
    diameters, windows = (_array(dataset, n) if n in dataset else nought for n in ("aperture_diameter", "window"))
    nowhere = torch.full((len(names),), torch.nan)
    focus = _array(dataset, "focus_distance", True) if "focus_distance" in dataset else nowhere
    found: list[Lens | None] = []
    for name, diameter, depth, edge in zip(names, diameters.tolist(), focus.tolist(), windows.tolist(), strict=True):
        try:
            found.append(Lens(diameter, None if math.isnan(depth) else depth, window=edge))
        except InputError as error:
            raise error.inside(f"view '{name}'") from None
    return found if any(lens is not None and lens.wide for lens in found) else [None] * len(names)


def _plane(normal: Tensor, offset: Tensor, view: str) -> Plane | None:
    """The background of a view; none where neither of its numbers is given."""
    if bool(normal.isnan().all()):
        return None
    length = float(normal.norm())
    if not 0.99 < length < 1.01:
        raise InputError(f"expected a unit vector, got length {length:g}", field=f"background_normal of view '{view}'")
    if not bool(offset.isfinite()):
        raise InputError(
            f"expected a finite number in mm beside background_normal, "
            f"got {float(offset)}; give it, or leave out background_normal of a view without a background",
            field=f"background_offset of view '{view}'",
        )
    return Plane(normal / length, float(offset) / length)


def _number(dataset: xr.Dataset, name: str, what: str, otherwise: float | None = None) -> float:
    value = dataset.attrs.get(name, otherwise)
    if not isinstance(value, int | float | np.number):
        got = "none" if value is None else repr(value)
        raise InputError(f"expected a number ({what}), got {got}", field=f"attribute {name}")
    return float(value)
