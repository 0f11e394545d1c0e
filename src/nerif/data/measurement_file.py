"""The file of a measurement: NetCDF-4, Conventions BOST-1.0 to 1.3 (docs/formats.md).

Each map of a technique is a variable on view, row, column (and component); the others describe the rig.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from nerif.common.conventions import COMPONENTS, DEFAULT_AMBIENT_FACES, InputError, parse_faces, whole, within
from nerif.common.files import reading
from nerif.common.memory import check_memory
from nerif.common.netcdf import values
from nerif.data.kinds import BOST, known_conventions
from nerif.data.measurement_data import MASKS, MeasurementData
from nerif.forward.deflection import Deflection
from nerif.forward.forward_model import ForwardModel
from nerif.forward.images import Images
from nerif.forward.registry import TECHNIQUES, technique
from nerif.geometry import PERSPECTIVE, Box, Camera, Interface, Lens, Plane, Projection, projection_named
from nerif.geometry.body import Body
from nerif.geometry.region import Region

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "BODIES", "CONVENTIONS", "PLAIN", "bodies_of", "encoding", "from_dataset", "map_names", "to_dataset", "variables",
]  # fmt: skip

PLAIN, CONVENTIONS, WITH_BODIES, WITH_INTERFACES = BOST

PIXELS = ("view", "row", "column")
RIG = {
    "valid": (PIXELS, "1"),
    "flow_mask": (PIXELS, "1"),
    "hidden": (PIXELS, "1"),
    "intrinsics": (("view", "i", "j"), "px"),
    "distortion": (("view", "coefficient"), "1"),
    "tilt": (("view", "axis"), "rad"),
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
    "frame_offset": (("view",), "1"),
    "interface_normal": (("view", "interface", "i"), "1"),
    "interface_offset": (("view", "interface"), "mm"),
    "interface_index": (("view", "interface"), "1"),
    "body_vertices": (("body_vertex", "i"), "mm"),
    "body_faces": (("body_face", "body_corner"), "1"),
    "body_of_face": (("body_face",), "1"),
    "body_rotation": (("body", "i", "j"), "1"),
    "body_translation": (("body", "i"), "mm"),
}
"""Dimensions and units of masks, of the variables of the rig, and of bodies."""
BODIES = tuple(name for name in RIG if name.startswith("body_"))
REQUIRED = ("intrinsics", "rotation", "translation", "box")
BACKGROUND = ("background_normal", "background_offset")
INTERFACE = ("interface_normal", "interface_offset", "interface_index")
SIZES = {"i": 3, "j": 3, "coefficient": 5, "axis": 2, "corner": 2, "side": 2, "parameter": 6, "body_corner": 3}
SPELLINGS = {"px/mm": "px mm-1"}
ROTATION = 1e-4  # of a product of orthonormal columns, from 0 and 1
MAX_PIXELS = 1 << 32  # of all views; a damaged file may claim any number


def variables() -> dict[str, tuple[tuple[str, ...], str]]:
    """Return dimensions and unit of every variable that a file may have."""
    maps: dict[str, tuple[tuple[str, ...], str]] = {}
    for kind in TECHNIQUES.values():
        format_of = (len(kind.channels), kind.unit)
        for name, (channels, unit) in {kind.measured: format_of, kind.sigma: format_of, **kind.beside}.items():
            maps[name] = (PIXELS if channels == 1 else (*PIXELS, _component(channels)), unit)
    return {**maps, **RIG}


def _component(channels: int) -> str:
    """Return the dimension of that number of channels."""
    return "component" if channels == len(COMPONENTS) else f"component_{channels}"


def map_names() -> tuple[str, ...]:
    """Return the names of variables with a value per pixel."""
    return tuple(name for name, (dimensions, _) in variables().items() if dimensions[:3] == PIXELS)


def encoding(dataset: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Return the storage of the maps, in chunks within one view: views are read one by one.

    Maps that vary from pixel to pixel are not compressed: noise takes fifty times as long for a seventh of its bytes.
    """
    packing = {}
    for name, variable in dataset.data_vars.items():
        if variable.dims[:3] == PIXELS:
            _, rows, columns, *rest = variable.shape
            chunks = (1, min(rows, 256), min(columns, 256), *rest)
            compression = {"zlib": True, "complevel": 1, "shuffle": True} if _repeats(variable.values) else {}
            packing[str(name)] = {**compression, "chunksizes": chunks, "_FillValue": None}
    return packing


def _repeats(values: Shaped[np.ndarray, "view row column ..."]) -> bool:
    """Whether most pixels have the value of their neighbour, by every 16th row."""
    rows = values[:, ::16]
    return rows.shape[2] > 1 and bool((rows[:, :, 1:] == rows[:, :, :-1]).mean() > 0.5)


def to_dataset(measurement: MeasurementData) -> xr.Dataset:
    """Return the variables and attributes of the file; maps in single precision are not copied."""
    import xarray as xr

    def stack(values: list[Tensor]) -> np.ndarray:
        return torch.stack(values).numpy()

    cameras, formats = measurement.cameras, variables()
    data: dict[str, np.ndarray] = {
        "intrinsics": stack([c.intrinsics for c in cameras]),
        "distortion": stack([c.distortion for c in cameras]),
        "rotation": stack([c.rotation for c in cameras]),
        "translation": stack([c.translation for c in cameras]),
        "box": np.array([measurement.box.lower, measurement.box.upper]),
        "image_size": np.array([c.image_size for c in cameras], dtype=np.int32),
    }
    if any(c.background is not None for c in cameras):
        none = torch.full((3,), torch.nan, dtype=torch.float64)
        data["background_normal"] = stack([none if c.background is None else c.background.normal for c in cameras])
        data["background_offset"] = np.array([np.nan if c.background is None else c.background.offset for c in cameras])
    lenses = [c.lens for c in cameras if c.lens is not None]
    if any(lens.window > 0 for lens in lenses):
        data["window"] = np.array([lens.window for lens in lenses])
    if any(lens.diameter > 0 for lens in lenses):
        data["aperture_diameter"] = np.array([lens.diameter for lens in lenses])
    if any(lens.focus is not None for lens in lenses):
        data["focus_distance"] = np.array([np.nan if lens.focus is None else lens.focus for lens in lenses])
    if any(bool(c.tilt.any()) for c in cameras):
        data["tilt"] = stack([c.tilt for c in cameras])
    if any(c.pose_sigma is not None for c in cameras):
        none = torch.full((6,), torch.nan, dtype=torch.float64)
        data["pose_sigma"] = stack([none if c.pose_sigma is None else c.pose_sigma for c in cameras])
    frame_offsets = np.array([measurement.frame_offsets.get(name, 0) for name in measurement.names], dtype=np.int32)
    if frame_offsets.any():
        data["frame_offset"] = frame_offsets
    data |= _planes_between(cameras)
    data |= _meshes(measurement.bodies)
    for name, value in {**measurement.all_maps, **{name: getattr(measurement, name) for name in MASKS}}.items():
        if value is not None:
            data[name] = (value.view(torch.int8) if value.dtype == torch.bool else value.float()).numpy()
    dataset = xr.Dataset({k: (formats[k][0], v, {"units": formats[k][1]}) for k, v in data.items()})
    scales = {c.projection.unit for c in cameras}
    if len(scales) == 1:
        dataset["intrinsics"].attrs["units"] = _spelling(scales.pop())
    dataset = dataset.assign_coords(view=list(measurement.names))
    if measurement.displacement is not None:
        dataset = dataset.assign_coords(component=list(COMPONENTS))
    names = [kind.name for kind in measurement.techniques]
    pinholes = all(c.projection == PERSPECTIVE for c in cameras)
    more = data.keys() & {"pose_sigma", "tilt", "frame_offset"}
    plain = names == [Deflection.name] and pinholes and not lenses and not more
    with_bodies = bool(data.keys() & {"hidden", "body_vertices"})
    with_bodies |= measurement.ambient_region is not None
    plain &= not with_bodies
    version = WITH_BODIES if with_bodies else CONVENTIONS
    if INTERFACE[0] in data:
        plain, version = False, WITH_INTERFACES
    dataset.attrs = {
        "Conventions": PLAIN if plain else version,
        **({} if plain else {"technique": " ".join(names)}),
        "n_ambient": measurement.n_ambient,
        "ambient_faces": " ".join(measurement.ambient_faces),
    }
    if measurement.ambient_region is not None:
        dataset.attrs["ambient_region"] = " ".join(["box", *(repr(float(x)) for x in measurement.ambient_region)])
    if measurement.bodies:
        dataset["body_name"] = (("body",), np.array([body.name for body in measurement.bodies], dtype=object))
    if not pinholes:
        dataset["projection"] = (("view",), np.array([c.projection.name for c in cameras], dtype=object))
    if measurement.wavelength_nm is not None:
        dataset.attrs["wavelength_nm"] = measurement.wavelength_nm
    return dataset


def from_dataset(dataset: xr.Dataset) -> dict[str, Any]:
    """Return the arguments of a Measurement, or raise an InputError that names the variable; maps are read by view."""
    conventions = dataset.attrs.get("Conventions")
    if not known_conventions(conventions):
        raise InputError(
            f"expected {' or '.join(map(repr, BOST))}, got '{conventions}'; is it a measurement?",
            field="attribute Conventions",
        )
    _check_variables(dataset)
    faces, region = dataset.attrs.get("ambient_faces", " ".join(DEFAULT_AMBIENT_FACES)), None
    stated = str(dataset.attrs.get("ambient_region", ""))
    if stated.startswith("box"):
        region = _region(stated)
    elif stated:
        faces = stated
    if not isinstance(faces, str):
        raise InputError(f"expected a text such as 'x- x+ y- y+', got {faces!r}", field="attribute ambient_faces")
    arguments = ("displacement", "sigma", *MASKS)
    maps = {name: _map(dataset, name) for name in map_names() if name in dataset and name not in arguments}
    if Images.measured in maps:
        maps = Images.complete(maps, dataset.attrs)
    index = any(kind.quantity == Deflection.quantity for kind in _techniques(dataset))
    lower, upper = _array(dataset, "box").tolist()
    return {
        "cameras": _cameras(dataset),
        "box": Box(tuple(lower), tuple(upper)),
        "displacement": None,
        **{name: _map(dataset, name) for name in arguments if name in dataset},
        "maps": maps,
        "n_ambient": _number(dataset, "n_ambient", "the ambient index, e.g. 1.00027", None if index else 1.0),
        "wavelength_nm": _number(dataset, "wavelength_nm", "nm") if "wavelength_nm" in dataset.attrs else None,
        "ambient_faces": parse_faces(faces, "attribute ambient_faces"),
        "ambient_region": region,
        "frame_offsets": _frame_offsets(dataset),
        "bodies": _bodies(dataset),
    }


def _region(text: str) -> Region:
    """Return the region of a text 'box x0 x1 y0 y1 z0 z1', mm."""
    try:
        x0, x1, y0, y1, z0, z1 = (float(number) for number in text.split()[1:])
    except ValueError:
        raise InputError(
            f"expected a text such as 'box -5 5 -5 5 -20 -15' (mm), got {text!r}", field="attribute ambient_region"
        ) from None
    return (x0, x1, y0, y1, z0, z1)


def _planes_between(cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
    """Return the variables of interfaces, NaN where a view has fewer than others; none without interfaces."""
    most = max(len(c.interfaces) for c in cameras)
    if not most:
        return {}
    table = np.full((len(cameras), most, 5), np.nan)
    for i, camera in enumerate(cameras):
        for j, plane in enumerate(camera.interfaces):
            table[i, j] = [*plane.normal.tolist(), plane.offset, plane.index]
    return dict(zip(INTERFACE, (table[..., :3], table[..., 3], table[..., 4]), strict=True))


def _interfaces(dataset: xr.Dataset, names: list[str]) -> list[tuple[Interface, ...]]:
    """Return the interfaces of all views."""
    present = [name for name in INTERFACE if name in dataset]
    if not present:
        return [()] * len(names)
    if len(present) < len(INTERFACE):
        missing = next(name for name in INTERFACE if name not in present)
        raise InputError(f"expected beside {present[0]}, got none", field=f"variable '{missing}'")
    normals, offsets, indices = (_array(dataset, name, gaps=True) for name in INTERFACE)
    planes = []
    for name, *table in zip(names, normals, offsets.tolist(), indices.tolist(), strict=True):
        with within(f"view '{name}'"):
            rows = [row for row in zip(*table, strict=True) if not math.isnan(row[2])]
            planes.append(tuple(Interface(*row) for row in rows))
    return planes


def _meshes(bodies: tuple[Body, ...]) -> dict[str, np.ndarray]:
    """Return the variables of bodies, their meshes one after the other; none without bodies."""
    if not bodies:
        return {}
    firsts = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    faces = [body.faces.numpy() + first for body, first in zip(bodies, firsts[:-1], strict=True)]
    return {
        "body_vertices": np.concatenate([body.vertices.numpy() for body in bodies]),
        "body_faces": np.concatenate(faces).astype(np.int32),
        "body_of_face": np.repeat(np.arange(len(bodies), dtype=np.int32), [len(f) for f in faces]),
    }


def _bodies(dataset: xr.Dataset) -> tuple[Body, ...]:
    """Return the bodies of the variables of a file."""
    if "body_vertices" not in dataset or "body_faces" not in dataset:
        return ()
    arrays = {name: _array(dataset, name).numpy() for name in BODIES if name in dataset}
    return bodies_of(arrays, _texts(dataset["body_name"]) if "body_name" in dataset else [])


def bodies_of(arrays: Mapping[str, np.ndarray], names: Sequence[str] = ()) -> tuple[Body, ...]:
    """Return the bodies of the arrays of a file by their names (BODIES), at their poses."""
    vertices, faces = torch.from_numpy(arrays["body_vertices"]), torch.from_numpy(arrays["body_faces"]).long()
    number = torch.from_numpy(arrays.get("body_of_face", np.zeros(len(faces)))).long()
    if not (len(number) == len(faces) and int(number.min()) >= 0 and int(number.max()) < len(faces)):
        raise InputError("expected the number of a body for each triangle, got others", field="variable 'body_of_face'")
    count = int(number.max()) + 1
    rotations = torch.from_numpy(arrays.get("body_rotation", np.tile(np.eye(3), (count, 1, 1))))
    translations = torch.from_numpy(arrays.get("body_translation", np.zeros((count, 3))))
    if len(rotations) != count or len(translations) != count:
        raise InputError(f"expected a pose for each of {count} bodies", field="variable 'body_rotation'")
    product = rotations @ rotations.mT - torch.eye(3, dtype=rotations.dtype)
    if not (float(product.abs().max()) < ROTATION and bool((torch.linalg.det(rotations) > 0).all())):
        raise InputError("expected rotation matrices, got others", field="variable 'body_rotation'")
    bodies = []
    for i in range(count):
        used, index = faces[number == i].unique(return_inverse=True)
        name = names[i] if i < len(names) else f"body {i}"
        if not len(used) or int(used.min()) < 0 or int(used.max()) >= len(vertices):
            raise InputError(
                f"expected for {name} triangles of vertices 0 to {len(vertices) - 1}, got others",
                field="variable 'body_faces'",
            )
        body = Body(vertices[used], index, name)
        if "body_rotation" in arrays or "body_translation" in arrays:
            body = body.moved(rotations[i], translations[i])
        bodies.append(body)
    return tuple(bodies)


def _frame_offsets(dataset: xr.Dataset) -> dict[str, int]:
    """Return the frame offsets by the names of views."""
    names = _names(dataset)
    offsets = _optional(dataset, "frame_offset", (len(names),), 0.0).tolist()
    return {name: int(offset) for name, offset in zip(names, offsets, strict=True) if offset}


def _techniques(dataset: xr.Dataset) -> tuple[type[ForwardModel], ...]:
    """Return the techniques named by the attribute, else those whose variables are present."""
    names = dataset.attrs.get("technique", "")
    if not isinstance(names, str):
        raise InputError(f"expected one of {', '.join(TECHNIQUES)}, got {names!r}", field="attribute technique")
    kinds = tuple(technique(name) for name in names.replace(",", " ").split())
    return kinds or tuple(k for k in TECHNIQUES.values() if k.measured in dataset) or (Deflection,)


def _check_variables(dataset: xr.Dataset) -> None:
    """Check presence, dimensions, sizes and units of all variables."""
    kinds = _techniques(dataset)
    required = {
        *(kind.measured for kind in kinds),
        *REQUIRED,
        *(BACKGROUND if any(k.background for k in kinds) else ()),
    }
    sizes = SIZES | {_component(n): n for n in (len(kind.channels) for kind in TECHNIQUES.values()) if n > 1}
    for name, (dimensions, unit) in variables().items():
        field = f"variable '{name}'"
        if name not in dataset:
            if name in required:
                raise InputError(f"expected on ({', '.join(dimensions)}) in {unit}, got none", field=field)
            continue
        variable = dataset[name]
        if sorted(map(str, variable.dims)) != sorted(dimensions):
            raise InputError(f"expected dimensions {dimensions}, got {tuple(map(str, variable.dims))}", field=field)
        for dimension in dimensions:
            size, actual = sizes.get(dimension), variable.sizes[dimension]
            if actual == 0 or (size is not None and actual != size):
                raise InputError(f"expected {size or 'at least 1'} along {dimension}, got {actual}", field=field)
        actual_unit, units = variable.attrs.get("units", unit), [unit]
        if name == "intrinsics":
            units = list(dict.fromkeys([unit, *(_spelling(p.unit) for p in _projections(dataset))]))
        words = " ".join(actual_unit.replace(",", " ").split()) if isinstance(actual_unit, str) else ""
        if _spelling(words) not in units:
            raise InputError(f"expected units '{' or '.join(units)}', got '{actual_unit}'", field=field)
    views, rows, columns = (dataset.sizes[name] for name in PIXELS)
    if views * rows * columns > MAX_PIXELS:
        raise InputError(
            f"expected views of several megapixels, got {views} x {rows} x {columns}",
            field=f"variable '{kinds[0].measured}'",
        )


def _array(dataset: xr.Dataset, name: str, gaps: bool = False) -> Tensor:
    """Return a small variable in double precision, in the order of its dimensions; NaN only with `gaps`."""
    numbers = values(dataset[name].transpose(*variables()[name][0])).astype(np.float64)
    if not gaps and not np.isfinite(numbers).all():
        bad = numbers[~np.isfinite(numbers)][0]
        raise InputError(f"expected finite numbers, got {bad}", field=f"variable '{name}'")
    return torch.from_numpy(np.ascontiguousarray(numbers))


def _optional(dataset: xr.Dataset, name: str, shape: tuple[int, ...], default: float = math.nan) -> Tensor:
    """Return a variable, or an array of the default; a variable whose default is NaN may have gaps."""
    if name in dataset:
        return _array(dataset, name, math.isnan(default))
    return torch.full(shape, default, dtype=torch.float64)


def _map(dataset: xr.Dataset, name: str) -> Tensor:
    """Return a map in single precision, or a mask as booleans."""
    variable, dimensions = dataset[name], variables()[name][0]
    is_mask = name in MASKS
    shape = [variable.sizes[d] for d in dimensions]
    check_memory(math.prod(shape) * (1 if is_mask else 4), None, f"variable '{name}'")
    result = torch.empty(shape, dtype=torch.bool if is_mask else torch.float32)
    for i in range(shape[0]):
        numbers = values(variable.isel(view=i).transpose(*dimensions[1:]))
        if not is_mask:
            with np.errstate(over="ignore"):  # a number beyond single precision is no displacement either
                numbers = numbers.astype(np.float32, copy=False)
        elif numbers.dtype.kind == "f" and np.isnan(numbers).any():
            raise InputError("expected 0 or 1, got NaN", field=f"variable '{name}'")
        else:
            numbers = numbers != 0
        result[i] = torch.from_numpy(np.ascontiguousarray(numbers))
    return result


def _spelling(unit: str) -> str:
    return SPELLINGS.get(unit, unit)


def _texts(variable: xr.DataArray) -> list[str]:
    """Return texts of variable or fixed length, in characters or bytes, padded or not."""
    with reading(f"variable '{variable.name}': cannot be read; is the file damaged?"):
        texts = variable.values.ravel()
    return [(v.decode(errors="replace") if isinstance(v, bytes) else str(v)).strip(" \0") for v in texts]


def _names(dataset: xr.Dataset) -> list[str]:
    return _texts(dataset["view"]) if "view" in dataset.coords else [str(i) for i in range(dataset.sizes["view"])]


def _projections(dataset: xr.Dataset) -> list[Projection]:
    names = _names(dataset)
    if "projection" not in dataset:
        return [PERSPECTIVE] * len(names)
    variable = dataset["projection"]
    if variable.dims != ("view",):
        raise InputError(f"expected one name per view, got dimensions {variable.dims}", field="variable 'projection'")
    return [projection_named(p, f"projection of view '{n}'") for n, p in zip(names, _texts(variable), strict=True)]


def _cameras(dataset: xr.Dataset) -> tuple[Camera, ...]:
    views, names, projections = dataset.sizes["view"], _names(dataset), _projections(dataset)
    full = torch.tensor([dataset.sizes["row"], dataset.sizes["column"]], dtype=torch.float64).expand(views, 2)
    sizes = _array(dataset, "image_size") if "image_size" in dataset else full
    distortion, tilt = (_optional(dataset, n, (views, k), 0.0) for n, k in (("distortion", 5), ("tilt", 2)))
    intrinsics, rotation, translation = (_array(dataset, n) for n in ("intrinsics", "rotation", "translation"))
    normals = _optional(dataset, "background_normal", (views, 3))
    offsets = _optional(dataset, "background_offset", (views,))
    pose_sigma = _optional(dataset, "pose_sigma", (views, 6))
    lenses, interfaces = _lenses(dataset, names), _interfaces(dataset, names)
    cameras = []
    for i, name in enumerate(names):
        height, width = (whole(edge, f"image_size of view '{name}'") for edge in sizes[i].tolist())
        cameras.append(
            Camera(
                intrinsics=intrinsics[i],
                rotation=rotation[i],
                translation=translation[i],
                image_size=(height, width),
                background=_plane(normals[i], offsets[i], name),
                distortion=distortion[i],
                name=name,
                projection=projections[i],
                lens=lenses[i],
                pose_sigma=None if bool(pose_sigma[i].isnan().all()) else pose_sigma[i],
                tilt=tilt[i],
                interfaces=interfaces[i],
            )
        )
    return tuple(cameras)


def _lenses(dataset: xr.Dataset, names: list[str]) -> list[Lens | None]:
    """Return the lenses of all views; none if no view has an aperture or a window."""
    views = (len(names),)
    columns = [_optional(dataset, n, views, x).tolist() for n, x in (("aperture_diameter", 0.0), ("window", 0.0))]
    columns.append(_optional(dataset, "focus_distance", views).tolist())
    lenses: list[Lens] = []
    for name, diameter, window, focus in zip(names, *columns, strict=True):
        with within(f"view '{name}'"):
            lenses.append(Lens(diameter, None if math.isnan(focus) else focus, window=window))
    return [*lenses] if any(lens.wide for lens in lenses) else [None] * len(names)


def _plane(normal: Tensor, offset: Tensor, view: str) -> Plane | None:
    """Return the background of a view, None if its normal is NaN."""
    if bool(normal.isnan().all()):
        return None
    length = float(normal.norm())
    if not 0.99 < length < 1.01:
        raise InputError(f"expected a unit vector, got length {length:g}", field=f"background_normal of view '{view}'")
    if not bool(offset.isfinite()):
        raise InputError(
            f"expected a finite number in mm, got {float(offset)}; give it, or remove background_normal of a view "
            "without a background",
            field=f"background_offset of view '{view}'",
        )
    return Plane(normal / length, float(offset) / length)


def _number(dataset: xr.Dataset, name: str, what: str, default: float | None = None) -> float:
    value = dataset.attrs.get(name, default)
    if not isinstance(value, int | float | np.number):
        raise InputError(f"expected a number ({what}), got {value!r}", field=f"attribute {name}")
    return float(value)
