"""The parameters of a rig that can be refined: names, units, priors, and tables of their estimates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NotRequired

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import TypedDict

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Camera
from nerif.geometry.pose import GEOMETRY, Corrections

__all__ = [
    "MOVED", "NAMES", "RefinedView", "displaced", "prior", "refinement_lines", "with_corrections",
]  # fmt: skip

IMAGE = ("u", "v", "u_x", "u_y", "v_x", "v_y")
"""Displacement of a whole image, px: constant, and growing from the middle to the edge along columns and rows."""
NAMES = (*GEOMETRY, *IMAGE)
UNITS = (*("rad",) * 3, *("mm",) * 3, "1", "mm", *("px",) * 6)

POSE_SIGMA = 0.2, 0.02  # mm, degrees
ZOOM_SIGMA, BACKGROUND_SIGMA = 1e-3, 0.5  # share of the focal length; mm
LINEAR_SHARE = 0.2  # of the shift: displacement at the edge by rotation and zoom of a shaken camera
MOVED = 3.0  # sigma: a larger correction is significant
ROUNDING = 1e-6  # sigma
FEW_VIEWS = 3  # to which a field can be fitted for nearly any poses
UNCONSTRAINED = 0.3  # share of the prior uncertainty that the data remove (posterior.py), below which they say little


class RefinedView(TypedDict):
    """Estimates of the parameters of a view, by their names, in UNITS."""

    name: str
    values: dict[str, float]
    prior_sigma: dict[str, float]
    correction_over_sigma: float
    """Size of image_shift_px or, if larger, of the largest parameter."""
    image_shift_px: float
    """Shift of the middle of the box in the image."""
    posterior_sigma: NotRequired[dict[str, float]]
    image_shift_sigma_px: NotRequired[float]
    """Posterior standard deviation in the worse direction."""
    uncertainty_reduction: NotRequired[float]
    """1 minus posterior over prior uncertainty of that shift."""
    rms_before: NotRequired[float]
    rms_after: NotRequired[float]
    """Residual over sigma as calibrated and as refined, with the same field."""


def displaced(numbers: Float[Tensor, "n 6"], place: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
    """Return the displacement (px) by IMAGE parameters at places from the middle of the image, 1 at the edge."""
    return numbers[:, :2] + torch.einsum("nij,nj->ni", numbers[:, 2:].unflatten(1, (2, 2)), place)


def prior(camera: Camera, mm: float | None, deg: float | None, px: float) -> Float[Tensor, 14]:
    """Return the prior standard deviations of NAMES for a view.

    Parameters
    ----------
    mm, deg : of position and orientation; None for the camera's own, or POSE_SIGMA if it has none
    px : of the shift of the image
    """
    sigma = torch.tensor([math.radians(POSE_SIGMA[1])] * 3 + [POSE_SIGMA[0]] * 3, dtype=torch.float64)
    if camera.pose_sigma is not None:
        sigma = camera.pose_sigma.double().clone()
    if deg is not None:
        sigma[:3] = math.radians(deg)
    if mm is not None:
        sigma[3:] = mm
    rest = [ZOOM_SIGMA, BACKGROUND_SIGMA, px, px, *[LINEAR_SHARE * px] * 4]
    return torch.cat([sigma, torch.tensor(rest, dtype=torch.float64)])


def with_corrections(measurement: Measurement, table: Sequence[RefinedView]) -> Measurement:
    """Return a measurement with the refined cameras of a `Refinement.table`, and without the shifts of its images.

    Views that are not in the table are unchanged.
    """
    if not table:
        return measurement
    _check_table(table)
    rows: dict[str, Any] = {row["name"]: row for row in table}
    estimates = [rows.get(name, {}).get("values", {}) for name in measurement.names]
    values = torch.tensor([[row.get(name, 0.0) for name in NAMES] for row in estimates], dtype=torch.float64)
    cameras = Corrections(measurement.cameras, values[:, : len(GEOMETRY)]).corrected
    cameras = tuple(_with_sigma(camera, rows.get(camera.name, {}).get("posterior_sigma", {})) for camera in cameras)
    d = measurement.displacement
    if d is not None and bool(values[:, len(GEOMETRY) :].any()):
        d = d.clone()
        for i, camera in enumerate(cameras):
            height, width = camera.image_size
            pixel = camera.pixel_grid().reshape(-1, 2).double()
            middle = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64)
            image = values[i, len(GEOMETRY) :].expand(len(pixel), -1)
            shift = displaced(image, (pixel - middle) / (max(height, width) / 2)).reshape(height, width, 2)
            d[i, :height, :width] -= shift.to(d)
    return replace(measurement, cameras=cameras, displacement=d)


def _with_sigma(camera: Camera, sigma: dict[str, float]) -> Camera:
    """The camera with the posterior standard deviations of its pose, if there are all."""
    if not all(name in sigma for name in NAMES[:6]):
        return camera
    return replace(camera, pose_sigma=torch.tensor([sigma[name] for name in NAMES[:6]], dtype=torch.float64))


def _check_table(table: Any) -> None:
    for row in table if isinstance(table, Sequence) else [None]:
        row = row if isinstance(row, dict) else {}
        values = row.get("values")
        if (
            not isinstance(values, dict)
            or not isinstance(row.get("name"), str)
            or not all(n in NAMES and isinstance(v, int | float) and math.isfinite(v) for n, v in values.items())
        ):
            raise InputError(
                f"expected for each view a name and finite values of {', '.join(NAMES)}, got {row!r}", field="rig"
            )


def refinement_lines(table: Sequence[RefinedView]) -> list[str]:
    """Return a summary of a refinement, and a line for each view with a significant correction."""
    most = max(table, key=lambda row: row["correction_over_sigma"])
    size = most["correction_over_sigma"]
    largest = f"{most['name']}, {size:.1f} × the prior standard deviation"
    lines = [f"refined {len(table)} views; largest correction: {largest}"]
    if size < ROUNDING:
        lines = [f"refined {len(table)} views: pose errors are not significant; cameras unchanged"]
    if len(table) <= FEW_VIEWS:
        lines.append(f"with {len(table)} views the field can be fitted for nearly any poses; corrections are uncertain")
    weak = [row["name"] for row in table if row.get("uncertainty_reduction", 1.0) < UNCONSTRAINED]
    if weak:
        views = "any view" if len(weak) == len(table) else ", ".join(weak)
        lines.append(
            f"the data do not constrain the pose of {views}, since the field can adapt or the noise is too large; "
            "it stays as calibrated"
        )
    for row in (row for row in table if row["correction_over_sigma"] > MOVED):
        number, value = max(row["values"].items(), key=lambda n: abs(n[1]) / max(row["prior_sigma"][n[0]], 1e-30))
        lines.append(
            f"view {row['name']} is not where its calibration says: {number} {value:.3g} {UNITS[NAMES.index(number)]}, "
            f"{row['correction_over_sigma']:.1f} × the prior standard deviation, {row['image_shift_px']:.2g} px in the "
            "image; calibrate it again, or state a larger pose_sigma"
        )
    return lines
