"""Vectors of DaVis in its own files (.vc7, .set), by LaVision's reader lvpyio, if it is installed.

Components U0 ... V3 are pixels along the axes of the image, v down; ACTIVE_CHOICE selects one; a vector is there where
MASK and ENABLED are 1. Vector (column i, row j) is at ((i + 1/2) grid.x, (j + 1/2) grid.y), 0 the edge of the image.

Source: lvpyio 1.5: types/frame.py, types/plot_utils.py.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import ending, reading
from nerif.imaging.vectors.program import DAVIS, ProgramVectors

__all__ = ["SETS", "davis_frames"]

SETS = (".set",)
POSTPROCESSED = 4  # and above: the choice of smoothed and filled vectors


def davis_frames(path: Path) -> list[Callable[[], ProgramVectors]]:
    """Return a reader for each instant of a buffer or set."""
    lv = _library(path)
    if ending(path) not in SETS:
        return [lambda: _vectors(lv.read_buffer(str(path)), path)]
    with reading("not a readable set of DaVis", path):
        if lv.is_multiset(str(path)):
            raise InputError("expected a set of one view, got a set of sets; name the set of each view", field=path)
        count = len(lv.read_set(str(path)))

    def read(i: int) -> ProgramVectors:
        with reading("not a readable set of DaVis", path):
            buffer = lv.read_set(str(path))[i]
        return _vectors(buffer, path)

    return [lambda i=i: read(i) for i in range(count)]  # type: ignore[misc]


def _library(path: Path) -> Any:
    try:
        import lvpyio
    except ImportError:
        raise InputError(
            "files of DaVis are read by LaVision's own reader; install it (pip install lvpyio, its licence does not "
            "allow to pass it on), or export the vectors as Tecplot .dat",
            field=path,
        ) from None
    return lvpyio


def _vectors(buffer: Any, path: Path) -> ProgramVectors:
    if len(buffer) != 1 or not hasattr(buffer[0], "choices"):
        raise InputError("expected a file of one vector field, got images or several frames", field=path)
    frame = buffer[0]
    if frame.is_3c:
        raise InputError(
            "expected two components of one camera, got three; export the vectors of each camera", field=path
        )
    components = frame.components
    choice = np.asarray(frame.active_choice[0])
    choice = np.where(choice >= POSTPROCESSED, frame.choices - 1, choice)
    u, v = np.zeros(frame.shape), np.zeros(frame.shape)
    for k in range(frame.choices):
        of = choice == k
        u[of], v[of] = components[f"U{k}"][0][of], components[f"V{k}"][0][of]
    valid = (np.asarray(frame.masks[0]) & np.asarray(frame.enabled[0])).astype(bool)
    rows, columns = np.mgrid[: frame.shape[0], : frame.shape[1]]
    x, y = ((index + 0.5) * step for index, step in ((columns, frame.grid.x), (rows, frame.grid.y)))
    return ProgramVectors.of_maps(DAVIS, (x, y, u, v, valid), sigma=_sigma(frame))


def _sigma(frame: Any) -> np.ndarray | None:
    """Return the uncertainty of the two components, px, where the file has it in the unit of the vectors."""
    parts = [frame.components.get(f"TS:Uncertainty V{axis}") for axis in "xy"]
    if any(part is None for part in parts):
        return None
    slope = abs(frame.scales.i.slope) or 1.0
    scaled = [(part.scale.offset + np.asarray(part[0]) * part.scale.slope) / slope for part in parts]
    return np.stack([s.ravel() for s in scaled], axis=-1)
