"""The path integral of a forward model along each ray: the projections of a field."""

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
from nerif.fields.field import Field
from nerif.forward.forward_model import ForwardModel, midpoints
from nerif.geometry import Rays

__all__ = ["LENS_RAYS", "FieldProjector", "PathIntegral", "places", "project"]

LENS_RAYS = 16  # through the lens of a pixel, each with half as many samples as a thin ray
CHUNK_RAYS = {"cpu": 32, "gpu": 4096}  # arrays that stay in the cache of a CPU, and fill a GPU


class FieldProjector(ABC):
    """The projections of a field along rays that are clipped to the box."""

    channels: int  # components of the measured quantity

    @abstractmethod
    def __call__(self, field: Field, rays: Rays) -> Float[Tensor, "n c"]: ...


@dataclass(frozen=True)
class PathIntegral(FieldProjector):
    """The integral of a forward model by midpoints of equal intervals; through a lens the mean over its rays."""

    model: ForwardModel
    samples: int = 200  # along a ray

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
        """Return the integral along thin rays from samples at path lengths s, each for a length `step`, mm."""
        model = self.model
        points, tilt = places(model, rays, s, step, field.value_and_gradient)
        weights = model.weights(rays, s, step)
        if weights.slope is None:
            return weights(field(points), None)
        value, gradient = field.value_and_gradient(points)
        return weights(value, gradient if tilt is None else gradient - tilt)


def places(
    model: ForwardModel, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"],
    look: Callable[[Float[Tensor, "n m 3"]], tuple[Float[Tensor, "n m"], Float[Tensor, "n m 3"]]],
) -> tuple[Float[Tensor, "n m 3"], Float[Tensor, "n m 3"] | None]:  # fmt: skip
    """Return the positions of samples (mm), and a vector to subtract from their gradient, or None.

    For rays that are not straight `look` returns the field and its gradient (1/mm) at points.
    """
    points = rays.at(s)
    if model.straight:
        return points, None
    offset, tilt = model.bend(*look(points), rays, s, step)
    return points + offset, tilt


@torch.no_grad()
def project(
    projector: FieldProjector, field: Field, rays: Rays, device: torch.device | str = "cpu", chunk: int | None = None
) -> Float[Tensor, "n c"]:
    """Return the projections of a field along many rays, in chunks, on the device of the rays; 0 outside the box."""
    chunk = chunk or CHUNK_RAYS["cpu" if torch.device(device).type == "cpu" else "gpu"]
    if rays.lens is not None:
        chunk = max(1, chunk * 2 // LENS_RAYS)
    result = rays.origin.new_zeros(len(rays), projector.channels)
    index, field = rays.crosses.nonzero()[:, 0], field.to(device)
    for part in torch.split(index, chunk):
        pause()
        result[part] = projector(field, rays[part].to(device)).to(result)
    return result
