"""The path integral of a forward model along each ray: what the pixels measure of a field."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.pauses import pause
from nerif.fields.base import Field
from nerif.forward.base import ForwardModel, midpoints
from nerif.geometry import Rays

__all__ = ["LENS_RAYS", "PathIntegral", "Projector", "places", "project"]

LENS_RAYS = 16
"""Rays through the lens of a pixel, each with half as many samples as a thin ray."""


class Projector(ABC):
    """From a field and rays to what the pixels see."""

    channels: int
    """Numbers that a pixel measures."""

    @abstractmethod
    def __call__(self, field: Field, rays: Rays) -> Float[Tensor, "n c"]:
        """Return what the pixels of rays that are clipped to the box see."""


@dataclass(frozen=True)
class PathIntegral(Projector):
    """The integral of a forward model by midpoints of equal intervals; through a lens the mean over its rays.

    Parameters
    ----------
    model : ForwardModel
    samples : number of samples along a ray
    """

    model: ForwardModel
    samples: int = 200

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise InputError(f"expected at least one sample along a ray, got {self.samples}", field="samples")

    @property
    def channels(self) -> int:  # type: ignore[override]
        return len(self.model.channels)

    def __call__(self, field: Field, rays: Rays) -> Float[Tensor, "n c"]:
        if rays.lens is None:
            return self.along(field, rays, *midpoints(rays, self.samples))
        spread = rays.spread(LENS_RAYS)
        s, step = midpoints(spread, math.ceil(self.samples / 2), LENS_RAYS)
        return spread.mean_of(LENS_RAYS, self.along(field, spread, s, step))

    def along(
        self, field: Field, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]
    ) -> Float[Tensor, "n c"]:
        """Return the integral along thin rays by samples at path lengths s, each of which stands for a length, mm."""
        model = self.model
        points, tilt = places(model, rays, s, step, field.value_and_gradient)
        weights = model.weights(rays, s, step)
        if weights.slope is None:
            return weights(field(points), None)
        value, gradient = field.value_and_gradient(points)
        return weights(value, gradient if tilt is None else gradient - tilt)


def places(
    model: ForwardModel,
    rays: Rays,
    s: Float[Tensor, "n m"],
    step: Float[Tensor, "n m"],
    look: Callable[[Float[Tensor, "n m 3"]], tuple[Float[Tensor, "n m"], Float[Tensor, "n m 3"]]],
) -> tuple[Float[Tensor, "n m 3"], Float[Tensor, "n m 3"] | None]:
    """Return where the samples of rays stand (mm), and what is to be taken off the gradient there; None for nothing.

    Parameters
    ----------
    s, step : path lengths of the samples, and the length that each stands for, mm
    look : gives the field and its gradient (1/mm) at points; asked only where rays are not straight
    """
    points = rays.at(s)
    if model.straight:
        return points, None
    offset, tilt = model.bend(*look(points), rays, s, step)
    return points + offset, tilt


@torch.no_grad()
def project(
    projector: Projector, field: Field, rays: Rays, device: torch.device | str = "cpu", chunk: int | None = None
) -> Float[Tensor, "n c"]:
    """Return what many rays see of a field, chunk by chunk, where the rays are; 0 where a ray misses the box."""
    if chunk is None:  # arrays that stay in the cache of a CPU, and fill a GPU
        chunk = 32 if torch.device(device).type == "cpu" else 4096
    if rays.lens is not None:
        chunk = max(1, chunk * 2 // LENS_RAYS)
    result = rays.origin.new_zeros(len(rays), projector.channels)
    index, field = rays.crosses.nonzero()[:, 0], field.to(device)
    for part in torch.split(index, chunk):
        pause()
        result[part] = projector(field, rays[part].to(device)).to(result)
    return result
