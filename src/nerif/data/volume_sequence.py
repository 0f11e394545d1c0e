"""Volumes over time: a Zarr store with a chunk per frame (time, z, y, x), which xarray can open at any time."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from nerif.common.conventions import InputError, ambient_index
from nerif.common.files import atomic, ending, reading
from nerif.common.memory import check_memory
from nerif.common.times import check_interval, interval, seconds
from nerif.data.folder_export import Exported, OnFile, write_frames, write_planes
from nerif.data.kinds import SEQUENCE_RESULT, TRUE_SEQUENCE, Kind, check_kind, reading_as
from nerif.data.measurement_sequence import ZARR_FORMAT, add_frames, check_instants, check_store, require_store
from nerif.data.quantity_names import describe, field_of, name_of
from nerif.data.volume import REFERENCES, Volume, export
from nerif.forward.forward_model import ForwardModel
from nerif.forward.registry import ASSUMED, technique
from nerif.geometry import Box, Grid

if TYPE_CHECKING:
    import numpy as np
    import zarr

__all__ = ["FIELDS", "StoredViewScores", "VolumeSequence", "score_names"]

FIELDS = ("fields over time", "box_lower_mm")
"""Content of such a store, and an attribute that marks it."""
Store = TypeVar("Store", bound="VolumeSequence")


@dataclass(frozen=True)
class StoredViewScores:
    """Agreement of the re-projection with the views by one technique, on disk."""

    technique: type[ForwardModel]  #: quantity that a pixel measures
    cc: Any
    """(time, view) correlation, zarr.Array; NaN: no data."""
    rms: Any
    """(time, view) rms difference in the unit of the technique, zarr.Array; NaN: no data."""


def score_names(kinds: Sequence[type[ForwardModel]]) -> dict[type[ForwardModel], tuple[str, str]]:
    """Return the names of the arrays of correlation and rms difference; with a suffix after the first technique."""
    names: dict[type[ForwardModel], tuple[str, str]] = {}
    for kind in kinds:
        suffix = f"_{kind.measured}" if names else ""
        names[kind] = f"cc{suffix}", f"{'rms_px' if kind.in_pixels() else 'rms'}{suffix}"
    return names


class VolumeSequence:
    """A Zarr store of volumes on one grid."""

    kinds: tuple[Kind, ...] = (SEQUENCE_RESULT, TRUE_SEQUENCE)
    """Kinds of stores that the class reads."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        with reading_as(path, *self.kinds):
            self._open()
        check_kind(path, *self.kinds)

    def _open(self) -> None:
        path = self.path
        require_store(path, "volumes over time (Zarr)")
        import zarr

        expected = "expected volumes over time, written by nerif"
        with reading(expected, path):
            self.group: zarr.Group = zarr.open_group(self.path, mode="r+", zarr_format=ZARR_FORMAT)
            self.attributes: dict[str, Any] = dict(self.group.attrs)
        if absent := {"box_lower_mm", "box_upper_mm", "n_ambient"} - set(self.attributes):
            text = f"{expected}, got a store without {min(absent)}; run nerif sequence on measurements"
            raise InputError(text, field=path)
        with reading(expected, path):
            z, y, x = (self.array(a).shape[0] for a in "zyx")
            time = self.read("time", slice(None)), self.array("time").attrs.get("units")
            box = Box(tuple(self.attributes["box_lower_mm"]), tuple(self.attributes["box_upper_mm"]))
            self.n_ambient = ambient_index(self.attributes["n_ambient"])
            self.grid = Grid(box, (z, y, x))
        self.times = tuple(map(float, seconds(*time, path)))
        check_instants(self.times, path)
        check_interval(self.times, self.attributes, path)

    @classmethod
    def create(
        cls: type[Store], path: Path, times: Sequence[float], grid: Grid, quantities: Sequence[str], n_ambient: float,
        attributes: Mapping[str, Any] | None = None,
    ) -> Store:  # fmt: skip
        """Make an empty store in place of an earlier one.

        Parameters
        ----------
        times : of the frames, s
        grid : of the volumes, mm
        quantities : such as index_excess, density
        attributes : further attributes, JSON
        """
        import numpy as np
        import xarray as xr
        import zarr

        check_store(Path(path), FIELDS)
        check_instants(times, "times")
        axes = {a: (a, grid.axis(a).numpy(), {"units": "mm", "axis": a.upper()}) for a in "zyx"}
        fixed = xr.Dataset(
            coords={"time": ("time", np.array(times, dtype=np.float64), {"units": "s", "axis": "T"}), **axes},
            attrs={
                "Conventions": "CF-1.11",
                "title": f"Fields of {name_of(field_of(quantities) or quantities[0])} over time",
                "references": REFERENCES,
                "n_ambient": n_ambient,
                "box_lower_mm": list(grid.box.lower),
                "box_upper_mm": list(grid.box.upper),
                **interval(times),
                **(attributes or {}),
            },
        )
        with atomic(path) as part:
            fixed.to_zarr(part, mode="w", consolidated=False, zarr_format=ZARR_FORMAT)
            group = zarr.open_group(part, mode="r+")
            for quantity in quantities:
                unit, name = describe(quantity)
                about = {"units": unit, "long_name": name}
                add_frames(group, quantity, len(times), grid.shape, ("z", "y", "x"), "float32", **about)
        return cls(path)

    def array(self, name: str) -> Any:  # the types of zarr do not cover indexing
        """Return an array of the store (zarr.Array)."""
        with reading(f"{self.path}: '{name}': cannot be read; is it damaged?"):
            return self.group[name]

    def read(self, name: str, index: int | slice) -> np.ndarray:
        """Return the values of an array in one frame, or in several."""
        import numpy as np

        with reading(f"{self.path}: '{name}': cannot be read; is it damaged?"):
            array = self.array(name)
            size = array.nbytes if isinstance(index, slice) else array.nbytes / array.shape[0]
            check_memory(size, self.path, f"{self.path}: {name}")
            return np.asarray(array[index])

    @property
    def view_scores(self) -> list[StoredViewScores]:
        """Agreement of re-projection and views by technique; empty for a store of volumes only."""
        names = score_names([technique(name) for name in self.attributes.get("techniques", [ASSUMED.name])])
        present = [(kind, cc, rms) for kind, (cc, rms) in names.items() if cc in self.group]
        return [StoredViewScores(kind, self.array(cc), self.array(rms)) for kind, cc, rms in present]

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the volumes."""
        volumes = ("time", "z", "y", "x")
        return tuple(name for name, _ in self.group.arrays() if self.array(name).metadata.dimension_names == volumes)

    def __len__(self) -> int:
        return len(self.times)

    def write(self, index: int, volumes: Sequence[Volume]) -> None:
        """Write the volumes of one frame."""
        for volume in volumes:
            self.array(volume.quantity)[index] = volume.values.float().numpy()

    def volume(self, index: int, quantity: str) -> Volume:
        """Return one quantity of one frame; NaN where it is masked or the frame is missing."""
        import torch

        if quantity not in self.quantities:
            raise InputError(f"expected one of {', '.join(self.quantities)}, got '{quantity}'", field=self.path)
        values = torch.from_numpy(self.read(quantity, index))
        return Volume.of(values, self.grid, quantity, self.n_ambient)

    @property
    def complete(self) -> list[int]:
        """Numbers of the complete frames: all of a store without status, else those that are done."""
        import numpy as np

        if "status" not in self.group:
            return list(range(len(self)))
        return [int(i) for i in np.flatnonzero(self.read("status", slice(None)) == 1)]

    def export(
        self, path: str | os.PathLike[str], quantities: Sequence[str] = (), frame: int | None = None,
        force: bool = False, on_file: OnFile = lambda done, total: None,
    ) -> Exported:  # fmt: skip
        """Write one frame, or all complete ones, for other programs.

        Parameters
        ----------
        path : NAME.pvd (ParaView) or NAME.dat (Tecplot) for all frames, each a file in the folder NAME; for one frame a
            format of volumes, or NAME.txt (DaVis), u and v on planes z = constant, each a file in the folder NAME
        quantities : to write; default: all
        frame : number of the frame
        force : replace an earlier export
        on_file : called with the numbers of written files and of all
        """
        path, names, complete = Path(path), tuple(quantities or self.quantities), self.complete
        if frame is None and ending(path) in (".pvd", ".dat"):
            if not complete:
                raise InputError("expected at least one finished frame, got none", field=self.path)
            times = {i: self.times[i] for i in complete}
            place = write_frames(path, times, lambda i: [self.volume(i, name) for name in names], force, on_file)
            summary = f"{len(names)} quantities of {len(complete)} frames"
            return Exported(place, summary, len(self) - len(complete))
        if frame is None or frame not in complete:
            text = f"a complete frame, 0 to {len(self) - 1}, or all with NAME.pvd or NAME.dat"
            raise InputError(f"expected {text}, got {'none' if frame is None else frame}", field="frame")
        if ending(path) != ".txt":
            export(path, [self.volume(frame, name) for name in names], force)
            return Exported(path, f"{len(names)} quantities of frame {frame}")
        if not {"u", "v"} <= {*self.quantities} or not {*quantities} <= {"u", "v"}:
            raise InputError("expected u and v of velocities for .txt; for others give NAME.dat", field="quantities")
        place = write_planes(path, self.volume(frame, "u"), self.volume(frame, "v"), force, on_file)
        z = self.grid.axis("z")
        return Exported(place, f"u and v of frame {frame} on {len(z)} planes, z = {z[0]:g} to {z[-1]:g} mm")
