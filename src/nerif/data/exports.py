"""Exports: volumes in VTK (.vti for ParaView), NetCDF (.nc), NumPy (.npz), MATLAB (.mat), text (.csv); the geometry of
cameras and grid for ASTRA and TIGRE (.npz).
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from nerif.common.conventions import InputError
from nerif.common.files import atomic, ending
from nerif.data.measurement import Measurement
from nerif.data.velocity_sequence import COMPONENTS, open_volumes
from nerif.data.volume import Volume
from nerif.data.volume_file import write_netcdf
from nerif.data.vti import write_vti
from nerif.geometry import Grid
from nerif.geometry.astra import astra_of
from nerif.geometry.tigre import tigre_of

__all__ = ["FORMATS", "PROGRAMS", "export", "export_frame", "export_geometry", "write_csv", "write_mat", "write_npz"]

PROGRAMS = ("astra", "tigre")
"""Programs for whose geometry there is an export."""


def export(path: str | os.PathLike[str], volumes: list[Volume], force: bool = False) -> None:
    """Write volumes on one grid in the format of the ending of `path`, one of FORMATS; over a file with `force`."""
    if ending(path) not in FORMATS:
        raise InputError(f"expected a name ending in {', '.join(FORMATS)}, got '{Path(path).suffix}'", field=path)
    if not volumes:
        raise InputError("expected at least one volume, got none", field="volumes")
    if Path(path).exists() and not force:
        raise InputError("exists already and was left as it is; give another name, or force=True", field=path)
    FORMATS[ending(path)](path, volumes)


def export_frame(
    path: str | os.PathLike[str], store: str | os.PathLike[str], frame: int | None, quantities: Sequence[str] = (),
    force: bool = False,
) -> int:  # fmt: skip
    """Write quantities of one frame of volumes over time, and return their number; .vti holds velocity as vectors.

    Parameters
    ----------
    frame : from 0
    quantities : all by default
    """
    volumes = open_volumes(store)
    wanted = quantities or volumes.quantities
    if frame is None or not 0 <= frame < len(volumes):
        raise InputError(f"expected 0 to {len(volumes) - 1}, got {'none' if frame is None else frame}", field="frame")
    export(path, [volumes.volume(frame, name) for name in wanted], force)
    return len(wanted)


def _write_vti(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    arrays = {v.quantity: v.values for v in volumes}
    if all(name in arrays for name in COMPONENTS):
        arrays["velocity"] = torch.stack([arrays.pop(name) for name in COMPONENTS])
    write_vti(path, arrays, volumes[0].grid, _attributes(volumes))


def _attributes(volumes: list[Volume]) -> dict[str, float | str]:
    """Return the attributes of all, then unit and notes of each quantity as density.assumption and the like."""
    attributes: dict[str, float | str] = {}
    for v in volumes:
        attributes |= v.attributes
    for v in volumes:
        attributes |= {f"{v.quantity}.{name}": value for name, value in {"units": v.unit, **v.notes}.items()}
    return attributes


def write_npz(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write arrays [z, y, x] by quantity, x_mm, y_mm, z_mm, and units and attributes as JSON in `about`."""
    import numpy as np

    arrays: dict[str, Any] = {v.quantity: v.values.cpu().numpy() for v in volumes}
    arrays |= {f"{a}_mm": volumes[0].grid.axis(a).numpy() for a in "xyz"}
    arrays["about"] = np.array(json.dumps(_attributes(volumes)))
    with atomic(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)


def write_mat(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write a MATLAB 5 file: A(i, j, k) of each quantity is at x_mm(i), y_mm(j), z_mm(k); attributes in `about`.

    For plots with rows along y: isosurface(x_mm, y_mm, z_mm, permute(density, [2 1 3]), level).
    """
    from scipy.io import savemat

    data: dict[str, Any] = {v.quantity: v.values.cpu().numpy().transpose(2, 1, 0) for v in volumes}
    data |= {f"{a}_mm": volumes[0].grid.axis(a).numpy()[:, None] for a in "xyz"}
    data["about"] = {re.sub(r"\W", "_", name): value for name, value in _attributes(volumes).items()}
    with atomic(path) as part, part.open("wb") as file:
        savemat(file, data, do_compression=True, long_field_names=True)


def write_csv(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write one line per voxel: x, y, z in mm, and the quantities."""
    import numpy as np

    points = volumes[0].grid.points(torch.float64).reshape(-1, 3)
    columns = [points, *(v.values.cpu().double().reshape(-1, 1) for v in volumes)]
    header = ",".join(["x_mm", "y_mm", "z_mm", *(f"{v.quantity} [{v.unit}]" for v in volumes)])
    with atomic(path) as part:
        np.savetxt(part, torch.cat(columns, dim=1).numpy(), delimiter=",", header=header, comments="", fmt="%.9g")


FORMATS = {".vti": _write_vti, ".nc": write_netcdf, ".npz": write_npz, ".mat": write_mat, ".csv": write_csv}


def export_geometry(
    path: str | os.PathLike[str],
    measurement: Measurement,
    grid: Grid,
    program: str,
    say: Callable[[str], None] = lambda line: None,
) -> None:
    """Write cameras and grid as the geometry of a tomography program, one of PROGRAMS, to a .npz file.

    Parameters
    ----------
    say : called with lines about what the geometry does not hold
    """
    import numpy as np

    if program not in PROGRAMS:
        raise InputError(f"expected {' or '.join(PROGRAMS)}, got '{program}'", field="format")
    if ending(path) != ".npz":
        raise InputError(f"expected a name ending in .npz for the geometry of {program}, got '{path}'", field="out")
    cameras, (_, rows, columns) = measurement.cameras, measurement.shape
    size = (rows, columns)
    arrays = astra_of(cameras, size, grid) if program == "astra" else tigre_of(cameras, size, grid, say)
    if names := [c.name for c in cameras if c.lens is not None and c.lens.wide]:
        say(f"apertures and windows are no part of the geometry, whose rays are thin: {', '.join(names)}")
    arrays |= {"views": np.array(measurement.names), "image_size": np.array([c.image_size for c in cameras])}
    with atomic(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)
