"""Exports of many files: frames of a film for ParaView (.pvd) and Tecplot (.dat), planes of vectors for DaVis."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.files import atomic, ending
from nerif.common.interruption import if_interrupted
from nerif.data.volume import Volume, export, write_tecplot
from nerif.data.vti import write_pvd
from nerif.geometry import Grid

__all__ = ["FOLDER_FORMATS", "Exported", "OnFile", "write_frames", "write_planes"]

FOLDER_FORMATS = (".pvd", ".txt")
"""Endings for volumes over time only, beside those of one volume."""
PLANE_HEADER = '#DaVis 8.1.6 2D-vector 1 {ny} {nx} "position" "mm" "position" "mm" "velocity" "m/s"\r\n'
"""Type, pixels between vectors (there are none: 1), rows, columns, and units of positions and values."""

OnFile = Callable[[int, int], None]


@dataclass(frozen=True)
class Exported:
    """What an export wrote."""

    path: Path  #: to open, a file or the folder of the frames or planes
    summary: str  #: of its content
    left_out: int = 0  #: frames that are missing or failed


def write_frames(
    path: Path, times: Mapping[int, float], volumes: Callable[[int], list[Volume]], force: bool, on_file: OnFile
) -> Path:
    """Write a file per frame to the folder NAME, and the list of .vti files NAME.pvd; return what to open.

    Tecplot text has a file per frame as well: ParaView and VisIt skip the time of a zone and group numbered files.

    Parameters
    ----------
    path : NAME.pvd, or NAME.dat, which gives its name to the folder alone
    times : of the frames, s, by their numbers
    volumes : of a frame
    force : replace an earlier export of this name
    on_file : called with the numbers of written files and of all
    """

    def write(file: Path, frame: int) -> None:
        if listed:
            export(file, volumes(frame))
        else:
            write_tecplot(file, volumes(frame), times[frame])

    listed, folder = ending(path) == ".pvd", path.with_suffix("")
    if listed and path.exists() and not force:
        raise InputError("exists already and was left as it is; give another name, or force=True", field=path)
    names = _write_folder(path, ".vti" if listed else ".dat", times, write, force, on_file)
    if not listed:
        return folder
    write_pvd(path, {f"{folder.name}/{name}": time for name, time in zip(names, times.values(), strict=True)})
    return path


def write_planes(path: Path, u: Volume, v: Volume, force: bool, on_file: OnFile) -> Path:
    """Write u and v on every plane z = constant to a file in the folder NAME, as text of DaVis; return the folder.

    NaN is written as 0, which is how DaVis marks a vector as invalid.
    """

    def write(file: Path, plane: int) -> None:
        _write_plane(file, u.values[plane], v.values[plane], u.grid)

    _write_folder(path, ".txt", range(u.grid.shape[0]), write, force, on_file)
    return path.with_suffix("")


def _write_plane(path: Path, u: Float[Tensor, "y x"], v: Float[Tensor, "y x"], grid: Grid) -> None:
    """Write x, y, u, v with y descending and x fastest.

    Source: files that DaVis 8 exported (pivpy, tests/data/B00002.txt); third parties import the same text into it.
    """
    x, y = np.meshgrid(grid.axis("x").numpy(), grid.axis("y").numpy()[::-1])
    vectors = [component.cpu().nan_to_num(0.0, 0.0, 0.0).numpy()[::-1] for component in (u, v)]
    with atomic(path) as part, part.open("wb") as file:
        file.write(PLANE_HEADER.format(ny=y.shape[0], nx=y.shape[1]).encode())
        rows = np.stack([x, y, *vectors], axis=-1).reshape(-1, 4)
        np.savetxt(file, rows, fmt="%.9g", delimiter="\t", newline="\r\n")


def _write_folder(
    path: Path, suffix: str, numbers: Iterable[int], write: Callable[[Path, int], None], force: bool, on_file: OnFile
) -> list[str]:
    """Write NAME/NAME_0000.vti and so on, all or none, and return the names of the files.

    A folder of that name is replaced, with `force`, if all its files have such names.
    """
    folder, numbers = path.with_suffix(""), list(numbers)
    if os.path.lexists(folder):
        if not folder.is_dir() or folder.is_symlink():
            raise InputError("exists already, is no folder, and was left as it is; give another name", field=folder)
        content = sorted(entry.name for entry in folder.iterdir())
        pattern = re.compile(rf"{re.escape(folder.name)}_\d{{4,}}{re.escape(suffix)}")
        if foreign := [name for name in content if not pattern.fullmatch(name)]:
            raise InputError(
                f"not overwritten, since {foreign[0]} in it is not part of the export; give another name", field=folder
            )
        if content and not force:
            raise InputError("exists already and was left as it is; give another name, or --force", field=folder)
    names = [f"{folder.name}_{number:04d}{suffix}" for number in numbers]
    with if_interrupted(lambda: "nothing was written; run the same command again"), atomic(folder) as part:
        part.mkdir()
        for done, (name, number) in enumerate(zip(names, numbers, strict=True), start=1):
            write(part / name, number)
            on_file(done, len(names))
    return names
