"""Whether two runs see the same data: a digest of each part of a measurement."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.forward.registry import forward_model
from nerif.geometry import Camera

__all__ = ["check_fingerprint", "digest", "fingerprint"]


def fingerprint(measurement: Measurement, open_faces: tuple[str, ...] = ()) -> dict[str, str]:
    """Return a digest of each part of what a reconstruction sees of a measurement, by the part's name.

    Parameters
    ----------
    measurement : Measurement
    open_faces : faces whose rays are dropped
    """
    usable, seen = measurement.usable, {}
    light: dict[str, list[Any]] = {}
    for o in measurement.observations:
        own = measurement.usable_for(o)
        seen[o.technique.measured] = digest([o.values[own]])
        seen[o.technique.sigma] = digest([None if o.sigma is None else o.sigma[own]])
        for name, value in forward_model(o.technique, measurement).constants.items():
            light.setdefault(name, []).append(value)
    return {
        "views": digest(measurement.names),
        "cameras": digest(part for camera in measurement.cameras for part in _parts(camera)),
        **seen,
        "valid pixels": digest([usable]),
        "flow_mask": digest([measurement.flow_mask]),
        "box": digest([measurement.box.lower, measurement.box.upper]),
        "n_ambient": digest([measurement.n_ambient]),
        **{name: digest(values) for name, values in light.items()},
        "ambient_faces": digest(sorted(measurement.ambient_faces)),
        "open_faces": digest(sorted(open_faces)),
    }


def check_fingerprint(kept: dict[str, str] | None, asked: dict[str, str]) -> None:
    """Refuse to go on with a run that saw other data.

    Raises
    ------
    InputError
        Naming the parts that differ.
    """
    if kept is None:
        raise InputError(
            "resume: the checkpoint does not tell which data it belongs to, so it is of another version of nerif; "
            "start without --resume"
        )
    changed = [name for name in asked if kept.get(name) != asked[name]]
    if changed:
        raise InputError(
            f"resume: expected the data that the run began with, got other {', '.join(changed)}; "
            "give the same measurement, --hold-out and --open-faces, or start without --resume"
        )


def _parts(camera: Camera) -> tuple[Any, ...]:
    plane = camera.background
    optics = (camera.projection.name, camera.intrinsics, camera.rotation, camera.translation, camera.distortion)
    lens: tuple[Any, ...] = () if camera.lens is None else (camera.lens.diameter, camera.lens.focus)
    lens += (camera.lens.window,) if camera.lens is not None and camera.lens.window else ()
    return (*optics, camera.image_size, *(() if plane is None else (plane.normal, plane.offset)), *lens)


def digest(parts: Iterable[Any]) -> str:
    """Return a digest of tensors and plain values, in their order."""
    seen = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, Tensor):
            seen.update(str(tuple(part.shape)).encode() + part.contiguous().numpy().tobytes())
        else:
            seen.update(repr(part).encode())
        seen.update(b"|")
    return seen.hexdigest()
