"""Calibrations in YAML or XML, one file or a folder: of OpenCV, ROS, kalibr or DaVis, distinguished by content."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError
from nerif.common.files import ending, read_yaml
from nerif.data.cameras_file import CalibratedCamera
from nerif.imaging.calibration.importers.davis import davis_root, read_davis
from nerif.imaging.calibration.importers.kalibr import is_kalibr, read_kalibr
from nerif.imaging.calibration.importers.opencv import read_opencv, read_storage
from nerif.imaging.calibration.importers.ros import is_ros, read_ros

__all__ = ["ENDINGS", "read_yaml_files"]

ENDINGS = (".yml", ".yaml", ".xml")
PROGRAMS = {
    "ROS": (read_ros, 1000.0), "kalibr": (read_kalibr, 1000.0), "OpenCV": (read_opencv, 1.0),
    "DaVis": (read_davis, 1.0),
}  # fmt: skip
"""Reader of each program, and the unit of its lengths in mm: ROS and kalibr define metres, OpenCV none."""


def read_yaml_files(path: Path, say: Callable[[str], None]) -> tuple[list[CalibratedCamera], float]:
    """Return the cameras of a file or folder, and its unit of length in mm; report two files that are read together."""
    inside = path.is_dir()
    files = _files(path) if inside else [path]
    if not files:
        raise InputError(f"expected calibrations ({' '.join(ENDINGS)}), got none", field=path)
    contents = {file: _content(file) for file in files}
    programs = {program: file for file, (program, _) in contents.items()}
    if len(programs) > 1:
        names = " and ".join(f"{file.name} of {program}" for program, file in programs.items())
        raise InputError(f"expected files of one program, got {names}; give one of the files", field=path)
    (program,) = programs
    reader, unit = PROGRAMS[program]

    def beside() -> dict[Path, dict[str, Any]]:
        """The other files of the program in the folder of a single file."""
        others = {}
        for file in [] if inside else _files(path.parent):
            with suppress(InputError):
                of, values = _content(file)
                if of == program and file.name != path.name:
                    others[file] = values
        return others

    return reader({file: values for file, (_, values) in contents.items()}, beside, say), unit


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if ending(p) in ENDINGS and p.is_file() and not p.name.startswith("."))


def _content(file: Path) -> tuple[str, dict[str, Any]]:
    """Return program and entries of a file."""
    if ending(file) == ".xml" and (root := davis_root(file)) is not None:
        return "DaVis", {"root": root}
    values = {} if ending(file) == ".xml" else _plain_yaml(file)
    if is_kalibr(values):
        return "kalibr", values
    if is_ros(values):
        return "ROS", values
    return "OpenCV", read_storage(file)


def _plain_yaml(file: Path) -> dict[str, Any]:
    """Return the entries of YAML without OpenCV's own types; empty for anything else."""
    values = None
    with suppress(InputError):
        values = read_yaml(file)
    return {str(key): value for key, value in values.items()} if isinstance(values, dict) else {}
