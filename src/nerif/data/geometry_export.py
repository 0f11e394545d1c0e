"""The geometry of cameras and grid for ASTRA and TIGRE (.npz)."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import atomic, ending
from nerif.data.measurement import Measurement
from nerif.geometry import Grid
from nerif.geometry.astra import astra_of
from nerif.geometry.tigre import tigre_of

__all__ = ["PROGRAMS", "export_geometry"]

PROGRAMS: dict[str, Callable[..., dict[str, Any]]] = {
    "astra": lambda cameras, size, grid, say: astra_of(cameras, size, grid), "tigre": tigre_of,
}  # fmt: skip
"""The arrays of the geometry for each tomography program."""


def export_geometry(
    path: str | os.PathLike[str], measurement: Measurement, grid: Grid, program: str,
    say: Callable[[str], None] = lambda line: None,
) -> None:  # fmt: skip
    """Write cameras and grid as the geometry of one of PROGRAMS to a .npz file; `say` reports what it does not hold."""
    if program not in PROGRAMS:
        raise InputError(f"expected {' or '.join(PROGRAMS)}, got '{program}'", field="format")
    if ending(path) != ".npz":
        raise InputError(f"expected a name ending in .npz for the geometry of {program}, got '{path}'", field="out")
    cameras, (_, *size) = measurement.cameras, measurement.shape
    arrays = PROGRAMS[program](cameras, tuple(size), grid, say)
    if names := [c.name for c in cameras if c.lens is not None and c.lens.wide]:
        say(f"apertures and windows are no part of the geometry, whose rays are thin: {', '.join(names)}")
    arrays |= {"views": np.array(measurement.names), "image_size": np.array([c.image_size for c in cameras])}
    with atomic(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)
