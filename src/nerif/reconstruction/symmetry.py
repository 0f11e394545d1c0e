"""The symmetry that a reconstruction is asked for, about the axis that is named or found."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

import torch

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry.symmetry import Axis, Symmetry, parse_symmetry
from nerif.reconstruction.axis_search import find_axis
from nerif.reconstruction.gauge import ambient_faces
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.sources import of_source

__all__ = ["axis_of", "check_views", "symmetry_asked", "with_axis"]

Asked = TypeVar("Asked", bound=SharedSettings)

PLACE = 0.03  # of the longest edge of the box: standard deviation of where an axis is, if nothing is said
ROUNDING = 0.002  # of the longest edge of the box: within this of the axis a field is round


def symmetry_asked(settings: SharedSettings, measurement: Measurement) -> Symmetry | None:
    """Return the symmetry about the axis as it is named."""
    parsed = parse_symmetry(settings.symmetry)
    if parsed is None:
        return None
    box = measurement.box
    direction = settings.axis_direction
    if direction is None:
        direction = (0.0, 0.0, 1.0) if parsed[0] == "axis" else _looked_along(measurement)
    point = box.centre if settings.axis_point is None else settings.axis_point
    return Symmetry.about(settings.symmetry, point, direction, ROUNDING * max(box.edges))


def check_views(settings: SharedSettings, measurement: Measurement) -> None:
    """Refuse more harmonics than the views could tell: 2 N + 1 functions of (r, h), of which a view tells two.

    Raises
    ------
    InputError
        If there are N views or fewer.
    """
    parsed, views = parse_symmetry(settings.symmetry), len(measurement.cameras)
    if parsed is not None and parsed[1] >= views:
        most = "axis" if views == 1 else f"axis+{views - 1}"
        raise InputError(
            f"symmetry: expected {parsed[1] + 1} views or more for {settings.symmetry}, better {2 * parsed[1] + 1}, "
            f"got {views}; give --symmetry {most}"
        )


def axis_of(settings: SharedSettings, measurement: Measurement) -> Axis | None:
    """Return the symmetry about the axis as it is found near the one named; None where none is asked for.

    A planar flow's line, and an axis whose standard deviations are 0, are as they are named.
    """
    symmetry = symmetry_asked(settings, measurement)
    if symmetry is None:
        return None
    mm = settings.axis_sigma_mm
    mm = PLACE * max(measurement.box.edges) if mm is None else mm
    sigma = (mm, math.radians(settings.axis_sigma_deg))
    if not symmetry.axial or not any(sigma):
        return Axis(symmetry, (0.0,) * 4, (0.0,) * 4, (0.0,) * 4, math.nan)
    seen = of_source(measurement, "auto", preferred="displacements")
    faces = ambient_faces(measurement, settings.ambient_faces)
    return find_axis(seen, symmetry, sigma, faces, settings.open_faces)


def with_axis(settings: Asked, symmetry: Symmetry) -> Asked:
    """Return settings that take the axis of a symmetry that was found as given."""
    return replace(
        settings, axis_point=symmetry.point, axis_direction=symmetry.direction, axis_sigma_mm=0.0, axis_sigma_deg=0.0
    )


def _looked_along(measurement: Measurement) -> tuple[float, float, float]:
    """The edge of the box along which the cameras look most."""
    looks = torch.stack([camera.rotation[2].double() for camera in measurement.cameras])
    x, y, z = torch.eye(3)[int(looks.square().sum(dim=0).argmax())].tolist()
    return x, y, z
