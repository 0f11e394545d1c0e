"""Measurements over time: a Zarr store of the measurement's variables, with a leading dimension `time`.

Each frame has chunks of its own, so frames are written and read one by one, by as many processes as there are.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from nerif.common.conventions import InputError
from nerif.common.files import atomic
from nerif.common.installation import install
from nerif.common.netcdf import reading, values
from nerif.data.measurement import Measurement
from nerif.data.measurement_file import CONVENTIONS, PLAIN, known_conventions, map_names, variables
from nerif.forward.registry import TECHNIQUES

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    import zarr

__all__ = ["ZARR_FORMAT", "MeasurementSequence", "add_frames", "check_store", "require_zarr"]

ZARR_FORMAT: Final = 3
"""Of every store. The second one has filters that unpickle what they read: a store of somebody else could run code."""
WRITTEN = "written"
"""Variable (time,) that is 1 where a frame is complete; stores of other programs may lack it."""


LOOKS = 20
"""Frames that are looked at for one with every view."""


def require_zarr() -> None:
    """Raise InputError, with the remedy, where zarr is not installed."""
    try:
        import zarr  # noqa: F401
    except ImportError:
        raise InputError(f"zarr is not installed; {install('sequence')}", field="sequences") from None


MEASURED = ("a measurement over time", WRITTEN)


def check_store(path: Path, kind: tuple[str, str]) -> None:
    """Refuse to replace anything but a store of the same kind, with nothing in it that is no part of the store.

    Parameters
    ----------
    path : of what is to be replaced, which need not be there
    kind : what the store holds; the name of an attribute, or of an array, that tells it from others
    """
    if not os.path.lexists(path):
        return
    what, mark = kind
    other = InputError(f"exists already, is not {what}, and was left as it is; give another --out", field=path)
    try:
        about = json.loads((path / "zarr.json").read_text())
        known = mark in about["attributes"] or (path / mark / "zarr.json").is_file()
    except (OSError, ValueError, KeyError, TypeError):
        raise other from None
    if not known:
        raise other
    parts = {"zarr.json", *(found.parent.name for found in path.glob("*/zarr.json"))}
    strange = sorted({found.name for found in path.iterdir()} - parts)
    if strange:
        raise InputError(
            f"not overwritten, since {', '.join(strange)} in it is no part of the store; move it elsewhere", field=path
        )


def add_frames(
    group: zarr.Group,
    name: str,
    frames: int,
    sizes: tuple[int, ...],
    dimensions: tuple[str, ...],
    kind: str | np.dtype,
    fill: float | str = float("nan"),
    **about: Any,
) -> None:
    """Add an array with a leading dimension time and a chunk for each frame."""
    group.create_array(
        name, shape=(frames, *sizes), chunks=(1, *sizes), dtype=kind, fill_value=fill,
        dimension_names=["time", *dimensions], attributes=about,
    )  # fmt: skip


@dataclass(frozen=True)
class MeasurementSequence:
    """A measurement for every instant, on disc.

    Parameters
    ----------
    path : of the Zarr store
    times : of the frames, s, increasing
    """

    path: Path
    times: tuple[float, ...]

    def __len__(self) -> int:
        return len(self.times)

    # -- reading -------------------------------------------------------------------------------------------------

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> MeasurementSequence:
        """Open a store; frames are read when they are asked for.

        Raises
        ------
        InputError
            If it is missing, foreign, or has no `time`.
        """
        path = Path(path)
        _check_arrays(path)
        with _opened(path) as dataset:
            found = dataset.attrs.get("Conventions")
            if not known_conventions(found):
                raise InputError(
                    f"attribute Conventions: expected '{PLAIN}' or '{CONVENTIONS}', got '{found}'", field=path
                )
            names = _measured(dataset) or ("displacement",)
            for name in names:
                got = dataset[name].dims if name in dataset else "none"
                if got[:1] != ("time",):
                    raise InputError(f"variable '{name}': expected a leading dimension time, got {got}", field=path)
            count = dataset.sizes["time"]
            given = values(dataset["time"]).tolist() if "time" in dataset.coords else range(count)
        times = tuple(float(t) for t in given)
        if not times or not math.isfinite(sum(times)) or any(not b > a for a, b in pairwise(times)):
            raise InputError(f"coordinate time: expected increasing instants in s, got {_short(times)}", field=path)
        return cls(path, times)

    def frame(self, index: int) -> Measurement:
        """Return the measurement of one instant, without the views that measured nothing then (if others did).

        Raises
        ------
        InputError
            If the frame breaks the contract of a measurement, such as a view with no valid pixel.
        """
        import numpy as np

        with _opened(self.path) as dataset, reading(f"{self.path}, frame {index}: cannot be read; is it damaged?"):
            if WRITTEN in dataset and not bool(dataset[WRITTEN][index]):
                raise InputError("nothing was measured then, or not to its end", field=f"{self.path}, frame {index}")
            one = dataset.isel(time=index).load() if "time" in dataset.dims else dataset.load()
        try:
            known = variables()
            maps = [one[name] for name in _measured(one) if one[name].dims == known[name][0]]
            if maps:
                seeing = np.any([m.notnull().all(m.dims[3:]).any(("row", "column")).values for m in maps], axis=0)
                one = one.isel(view=seeing) if seeing.any() else one
            return Measurement.from_dataset(one.drop_vars(["time", WRITTEN], errors="ignore"))
        except InputError as error:
            raise error.inside(f"{self.path}, frame {index}") from None

    def fullest(self) -> Measurement:
        """Return the first frame with all the views and techniques of the store: its cameras and box are those of all.

        Where none of the first LOOKS frames has them all, the one with the most, and where none can be used, the first
        that can.

        Raises
        ------
        InputError
            If there is none, with what is wrong with the first.
        """
        with _opened(self.path) as dataset:
            most = (dataset.sizes["view"], len(_measured(dataset)))
        wrong, best, has = None, None, (0, 0)
        for index in range(len(self)):
            if best is not None and (has == most or index >= LOOKS):
                break
            try:
                frame = self.frame(index)
            except InputError as error:
                wrong = wrong or error
                continue
            if (own := (len(frame.names), len(frame.techniques))) > has:
                best, has = frame, own
        if best is None:
            raise InputError(f"no frame can be used; the first: {wrong}")
        return best

    # -- writing -------------------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls, path: str | os.PathLike[str], times: Sequence[float], like: Measurement, force: bool = False
    ) -> MeasurementSequence:
        """Make a store for frames of the cameras, box and optional variables of `like`, with nothing measured yet.

        Raises
        ------
        InputError
            If the store exists, unless forced, or the times do not increase; if anything else is there, always.
        """
        import numpy as np
        import zarr

        path = Path(path)
        if any(not b > a for a, b in pairwise(times)) or not len(times):
            raise InputError(f"expected increasing instants in s, got {_short(times)}", field="times")
        if path.exists() and not force:
            raise InputError("exists already and was left as it is; give another --out, or --force", field=path)
        check_store(path, MEASURED)
        dataset = like.to_dataset()
        # the static variables by xarray, those of each frame as empty arrays of one chunk a frame
        maps = [name for name in map_names() if name in dataset]
        fixed = dataset.drop_vars(maps)
        # names as text of any length: the fixed one has no place in Zarr's third format
        names = {k: (k, fixed[k].values.astype(object)) for k in ("view", "component") if k in fixed.coords}
        time = ("time", np.asarray(times, dtype=np.float64), {"units": "s", "axis": "T"})
        fixed = fixed.assign_coords(names).assign_coords(time=time)
        with atomic(path) as part:
            fixed.to_zarr(part, mode="w", consolidated=False, zarr_format=ZARR_FORMAT)
            group = zarr.open_group(part, mode="r+")
            for name in maps:
                v = dataset[name]
                fill = np.nan if v.dtype.kind == "f" else 0
                add_frames(group, name, len(times), v.shape, tuple(map(str, v.dims)), v.dtype, fill, **v.attrs)
            meaning = "written last: the frame is complete"
            add_frames(group, WRITTEN, len(times), (), (), "int8", 0, long_name=meaning)
        return cls(path, tuple(float(t) for t in times))

    def write_frame(self, index: int, measurement: Measurement) -> None:
        """Write one frame, `written` last; cameras and box are those the store was made with.

        Views that the measurement lacks have measured nothing then.
        """
        import numpy as np
        import zarr

        group: Any = zarr.open_group(self.path, mode="r+")
        dataset = measurement.to_dataset()
        names = [str(name) for name in group["view"][:]]
        for name in measurement.names:
            if name not in names:
                raise InputError(
                    f"expected views out of {', '.join(names)}, got '{name}'", field=f"{self.path}, frame {index}"
                )
        places = [names.index(name) for name in measurement.names]
        for name in map_names():
            if (name in dataset) != (name in group):
                has = "with" if name in group else "without"
                raise InputError(
                    f"expected a measurement {has} '{name}' as the others", field=f"{self.path}, frame {index}"
                )
        if WRITTEN in group:
            group[WRITTEN][index] = 0
        for name in (name for name in reversed(map_names()) if name in dataset):
            values = dataset[name].values
            whole = np.full(group[name].shape[1:], group[name].fill_value, dtype=values.dtype)
            whole[places, : values.shape[1], : values.shape[2]] = values
            group[name][index] = whole
        if WRITTEN in group:
            group[WRITTEN][index] = 1

    def is_written(self, index: int) -> bool:
        """Whether a frame has been written, to its end: as `written` says, in stores that have it."""
        import zarr

        group: Any = zarr.open_group(self.path, mode="r")
        if WRITTEN in group:
            return bool(group[WRITTEN][index])
        first = next(kind.measured for kind in TECHNIQUES.values() if kind.measured in group)
        return any(p.is_file() for p in (self.path / first / "c" / str(index)).rglob("*"))


def _measured(dataset: xr.Dataset) -> tuple[str, ...]:
    """Names of what the techniques measured."""
    return tuple(kind.measured for kind in TECHNIQUES.values() if kind.measured in dataset)


def _check_arrays(path: Path) -> None:
    """Open every array by itself: of several opened at once, zarr prints the errors of all but the first."""
    require_zarr()
    import zarr

    for metadata in sorted(path.glob("*/zarr.json")):
        with reading(f"{path}: not a readable Zarr store: {metadata.parent.name}"):
            zarr.open(metadata.parent, mode="r")


def _opened(path: Path) -> xr.Dataset:
    """The store as a dataset of which nothing is read yet."""
    import xarray as xr

    require_zarr()
    if not path.exists():
        raise InputError(f"no such store; expected a measurement sequence (Zarr, {CONVENTIONS})", field=path)
    with reading(f"{path}: not a readable Zarr store"):
        return xr.open_dataset(
            path, engine="zarr", chunks=None, consolidated=False, decode_times=False, zarr_format=ZARR_FORMAT
        )


def _short(times: Sequence[float]) -> str:
    shown = ", ".join(f"{t:g}" for t in times[:4])
    return f"{shown}, ..." if len(times) > 4 else shown or "none"
