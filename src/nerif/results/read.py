"""Any file or folder of nerif, read by its kind."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeAlias

from nerif.common.conventions import InputError
from nerif.data import kinds
from nerif.data.cameras_file import CalibratedCamera, read_cameras
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.results.directory import Result, ResultDirectory

__all__ = ["Content", "read"]

Content: TypeAlias = Measurement | MeasurementSequence | Volume | VolumeSequence | Result | tuple[CalibratedCamera, ...]
READERS: dict[kinds.Kind, Callable[[Any], Content]] = {
    kinds.MEASUREMENT: Measurement.read,
    kinds.SEQUENCE: MeasurementSequence.read,
    kinds.VOLUME: read_volume,
    kinds.TRUE_SEQUENCE: VolumeSequence,
    kinds.SEQUENCE_RESULT: VolumeSequence,
    kinds.VELOCITY: VelocitySequence,
    kinds.RESULT: lambda path: ResultDirectory(path).read(),
    kinds.CALIBRATION: read_cameras,
}


def read(path: str | os.PathLike[str]) -> Content:
    """Read a measurement, a volume (its field), a result directory, a calibration, or one of these over time."""
    kind = kinds.kind_of(path)
    if kind is not None and kind in READERS:
        return READERS[kind](path)
    if not os.path.exists(path):
        raise InputError("no such file or folder", field=path)
    kinds.check_kind(path, *READERS)
    raise InputError(f"expected {', '.join(k.name for k in READERS)}; got something else", field=path)
