"""Cameras of a geometry of ASTRA or TIGRE in a .npz file, by `nerif export --format` or by NumPy.

ASTRA: numpy.savez(path, **proj_geom) of cone_vec or parallel3d_vec
TIGRE: numpy.savez(path, **vars(geo), angles=angles)
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError, within
from nerif.common.files import reading
from nerif.common.npz import open_npz
from nerif.data.cameras_file import CalibratedCamera
from nerif.geometry.astra import camera_of, from_astra
from nerif.geometry.tigre import from_tigre
from nerif.imaging.calibration.importers.names import UNNAMED

__all__ = ["read_geometry"]

ASTRA = ("type", "DetectorRowCount", "DetectorColCount", "Vectors")
TIGRE = ("angles", "DSO", "DSD", "nDetector", "dDetector")


def read_geometry(path: Path, say: Callable[[str], None]) -> list[CalibratedCamera]:
    """Read the cameras, without backgrounds; `say` reports views whose images have to be turned upside down."""
    entries = _entries(path)
    with reading("expected the numbers of a geometry", path), within(path):
        if set(ASTRA) <= entries.keys():
            kind, rows, size = from_astra(entries)
        elif set(TIGRE) <= entries.keys():
            kind, (rows, size) = "cone_vec", from_tigre(entries)
        else:
            got = ", ".join(entries) or "nothing"
            raise InputError(f"expected {', '.join(ASTRA)} (ASTRA) or {', '.join(TIGRE)} (TIGRE), got {got}")
        names = [str(name) for name in entries.get("views", [f"{UNNAMED}{i + 1}" for i in range(len(rows))])]
        results = [camera_of(kind, row, size, name) for row, name in zip(rows, names, strict=True)]
    if upside_down := [camera.name for camera, reversed_rows in results if reversed_rows]:
        say(
            f"{path.name}: detectors seen from behind, as usual in tomography; turn the images upside down "
            f"(array[::-1], or flip = 'vertical' in views.toml): {', '.join(upside_down)}"
        )
    sizes = np.asarray(entries.get("image_size", [size] * len(rows)))
    return [
        CalibratedCamera.from_values(
            f"{path}: {c.name}",
            c.name,
            c.intrinsics,
            c.rotation,
            c.translation,
            image_size=sizes[i],
            projection=c.projection.name,
        )
        for i, (c, _) in enumerate(results)
    ]


def _entries(path: Path) -> dict[str, Any]:
    """Return the arrays of a file; those of Python objects, such as None, are left out."""
    entries: dict[str, Any] = {}
    with reading("not a file of numpy.savez, or truncated", path), open_npz(path) as (archive, shapes):
        for key in shapes:
            with suppress(ValueError):  # of an object
                entries[key] = archive[key]
    return entries
