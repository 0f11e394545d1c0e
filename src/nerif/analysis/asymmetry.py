"""The two halves of an image of an axisymmetric flow: which pixels are on which side, and how far they are alike.

A field about an axis looks the same from a camera when it is reflected at the plane through the camera and the axis. So
the map of what was measured is that of itself reflected,

    d(p) = M(q + d(q)) - p,     q = M(p),     M the reflection of the image,

but for noise, and for what is not alike around the axis.
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

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement, Observation
from nerif.geometry import Camera
from nerif.geometry.symmetry import Symmetry

__all__ = [
    "HALVES",
    "Reflection",
    "asymmetry",
    "asymmetry_sentence",
    "camera_of",
    "halved",
    "kept_half",
    "left_of_axis",
]  # fmt: skip

HALVES = ("left", "right")
"""Of an image, beside the axis as it runs in its direction."""
FEWEST = 30  # pixels that have a counterpart


@dataclass(frozen=True)
class Reflection:
    """The reflection M of an image at the plane through its camera and an axis.

    Parameters
    ----------
    camera : Camera
    symmetry : about the axis
    """

    camera: Camera
    symmetry: Symmetry

    def __call__(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Return where pixels are reflected to, px; NaN where that is not seen."""
        points = self._points(pixels)
        normal, distance = self._beside(points)
        return self.camera.project(points - 2 * distance[:, None] * normal)

    def side(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
        """Return how far to the left of the plane pixels look, mm at the depth of the axis."""
        return self._beside(self._points(pixels))[1]

    def _points(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        """Where rays pass the axis."""
        rays = self.camera.rays(pixels.to(self.camera.intrinsics.dtype), sensitivity=False)
        axis = torch.tensor(self.symmetry.direction, dtype=torch.float64)
        origin, direction = rays.origin.double(), rays.direction.double()
        away = torch.tensor(self.symmetry.point, dtype=torch.float64) - origin
        across = direction - (direction @ axis)[:, None] * axis
        s = (away * across).sum(-1) / across.square().sum(-1).clamp_min(1e-12)
        return origin + s[:, None] * direction

    def _beside(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " n"]]:
        """The plane's normal, towards what is left of the axis in the image, and how far beside it points are."""
        axis = torch.tensor(self.symmetry.direction, dtype=torch.float64)
        point = torch.tensor(self.symmetry.point, dtype=torch.float64)
        sight = self.camera.sight(point.to(self.camera.rotation)).double()
        normal = torch.linalg.cross(axis, sight.reshape(3))
        normal = normal / normal.norm().clamp_min(1e-12)
        return normal, (points - point) @ normal


def left_of_axis(camera: Camera, symmetry: Symmetry) -> Bool[Tensor, "row column"]:
    """Return which pixels of a camera look past the axis on its left."""
    pixels = camera.pixel_grid().reshape(-1, 2).double()
    return (Reflection(camera, symmetry).side(pixels) > 0).reshape(camera.image_size)


def halved(measurement: Measurement, symmetry: Symmetry) -> Measurement:
    """Return the measurement with each view as two, NAME left and NAME right, of which each has one half."""
    inside = measurement.usable
    cameras, valid = [], []
    for view, camera in enumerate(measurement.cameras):
        left = torch.zeros(inside.shape[1:], dtype=torch.bool)
        left[: camera.image_size[0], : camera.image_size[1]] = left_of_axis(camera, symmetry)
        for name, side in zip(HALVES, (left, ~left), strict=True):
            if bool((inside[view] & side).any()):
                cameras.append((view, replace(camera, name=f"{camera.name} {name}")))
                valid.append(inside[view] & side)
    index = [view for view, _ in cameras]

    def twice(x: Tensor | None) -> Tensor | None:
        return None if x is None else x[index]

    return replace(
        measurement,
        cameras=tuple(camera for _, camera in cameras),
        displacement=twice(measurement.displacement),
        sigma=twice(measurement.sigma),
        maps={name: value[index] for name, value in measurement.maps.items()},
        valid=torch.stack(valid),
        flow_mask=twice(measurement.flow_mask),
    )


def camera_of(view: str) -> str:
    """Return the name of the camera of a view, which may be one of its HALVES."""
    name, _, half = view.rpartition(" ")
    return name if half in HALVES and name else view


def kept_half(
    measurement: Measurement, withhold: Sequence[str], axis: Mapping[str, Any] | Symmetry | None
) -> tuple[Measurement, tuple[str, ...]]:
    """Return the measurement in halves, and the names of those held out, if a half is to be; else as they are.

    Parameters
    ----------
    measurement : Measurement
    withhold : names of views, or one of HALVES, unless a view is called so
    axis : about which the flow is symmetric, or what the metrics of a result hold of it; None for no symmetry
    """
    words = tuple(withhold)
    if len(words) != 1 or words[0] not in HALVES or words[0] in measurement.names:
        return measurement, words
    if not axis:
        raise InputError(
            f"expected half an image ('{words[0]}') with --symmetry axis only; name views", field="withhold"
        )
    symmetry = axis if isinstance(axis, Symmetry) else Symmetry.from_entries(axis["symmetry"])
    parts = halved(measurement, symmetry)
    return parts, tuple(name for name in parts.names if name.endswith(f" {words[0]}"))


def asymmetry(measurement: Measurement, symmetry: Symmetry) -> list[dict[str, Any]]:
    """Return how far what each view measured departs from what it would be of a flow alike around the axis.

    `cc` is the correlation of each channel with its reflection, `departure` the rms of what is odd over the rms of
    what was measured, noise taken off both where sigma is known.
    """
    found = []
    for view, camera in enumerate(measurement.cameras):
        for o in measurement.observations:
            if o.technique.derived:
                continue
            usable = measurement.usable_for(o)[view] & measurement.sees_box[view]
            row = _of_view(camera, symmetry, o, view, usable)
            if row is not None:
                found.append({"name": camera.name, "measured": o.technique.measured, **row})
    return found


def asymmetry_sentence(departure: Mapping[str, Any]) -> str:
    """Return one of `asymmetry` in words."""
    cc = ", ".join(f"{name} {value:.3f}" for name, value in departure["cc"].items())
    share = f"what is odd about the axis is {departure['departure']:.0%} of it"
    return f"{departure['name']}: the halves of the {departure['measured']} correlate by {cc}; {share}"


def _of_view(
    camera: Camera, symmetry: Symmetry, o: Observation, view: int, usable: Bool[Tensor, "row column"]
) -> dict[str, Any] | None:
    height, width = camera.image_size
    usable = usable[:height, :width]
    values = o.values[view, :height, :width].double().nan_to_num(0.0, 0.0, 0.0) * usable[..., None]
    reflection, pixels = Reflection(camera, symmetry), camera.pixel_grid().reshape(-1, 2).double()
    mirrored = reflection(pixels)
    known = torch.cat([values, usable[..., None].double()], dim=-1)
    there = _read(known, mirrored)
    both = usable.flatten() & (there[:, -1] > 0.999)
    if int(both.sum()) < FEWEST:
        return None
    own, other = values.reshape(len(pixels), -1)[both], there[both, :-1]
    if o.technique.in_pixels():
        other = reflection(mirrored[both] + other) - pixels[both]
    channels: Sequence[str] = o.technique.channels
    cc = {c: _correlation(own[:, i], other[:, i]) for i, c in enumerate(channels)}
    odd, size = float((own - other).square().mean()) / 2, float(own.square().mean())
    if o.sigma is not None:
        noise = float(o.sigma[view, :height, :width].double().reshape(len(pixels), -1)[both].square().mean())
        odd, size = max(odd - noise, 0.0), max(size - noise, 0.0)
    if not size > 0:
        return None  # there is nothing but noise, which has no symmetry to depart from
    return {"cc": cc, "departure": math.sqrt(odd / size)}


def _read(known: Float[Tensor, "row column c"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """A map between its pixels, 0 beyond it."""
    height, width, _ = known.shape
    size = pixels.new_tensor([width - 1, height - 1]).clamp_min(1)
    place = (2 * pixels / size - 1).nan_to_num(9.0)
    sampled = functional.grid_sample(known.movedim(-1, 0)[None], place[None, None], align_corners=True)
    return sampled[0, :, 0].T


def _correlation(a: Float[Tensor, " n"], b: Float[Tensor, " n"]) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a @ b) / (a.norm() * b.norm()).clamp_min(1e-300))
