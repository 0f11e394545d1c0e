"""The forward model: the measured quantity of the pixels as a function of the field along their rays.

A linear model gives quadrature weights for the samples x_m of a ray, in each of its channels:

    prediction = sum_m a_m f(x_m) + b_m . grad f(x_m),      a_m = w_m A,   b_m = w_m B

w is the profile along the ray, A and B belong to the ray. The loss of the network, the voxel operator, re-projection,
simulation and the check of views all use these weights. A nonlinear model moves the samples first (`bend`), or
transforms the integral (`read`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.geometry import Camera, Rays

__all__ = [
    "ForwardModel", "Light", "Map", "Mask", "PerRay", "SampleVectors", "Samples", "Weights", "masked_blur", "midpoints",
]  # fmt: skip

MIN_PATH = 1e-3  # of the longest path through the box; shorter rays are not used to estimate the size of the field

PerRay = Float[Tensor, "n _"]  # a column per channel, or per integral
Samples = Float[Tensor, "n m"]
SampleVectors = Float[Tensor, "n m 3"]
Map = Float[Tensor, "row column _"]
Mask = Bool[Tensor, "row column"]


class Light(Protocol):
    """The part of a measurement on which forward models depend; `maps` are by their names in the file."""

    @property
    def n_ambient(self) -> float: ...
    @property
    def wavelength_nm(self) -> float | None: ...
    @property
    def cameras(self) -> Sequence[Camera]: ...
    @property
    def maps(self) -> Mapping[str, Tensor]: ...


@dataclass(frozen=True)
class Weights:
    """Quadrature weights of the samples of rays: a_m = profile_m value, b_m = profile_m slope."""

    profile: Float[Tensor, "n m"]  # includes the length of each sample
    value: Float[Tensor, "n c"] | None = None  # of f; None for 0
    slope: Float[Tensor, "n c 3"] | None = None  # of grad f; None for 0

    def __call__(self, value: Tensor | None, gradient: Tensor | None) -> Float[Tensor, "n c"]:
        """Return the prediction from f (n, m) and grad f (n, m, 3) at the samples; one without weights may be None."""
        total: Tensor | None = None
        if self.slope is not None:
            assert gradient is not None
            total = torch.einsum("nm,nij,nmj->ni", self.profile, self.slope, gradient)
        if self.value is not None:
            assert value is not None
            part = (self.profile * value).sum(dim=1, keepdim=True) * self.value
            total = part if total is None else total + part
        assert total is not None, "a model depends on the field or its gradient"
        return total

    def in_units(self, value: float, gradient: float) -> Weights:
        """Return the weights of a field and a gradient in these units."""
        a, b = self.value, self.slope
        return Weights(self.profile, None if a is None else a * value, None if b is None else b * gradient)

    def sizes(self, length: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Return the prediction, rms over channels, for a field of 1 whose gradient is 1 over a length (mm)."""
        along = self.profile.abs().sum(dim=1)
        size = torch.zeros_like(along)
        if self.value is not None:
            size = size + along * self.value.square().mean(dim=1).sqrt()
        if self.slope is not None:
            size = size + along * self.slope.square().sum(dim=2).mean(dim=1).sqrt() / length
        return size


class ForwardModel(ABC):
    """A technique: its field, its measured quantity, and the relation between them."""

    name: ClassVar[str]  # value of attribute `technique` of measurement files
    tomography: ClassVar[str] = "tomography"  # name of the reconstruction of a volume
    measured: ClassVar[str]  # variable of the file with the measured quantity
    sigma: ClassVar[str]  # variable with its standard deviation
    beside: ClassVar[Mapping[str, tuple[int, str]]] = {}  # further maps: components and unit, by variable
    channels: ClassVar[tuple[str, ...]]  # names of the components of the measured quantity
    unit: ClassVar[str]  # of the measured quantity
    misscaled: ClassVar[str] = "another scale"  # likely cause if all values of one view are too large or too small
    limits: ClassVar[tuple[float, float]]  # smallest plausible sigma; largest plausible value and sigma
    quantity: ClassVar[str]  # the field (volume.QUANTITIES)
    gauge: ClassVar[bool] = False  # the data leave a constant of the field undetermined
    background: ClassVar[bool] = False  # the cameras need a background
    bounds: ClassVar[tuple[float, float]] = (-math.inf, math.inf)  # lowest and highest possible value of the field
    traced: ClassVar[bool] = False  # there is a model with rays traced through the field (ray_tracing.py)
    straight: ClassVar[bool] = True  # samples lie on the straight ray
    # a pixel is a sum of a non-negative field with positive weights (on a grid with ambient faces, where the spline is
    # mirrored, weights may be as low as minus a hundredth of the largest)
    additive: ClassVar[bool] = False
    fill: ClassVar[float] = 1.0  # approximate share of the path through the box that contributes: for the field's size
    gains: ClassVar[bool] = False  # intensity gains of cameras can be fitted
    windowed: ClassVar[bool] = False  # a pixel may be the mean over a correlation window
    derived: ClassVar[str] = ""  # technique whose values are computed from these, such as displacements from images
    linear: ClassVar[bool] = True  # the weights are the whole model, without `bend` and `read`

    @classmethod
    @abstractmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        """Return the model of the technique for a measurement; `model` selects one of several."""

    @abstractmethod
    def weights(self, rays: Rays, s: Samples, step: Samples) -> Weights:
        """Return the weights of samples at path lengths s, each for a length `step`, mm."""

    @classmethod
    def data_name(cls) -> str:
        """Return the name of the data as printed: the measured quantity, or images."""
        return cls.name if cls.derived else cls.measured

    @classmethod
    def in_pixels(cls) -> bool:
        """Return whether values are lengths in the image."""
        return cls.unit == "px"

    @property
    def linear_twin(self) -> ForwardModel:
        """The linear model of the same integral."""
        assert self.linear, f"{type(self).__name__} has to name its linear twin"
        return self

    @property
    def constants(self) -> dict[str, Any]:
        """The properties of the measurement on which the model depends, by name."""
        return dict(vars(self))

    @classmethod
    def seen_by(cls, camera: Camera) -> Camera:
        """Return the camera without the background or window that does not apply to the technique."""
        camera = camera if cls.background or camera.background is None else camera.without_background
        return camera if cls.windowed else camera.without_window

    def bend(
        self, value: Samples, gradient: SampleVectors, rays: Rays, s: Samples, step: Samples
    ) -> tuple[SampleVectors, SampleVectors]:
        """Return the offset of the samples from the straight ray (mm), and a vector to subtract from their gradient.

        For models that are not `straight`, from field and gradient on the straight ray.
        """
        raise NotImplementedError

    @classmethod
    def check(cls, values: Map, sigma: Map | None, usable: Mask) -> None:
        """Raise InputError for a map of a view that is not physically possible."""
        return

    @classmethod
    def detect(cls, values: Tensor, counts: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return values (..., c) with the shot noise of a number of detected quanta, and sigma."""
        raise InputError(f"expected a technique that counts quanta, got {cls.name}; give --noise", field="counts")

    def reading(self, values: PerRay, sigma: PerRay | None, rays: Rays) -> tuple[PerRay, PerRay | None]:
        """Return measured values and sigma in the form that `read` predicts."""
        return values, sigma

    def read(self, prediction: PerRay, rays: Rays) -> PerRay:
        """Return the reading of pixels from their path integral."""
        return prediction

    def field_scale(self, rays: Rays, measured: PerRay) -> float:
        """Return the typical size of a field with measured values of this size; 0 if all are 0."""
        length = rays.far - rays.near
        through = length > MIN_PATH * length.max()
        rays, measured, length = rays[through], measured[through], length[through]
        middle = 0.5 * (rays.near + rays.far)
        sizes = self.weights(rays, middle[:, None], length[:, None]).sizes(length)
        return float((measured / sizes[:, None]).square().mean().sqrt()) / self.fill


def midpoints(rays: Rays, samples: int, of_pixel: int = 1) -> tuple[Samples, Samples]:
    """Return the midpoints of `samples` equal intervals between near and far, and their length, both mm.

    Successive rays of one pixel have their samples at different, evenly spaced positions in the intervals.
    """
    step = ((rays.far - rays.near) / samples)[:, None].expand(-1, samples)
    place = (torch.arange(of_pixel, dtype=rays.near.dtype, device=rays.near.device) + 0.5) / of_pixel
    index = torch.arange(samples, dtype=rays.near.dtype, device=rays.near.device)
    index = index + place.repeat(len(rays) // of_pixel)[:, None]
    return rays.near[:, None] + index * step, step


def masked_blur(values: Float[Tensor, "row column c"], good: Mask, px: float) -> Float[Tensor, "row column c"]:
    """Return the mean of good pixels, weighted by a Gaussian of a standard deviation, in double precision."""
    from scipy.ndimage import gaussian_filter

    weight = torch.from_numpy(gaussian_filter(good.double().numpy(), px)).clamp(min=1e-6)
    filled = torch.where(good[..., None], values, 0.0).double()
    return torch.from_numpy(gaussian_filter(filled.numpy(), (px, px, 0))) / weight[..., None]
