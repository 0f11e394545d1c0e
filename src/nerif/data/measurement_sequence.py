"""Measurements over time: a Zarr store of the variables of a measurement, with a leading dimension `time`.

Each frame has chunks of its own, so that several processes can read and write frames.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch
from torch import Tensor

from nerif.common.conventions import InputError, within
from nerif.common.files import atomic, read_json, reading
from nerif.common.installation import optional
from nerif.common.memory import check_memory
from nerif.common.times import check_interval, interval, seconds
from nerif.data.kinds import SEQUENCE, known_conventions, reading_as
from nerif.data.measurement import Measurement
from nerif.data.measurement_file import BODIES, CONVENTIONS, PLAIN, from_dataset, map_names, variables
from nerif.forward.registry import TECHNIQUES
from nerif.geometry import Camera, Lens
from nerif.geometry.interfaces import MAX_INTERFACES

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    import zarr
    from torch import Tensor

__all__ = ["ZARR_FORMAT", "MeasurementSequence", "add_frames", "check_instants", "check_store", "require_store"]

ZARR_FORMAT: Final = 3
"""Format of every store. Format 2 has filters that unpickle what they read: a foreign store could run code."""
WRITTEN = "written"
"""Variable (time,) that is 1 where a frame is complete; stores of other programs may lack it."""
MEASUREMENTS = ("a measurement over time", WRITTEN)
BYTES_OF_TIME = 64  # of an instant in a tuple
MAX_FRAMES_SEARCHED = 20  # for one with all views
ROUNDING = 1e-9  # relative to the largest of the numbers compared


def require_store(path: Path, expected: str) -> None:
    """Raise an InputError if zarr is not installed, or a path is no Zarr store."""
    optional("zarr", "sequence", "sequences", "")
    if not (path / "zarr.json").is_file():
        what = "no zarr.json in it" if path.is_dir() else "no such store"
        raise InputError(f"{what}; expected {expected}", field=path)


def check_store(path: Path, kind: tuple[str, str]) -> None:
    """Check that a path to replace is free or a store of the same kind without foreign files.

    `kind` is the content of the store, and the name of an attribute or array that marks it.
    """
    if not os.path.lexists(path):
        return
    content, mark = kind
    try:
        metadata = read_json(path / "zarr.json")
        same_kind = mark in metadata["attributes"] or (path / mark / "zarr.json").is_file()
    except (OSError, ValueError, KeyError, TypeError):
        same_kind = False
    if not same_kind:
        raise InputError(f"exists already, is not {content}, and was left as it is; give another --out", field=path)
    parts = {"zarr.json", *(array.parent.name for array in path.glob("*/zarr.json"))}
    if foreign := sorted({entry.name for entry in path.iterdir()} - parts):
        raise InputError(
            f"not overwritten, since {', '.join(foreign)} in it is not part of the store; move it elsewhere", field=path
        )


def add_frames(
    group: zarr.Group, name: str, frames: int, sizes: tuple[int, ...], dimensions: tuple[str, ...],
    kind: str | np.dtype, fill: float | str = float("nan"), **attributes: Any,
) -> None:  # fmt: skip
    """Add an array with a leading dimension time and one chunk per frame."""
    group.create_array(
        name, shape=(frames, *sizes), chunks=(1, *sizes), dtype=kind, fill_value=fill,
        dimension_names=["time", *dimensions], attributes=attributes,
    )  # fmt: skip


@dataclass(frozen=True)
class MeasurementSequence:
    """A measurement for every instant, on disk."""

    path: Path  #: of the Zarr store
    times: tuple[float, ...]  #: of the frames, s, increasing

    def __len__(self) -> int:
        return len(self.times)

    # -- reading -------------------------------------------------------------------------------------------------

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> MeasurementSequence:
        """Open a store; frames are read on demand."""
        with reading_as(path, SEQUENCE):
            return cls._read(Path(path))

    @classmethod
    def _read(cls, path: Path) -> MeasurementSequence:
        import numpy as np

        _check_arrays(path)
        with _opened(path) as dataset:
            conventions = dataset.attrs.get("Conventions")
            if not known_conventions(conventions):
                raise InputError(
                    f"attribute Conventions: expected '{PLAIN}' or '{CONVENTIONS}', got '{conventions}'", field=path
                )
            for name in _technique_maps(dataset) or ("displacement",):
                dimensions = dataset[name].dims if name in dataset else "none"
                if dimensions[:1] != ("time",):
                    raise InputError(
                        f"variable '{name}': expected a leading dimension time, got {dimensions}", field=path
                    )
            count = dataset.sizes["time"]
            check_memory(BYTES_OF_TIME * count, path, path)
            time = dataset.coords.get("time")
            units = None if time is None else time.attrs.get("units")
            times = tuple(map(float, seconds(np.arange(count) if time is None else time.values, units, path)))
            check_instants(times, path)
            check_interval(times, dataset.attrs, path)
        return cls(path, times)

    def frame(self, index: int) -> Measurement:
        """Return the measurement of one instant, without the views that have no data then (if others have)."""
        import numpy as np

        place = f"{self.path}, frame {index}"
        with _opened(self.path) as dataset, reading(f"{place}: cannot be read; is it damaged?"):
            if WRITTEN in dataset and not bool(dataset[WRITTEN][index]):
                raise InputError("no data, or not written completely", field=place)
            one = dataset.isel(time=index) if "time" in dataset.dims else dataset
            check_memory(one.nbytes, self.path, place)
            one = one.load()
        with within(place):
            dimensions = variables()
            maps = [one[name] for name in _technique_maps(one) if one[name].dims == dimensions[name][0]]
            if maps:
                with_data = np.any([m.notnull().all(m.dims[3:]).any(("row", "column")).values for m in maps], axis=0)
                one = one.isel(view=with_data) if with_data.any() else one
            return Measurement.from_dataset(one.drop_vars(["time", WRITTEN], errors="ignore"))

    def body_arrays(self) -> dict[str, xr.DataArray]:
        """Return the meshes of the bodies in the flow and their poses, by the names in the file."""
        with _opened(self.path) as dataset:
            return {name: dataset[name].load() for name in BODIES if name in dataset}

    def fullest(self) -> Measurement:
        """Return the first frame with all views and techniques of the store; its cameras and box are those of all.

        If none of the first MAX_FRAMES_SEARCHED valid frames is complete, the one with the most views.
        """
        with _opened(self.path) as dataset:
            complete = (dataset.sizes["view"], len(_technique_maps(dataset)))
        first_error, best, best_size = None, None, (0, 0)
        for index in range(len(self)):
            if best is not None and (best_size == complete or index >= MAX_FRAMES_SEARCHED):
                break
            try:
                frame = self.frame(index)
            except InputError as error:
                first_error = first_error or error
                continue
            if (size := (len(frame.names), len(frame.techniques))) > best_size:
                best, best_size = frame, size
        if best is None:
            raise InputError(f"no valid frame; the first: {first_error}")
        return best

    @classmethod
    def resumed(cls, path: Path, name: str, settings: dict[str, Any]) -> MeasurementSequence:
        """Open a store to continue it; refuse one that was begun with other settings, in its attribute `name`."""
        import zarr

        sequence = cls.read(path)
        if zarr.open_group(path, mode="r").attrs.get(name) != settings:
            raise InputError("exists already with other settings; give another --out, or --force", field=path)
        return sequence

    def check_cameras(self, cameras: Sequence[Camera]) -> None:
        """Refuse to continue the store with other cameras."""
        with _opened(self.path) as dataset:
            stored = {c.name: c for c in from_dataset(dataset.isel(time=0, row=slice(1), column=slice(1)))["cameras"]}
        differences = [f"views ({', '.join(stored)})"] if set(stored) != {camera.name for camera in cameras} else []
        for camera in cameras if not differences else ():
            reference = _camera_numbers(stored[camera.name])
            for what, value in _camera_numbers(camera).items():
                tolerance = ROUNDING * float(value.nan_to_num().abs().max())
                if not torch.allclose(value, reference[what], rtol=0, atol=tolerance, equal_nan=True):
                    differences.append(f"{what} of view '{camera.name}'")
        if differences:
            raise InputError(
                f"expected the cameras of the existing store, got other {differences[0]}; after a new calibration "
                "give another --out, or --force",
                field=self.path,
            )

    def record(self, name: str, settings: dict[str, Any]) -> None:
        """Store the settings with which the frames are made, for `resumed`."""
        import zarr

        zarr.open_group(self.path, mode="r+").attrs[name] = settings

    # -- writing -------------------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls, path: str | os.PathLike[str], times: Sequence[float], like: Measurement, force: bool = False,
        moving: bool = False,
    ) -> MeasurementSequence:  # fmt: skip
        """Make a store for frames with the cameras, box and optional variables of `like`, without data yet.

        With `moving`, its bodies have a pose in each frame.
        """
        import numpy as np
        import zarr

        path = Path(path)
        check_instants(times, "times")
        if path.exists() and not force:
            raise InputError("exists already and was left as it is; give another --out, or --force", field=path)
        check_store(path, MEASUREMENTS)
        dataset = like.to_dataset()
        maps = [name for name in map_names() if name in dataset]
        fixed = dataset.drop_vars(maps)
        # format 3 has no type for texts of fixed length
        names = {k: (k, fixed[k].values.astype(object)) for k in ("view", "component") if k in fixed.coords}
        time = ("time", np.asarray(times, dtype=np.float64), {"units": "s", "axis": "T"})
        fixed = fixed.assign_coords(names).assign_coords(time=time).assign_attrs(interval(times))
        with atomic(path) as part:
            fixed.to_zarr(part, mode="w", consolidated=False, zarr_format=ZARR_FORMAT)
            group = zarr.open_group(part, mode="r+")
            for name in maps:
                v = dataset[name]
                fill = np.nan if v.dtype.kind == "f" else 0
                add_frames(group, name, len(times), v.shape, tuple(map(str, v.dims)), v.dtype, fill, **v.attrs)
            for name in ("body_rotation", "body_translation") if moving else ():
                dimensions, unit = variables()[name]
                sizes = (len(like.bodies), *(3 for _ in dimensions[1:]))
                add_frames(group, name, len(times), sizes, dimensions, "float64", units=unit)
            meaning = "written last: the frame is complete"
            add_frames(group, WRITTEN, len(times), (), (), "int8", 0, long_name=meaning)
        return cls(path, tuple(float(t) for t in times))

    def write_frame(
        self, index: int, measurement: Measurement, poses: Sequence[tuple[Tensor, Tensor]] | None = None
    ) -> None:
        """Write one frame, `written` last; views that the measurement lacks have no data then.

        Poses are rotation and translation (mm) of each moving body.
        """
        import numpy as np
        import zarr

        group: Any = zarr.open_group(self.path, mode="r+")
        dataset, place = measurement.to_dataset(), f"{self.path}, frame {index}"
        names = [str(name) for name in group["view"][:]]
        for name in measurement.names:
            if name not in names:
                raise InputError(f"expected views out of {', '.join(names)}, got '{name}'", field=place)
        for name in map_names():
            if (name in dataset) != (name in group):
                has = "with" if name in group else "without"
                raise InputError(f"expected a measurement {has} '{name}' as the other frames", field=place)
        views = [names.index(name) for name in measurement.names]
        if WRITTEN in group:
            group[WRITTEN][index] = 0
        for name in (name for name in reversed(map_names()) if name in dataset):
            array = dataset[name].values
            whole = np.full(group[name].shape[1:], group[name].fill_value, dtype=array.dtype)
            whole[views, : array.shape[1], : array.shape[2]] = array
            group[name][index] = whole
        if poses is not None:
            for name, values_of in zip(("body_rotation", "body_translation"), zip(*poses, strict=True), strict=True):
                group[name][index] = np.stack([value.numpy() for value in values_of])
        if WRITTEN in group:
            group[WRITTEN][index] = 1

    def is_written(self, index: int) -> bool:
        """Return whether a frame is complete."""
        import zarr

        group: Any = zarr.open_group(self.path, mode="r")
        if WRITTEN in group:
            return bool(group[WRITTEN][index])
        first = next(kind.measured for kind in TECHNIQUES.values() if kind.measured in group)
        return any(p.is_file() for p in (self.path / first / "c" / str(index)).rglob("*"))


def _technique_maps(dataset: xr.Dataset) -> tuple[str, ...]:
    return tuple(kind.measured for kind in TECHNIQUES.values() if kind.measured in dataset)


def _check_arrays(path: Path) -> None:
    """Open the arrays one by one: of several opened at once, zarr prints the errors of all but the first."""
    require_store(path, f"a measurement sequence (Zarr, {CONVENTIONS})")
    import zarr

    for metadata in sorted(path.glob("*/zarr.json")):
        with reading(f"{path}: not a readable Zarr store: {metadata.parent.name}"):
            array = zarr.open(metadata.parent, mode="r")
        if getattr(array, "ndim", 0) == 1:  # coordinates, which xarray reads at once
            check_memory(getattr(array, "nbytes", 0), path, f"{path}: {metadata.parent.name}")


def _opened(path: Path) -> xr.Dataset:
    """Return the store as a dataset that reads on demand."""
    import xarray as xr

    require_store(path, f"a measurement sequence (Zarr, {CONVENTIONS})")
    with reading(f"{path}: not a readable Zarr store"):
        return xr.open_dataset(
            path, engine="zarr", chunks=None, consolidated=False, decode_times=False, zarr_format=ZARR_FORMAT
        )


def check_instants(times: Sequence[float], field: str | Path) -> None:
    """Raise InputError unless there are instants, finite and each later than the one before."""
    if len(times) and all(b > a for a, b in pairwise(times)) and math.isfinite(sum(times)):
        return
    first = next((k for k, (a, b) in enumerate(pairwise(times)) if not b > a), 0)
    short = ", ".join(map(repr, map(float, times[first : first + 4]))) or "none"
    raise InputError(f"coordinate time: expected increasing instants in s, got {short} from frame {first}", field=field)


def _camera_numbers(camera: Camera) -> dict[str, Tensor]:
    """Everything about a camera that a measurement stores."""
    lens = camera.lens if camera.lens is not None and camera.lens.wide else Lens()
    sigma = torch.full((6,), torch.nan) if camera.pose_sigma is None else camera.pose_sigma
    planes = [x for plane in camera.interfaces for x in (*plane.normal.tolist(), plane.offset, plane.index)]
    groups: dict[str, Any] = {
        "image size": camera.image_size,
        "projection": [camera.projection.shows_depth],
        "intrinsics": camera.intrinsics,
        "rotation": camera.rotation,
        "translation": camera.translation,
        "distortion": camera.distortion,
        "tilt": camera.tilt,
        "background": [*camera.plane.normal.tolist(), camera.plane.offset],
        "lens": [lens.diameter, torch.nan if lens.focus is None else lens.focus],
        "interfaces": planes + [torch.nan] * (5 * MAX_INTERFACES - len(planes)),
        "pose_sigma": sigma,
    }
    return {what: torch.as_tensor(value, dtype=torch.float64) for what, value in groups.items()}
