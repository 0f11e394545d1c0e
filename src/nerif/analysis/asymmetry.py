"""The two halves of an image of an axisymmetric flow: which pixel lies on which side, and how the halves differ.

An axisymmetric field does not change by reflection at the plane through the camera and the axis. The displacement
map therefore equals its own reflection, apart from noise and the antisymmetric part:

    d(p) = M(q + d(q)) - p,     q = M(p),     M the reflection of the image
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as functional
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError, percent
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import Observation
from nerif.geometry import Camera
from nerif.geometry.symmetry import Symmetry

__all__ = [
    "HALVES", "Reflection", "asymmetry", "asymmetry_sentence", "camera_of", "halved", "left_of_axis", "withhold_half",
]  # fmt: skip

HALVES = ("left", "right")  #: halves of an image, seen in the direction of the axis
MIN_PIXELS = 30  # whose reflection was measured too


@dataclass(frozen=True)
class Reflection:
    """The reflection M of an image at the plane through its camera and an axis."""

    camera: Camera
    symmetry: Symmetry

    def __call__(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Return the reflected pixels, px; NaN behind the camera."""
        points = self._points(pixels)
        normal, distance = self._beside(points)
        return self.camera.project(points - 2 * distance[:, None] * normal)

    def side(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
        """Return the distance of rays from the plane, mm at the depth of the axis, positive on the left."""
        return self._beside(self._points(pixels))[1]

    def _points(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        """The points of the rays closest to the axis."""
        rays = self.camera.rays(pixels.to(self.camera.intrinsics.dtype), sensitivity=False)
        axis = torch.tensor(self.symmetry.direction, dtype=torch.float64)
        origin, direction = rays.origin.double(), rays.direction.double()
        away = torch.tensor(self.symmetry.point, dtype=torch.float64) - origin
        across = direction - (direction @ axis)[:, None] * axis
        s = (away * across).sum(-1) / across.square().sum(-1).clamp_min(1e-12)
        return origin + s[:, None] * direction

    def _beside(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " n"]]:
        """The normal of the plane, to the left in the image, and the distance of points from it."""
        axis = torch.tensor(self.symmetry.direction, dtype=torch.float64)
        point = torch.tensor(self.symmetry.point, dtype=torch.float64)
        sight = self.camera.sight(point.to(self.camera.rotation)).double()
        normal = torch.linalg.cross(axis, sight.reshape(3))
        normal = normal / normal.norm().clamp_min(1e-12)
        return normal, (points - point) @ normal


def left_of_axis(camera: Camera, symmetry: Symmetry) -> Bool[Tensor, "row column"]:
    """Return the pixels of a camera on the left of the axis."""
    pixels = camera.pixel_grid().reshape(-1, 2).double()
    return (Reflection(camera, symmetry).side(pixels) > 0).reshape(camera.image_size)


def halved(measurement: Measurement, symmetry: Symmetry) -> Measurement:
    """Return the measurement with two views for each, NAME left and NAME right, with the pixels of one half each."""
    inside = measurement.usable
    index, cameras, valid = [], [], []
    for view, camera in enumerate(measurement.cameras):
        left = torch.zeros(inside.shape[1:], dtype=torch.bool)
        left[: camera.image_size[0], : camera.image_size[1]] = left_of_axis(camera, symmetry)
        for name, side in zip(HALVES, (left, ~left), strict=True):
            if bool((inside[view] & side).any()):
                index.append(view)
                cameras.append(replace(camera, name=f"{camera.name} {name}"))
                valid.append(inside[view] & side)

    picked = measurement.mapped(lambda x: x[index]) | {"valid": torch.stack(valid)}
    return replace(measurement, cameras=tuple(cameras), **picked)


def camera_of(view: str) -> str:
    """Return the name of the camera of a view, which may be one of its HALVES."""
    name, _, half = view.rpartition(" ")
    return name if half in HALVES and name else view


def withhold_half(
    measurement: Measurement, withhold: Sequence[str], axis: Mapping[str, Any] | Symmetry | None
) -> tuple[Measurement, tuple[str, ...]]:
    """Return the measurement and the names of the withheld views; in halves if `withhold` is one of HALVES.

    Parameters
    ----------
    withhold : names of views, or one of HALVES, unless a view has that name
    axis : of an axisymmetric flow, or its record in metrics.json; None otherwise
    """
    names = tuple(withhold)
    if len(names) != 1 or names[0] not in HALVES or names[0] in measurement.names:
        return measurement, names
    if not axis:
        raise InputError(
            f"expected half an image ('{names[0]}') with --symmetry axis only; name views", field="withhold"
        )
    symmetry = axis if isinstance(axis, Symmetry) else Symmetry.from_entries(axis["symmetry"])
    halves = halved(measurement, symmetry)
    return halves, tuple(name for name in halves.names if name.endswith(f" {names[0]}"))


def asymmetry(measurement: Measurement, symmetry: Symmetry) -> list[dict[str, Any]]:
    """Return how far each view departs from that of an axisymmetric flow.

    `cc` is the correlation of each channel with its reflection, `antisymmetry` the rms of the antisymmetric part over
    the rms of the signal, both without noise where sigma is known.
    """
    rows = []
    for view, camera in enumerate(measurement.cameras):
        for o in measurement.observations:
            if o.technique.derived:
                continue
            usable = measurement.usable_for(o)[view] & measurement.sees_box[view]
            row = _of_view(camera, symmetry, o, view, usable)
            if row is not None:
                rows.append({"name": camera.name, "measured": o.technique.measured, **row})
    return rows


def asymmetry_sentence(row: Mapping[str, Any]) -> str:
    """Return one row of `asymmetry` in words."""
    cc = ", ".join(f"{name} {value:.3f}" for name, value in row["cc"].items())
    share = f"{percent(row['antisymmetry'], 0)} of the signal is antisymmetric"
    return f"{row['name']}: the halves of the {row['measured']} correlate by {cc}; {share}"


def _of_view(
    camera: Camera, symmetry: Symmetry, o: Observation, view: int, usable: Bool[Tensor, "row column"]
) -> dict[str, Any] | None:
    height, width = camera.image_size
    usable = usable[:height, :width]
    values = o.values[view, :height, :width].double().nan_to_num(0.0, 0.0, 0.0) * usable[..., None]
    reflection, pixels = Reflection(camera, symmetry), camera.pixel_grid().reshape(-1, 2).double()
    mirrored = reflection(pixels)
    sampled = _interpolated(torch.cat([values, usable[..., None].double()], dim=-1), mirrored)
    both = usable.flatten() & (sampled[:, -1] > 0.999)
    if int(both.sum()) < MIN_PIXELS:
        return None
    here, there = values.reshape(len(pixels), -1)[both], sampled[both, :-1]
    if o.technique.in_pixels():
        there = reflection(mirrored[both] + there) - pixels[both]
    channels: Sequence[str] = o.technique.channels
    cc = {c: _correlation(here[:, i], there[:, i]) for i, c in enumerate(channels)}
    antisymmetric, signal = float((here - there).square().mean()) / 2, float(here.square().mean())
    if o.sigma is not None:
        noise = float(o.sigma[view, :height, :width].double().reshape(len(pixels), -1)[both].square().mean())
        antisymmetric, signal = max(antisymmetric - noise, 0.0), max(signal - noise, 0.0)
    return {"cc": cc, "antisymmetry": math.sqrt(antisymmetric / signal)} if signal > 0 else None


def _interpolated(image: Float[Tensor, "row column c"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Bilinear interpolation, 0 outside the image."""
    height, width, _ = image.shape
    size = pixels.new_tensor([width - 1, height - 1]).clamp_min(1)
    place = (2 * pixels / size - 1).nan_to_num(9.0)
    sampled = functional.grid_sample(image.movedim(-1, 0)[None], place[None, None], align_corners=True)
    return sampled[0, :, 0].T


def _correlation(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a @ b) / (a.norm() * b.norm()).clamp_min(1e-300))
