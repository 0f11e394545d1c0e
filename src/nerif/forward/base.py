"""The forward model: what the pixels see of a field along their rays. One file beside this one is one technique.

A linear model says what each sample x_m of a ray counts for, in each of its channels:

    prediction = sum_m a_m f(x_m) + b_m . grad f(x_m),      a_m = w_m A,   b_m = w_m B

w is the profile along the ray, A and B belong to the ray. The loss of the network, the voxel operator and its adjoint,
re-projection, the check of views and simulation take these weights from here and from nowhere else. A model that is not
linear moves the samples first (`bend`), or makes of the integral what the pixel reads (`read`).
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

__all__ = ["ForwardModel", "Light", "Weights", "midpoints"]

GRAZING = 1e-3  # of the longest way through the box, below which a ray says nothing of the size of the field


class Light(Protocol):
    """What a forward model has to know of a measurement."""

    @property
    def n_ambient(self) -> float:
        """Refractive index around the flow."""

    @property
    def wavelength_nm(self) -> float | None:
        """Wavelength of the light, nm."""

    @property
    def cameras(self) -> Sequence[Camera]:
        """Of the views."""

    @property
    def maps(self) -> Mapping[str, Tensor]:
        """What has a value a pixel, displacements apart, by its name in the file."""


@dataclass(frozen=True)
class Weights:
    """What the samples of rays count for: a_m = profile_m value, b_m = profile_m slope.

    Parameters
    ----------
    profile : (n, m) along each ray; holds the length that a sample stands for
    value : (n, c) of f, or None for 0
    slope : (n, c, 3) of grad f, or None for 0
    """

    profile: Float[Tensor, "n m"]
    value: Float[Tensor, "n c"] | None = None
    slope: Float[Tensor, "n c 3"] | None = None

    def __call__(self, value: Tensor | None, gradient: Tensor | None) -> Float[Tensor, "n c"]:
        """Return the prediction from f (n, m) and grad f (n, m, 3) at the samples; what does not count may be None."""
        total: Tensor | None = None
        if self.slope is not None:
            assert gradient is not None
            total = torch.einsum("nm,nij,nmj->ni", self.profile, self.slope, gradient)
        if self.value is not None:
            assert value is not None
            part = (self.profile * value).sum(dim=1, keepdim=True) * self.value
            total = part if total is None else total + part
        assert total is not None, "a model sees the field or its gradient"
        return total

    def in_units(self, value: float, gradient: float) -> Weights:
        """Return the weights of a field and a gradient given in such units."""
        return Weights(
            self.profile,
            None if self.value is None else self.value * value,
            None if self.slope is None else self.slope * gradient,
        )

    def sizes(self, length: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Return the prediction, rms over channels, of a field of 1 whose gradient is 1 over a length (mm)."""
        along = self.profile.abs().sum(dim=1)
        size = torch.zeros_like(along)
        if self.value is not None:
            size = size + along * self.value.square().mean(dim=1).sqrt()
        if self.slope is not None:
            size = size + along * self.slope.square().sum(dim=2).mean(dim=1).sqrt() / length
        return size


class ForwardModel(ABC):
    """A technique: what is reconstructed, what a pixel measures of it, and how the one gives the other."""

    name: ClassVar[str]
    """Of the technique, as attribute `technique` of a measurement file has it."""
    tomography: ClassVar[str] = "tomography"
    """What reconstructing a volume by it is called."""
    measured: ClassVar[str]
    """What a pixel measures: the variable of the file."""
    sigma: ClassVar[str]
    """The variable with its standard deviation."""
    beside: ClassVar[Mapping[str, tuple[int, str]]] = {}
    """Further maps that it takes: numbers a pixel and unit, by their names."""
    channels: ClassVar[tuple[str, ...]]
    """Names of the components of what a pixel measures."""
    integrals: ClassVar[int] = 0
    """Numbers that the path integral of a pixel has; 0 for one a channel."""
    unit: ClassVar[str]
    """Of what a pixel measures."""
    misscaled: ClassVar[str] = "another scale"
    """What may make all values of one view too large or too small."""
    limits: ClassVar[tuple[float, float]]
    """Least sigma, and largest value and sigma, that can have been measured."""
    quantity: ClassVar[str]
    """The field that is reconstructed (volume.QUANTITIES)."""
    gauge: ClassVar[bool] = False
    """Whether the measurement leaves a constant of the field open."""
    background: ClassVar[bool] = False
    """Whether the cameras have to look at a background."""
    bounds: ClassVar[tuple[float, float]] = (-math.inf, math.inf)
    """Lowest and highest value that the field can have, in its unit."""
    traced: ClassVar[bool] = False
    """Whether rays can be followed through the field, bent to every order (physics/ray_tracing.py)."""
    straight: ClassVar[bool] = True
    """Whether samples stand on the straight ray."""
    additive: ClassVar[bool] = False
    """Whether a pixel sees a sum, with weights above 0, of a field that is never negative (on a grid, of faces that are
    ambient, weights may be a hundredth of the largest below 0: the spline is mirrored there)."""
    fill: ClassVar[float] = 1.0
    """Share of the path through the box that counts towards what is measured, at about: for the size of the field."""
    gains: ClassVar[bool] = False
    """Whether cameras may be of different brightness, which a fit can tell."""
    averaged: ClassVar[bool] = True
    """Whether the mean over neighbouring pixels is what their mean ray measures."""
    windowed: ClassVar[bool] = False
    """Whether a pixel may have measured the mean over a window of pixels."""
    derived: ClassVar[str] = ""
    """Technique whose values are found in these, such as displacements in images, by a window's reach of them."""
    guess: ClassVar[str] = ""
    """Map that holds what those values are about."""
    outlier: ClassVar[float] = math.inf
    """Residuals, in sigma, beyond which a pixel counts by their size and not by its square (Huber)."""
    settles: ClassVar[bool] = False
    """Whether something of what is measured beside the field has to be fitted to a prediction (`settle`)."""
    linear: ClassVar[bool] = True
    """Whether the weights say all: neither `bend` nor `read` changes anything."""

    @classmethod
    @abstractmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        """Return the model of the technique in a light; `model` names one of several where there are such."""

    @abstractmethod
    def weights(self, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]) -> Weights:
        """Return what samples at path lengths s (mm) count for, each of which stands for a length (mm)."""

    @classmethod
    def in_pixels(cls) -> bool:
        """Return whether values are lengths in the image, which shrink with it."""
        return cls.unit == "px"

    @property
    def linear_twin(self) -> ForwardModel:
        """The linear model of the same integral: itself, if it is linear."""
        assert self.linear, f"{type(self).__name__} has to name its linear twin"
        return self

    @property
    def integral(self) -> ForwardModel:
        """The model of the path integral alone, before it is read: itself, where the maps of files hold integrals."""
        return self

    @property
    def constants(self) -> dict[str, Any]:
        """What it knows of the light, by names."""
        return dict(vars(self))

    @property
    def patch(self) -> int:
        """Edge (px) of the squares of pixels that one ray through their middle stands for, each with its own value."""
        return 1

    @classmethod
    def seen_by(cls, camera: Camera) -> Camera:
        """Return the camera, without the background or the window that the technique does not look at."""
        camera = camera if cls.background or camera.background is None else camera.without_background
        return camera if cls.windowed else camera.without_window

    def bend(
        self,
        value: Float[Tensor, "n m"],
        gradient: Float[Tensor, "n m 3"],
        rays: Rays,
        s: Float[Tensor, "n m"],
        step: Float[Tensor, "n m"],
    ) -> tuple[Float[Tensor, "n m 3"], Float[Tensor, "n m 3"]]:
        """Return by how much (mm) samples leave the straight ray, and what is to be taken off the gradient there.

        Asked only of a model that is not `straight`, and given the field and its gradient on the straight ray.
        """
        raise NotImplementedError(f"{type(self).__name__} has straight rays")

    @classmethod
    def check(
        cls,
        values: Float[Tensor, "row column c"],
        sigma: Float[Tensor, "row column c"] | None,
        usable: Bool[Tensor, "row column"],
    ) -> None:
        """Refuse the map of a view that cannot be what the technique measures.

        Raises
        ------
        InputError
            Saying what is wrong, and what to do.
        """
        return

    @classmethod
    def detected(
        cls, values: Float[Tensor, "*n c"], counts: float, generator: torch.Generator
    ) -> tuple[Float[Tensor, "*n c"], Float[Tensor, "*n c"]]:
        """Return what is measured with so many detected quanta, and its sigma.

        Raises
        ------
        InputError
            If the noise of the technique is not that of quanta.
        """
        raise InputError(f"expected a technique that counts quanta, got {cls.name}; give --noise", field="counts")

    def reading(
        self, values: Float[Tensor, "n c"], sigma: Float[Tensor, "n c"] | None, rays: Rays
    ) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n c"] | None]:
        """Return what was measured, and its sigma, as `read` has it."""
        return values, sigma

    def read(self, prediction: Float[Tensor, "n k"], rays: Rays) -> Float[Tensor, "n c"]:
        """Return what the pixels of rays read of the integral: the integral itself."""
        return prediction

    def residual(
        self, prediction: Float[Tensor, "n k"], measured: Float[Tensor, "n c"], rays: Rays
    ) -> Float[Tensor, "n c"]:
        """Return the difference of what pixels read of the integral and what was measured, as `reading` has it."""
        return self.read(prediction, rays) - measured

    def settle(
        self,
        prediction: Float[Tensor, "n k"],
        measured: Float[Tensor, "n c"],
        inverse_sigma: Float[Tensor, "n c"],
        rays: Rays,
    ) -> None:
        """Fit what is open beside the field, such as the brightness of images, to the integral that is predicted."""
        return

    @property
    def settled(self) -> Tensor:
        """What `settle` fitted, view by view."""
        raise NotImplementedError(f"{type(self).__name__} settles nothing")

    def adopt(self, settled: Tensor) -> None:
        """Take over what `settle` fitted elsewhere."""
        raise NotImplementedError(f"{type(self).__name__} settles nothing")

    @classmethod
    def completed(cls, maps: Mapping[str, Tensor], attributes: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the maps, and those that attributes of their file stand for.

        Raises
        ------
        InputError
            If an attribute is not what it should be.
        """
        return dict(maps)

    @classmethod
    def softened(cls, maps: Mapping[str, Tensor], sizes: Sequence[tuple[int, int]], px: float) -> dict[str, Tensor]:
        """Return maps blurred by a Gaussian of that standard deviation; as they are, where that makes them no easier.

        Parameters
        ----------
        sizes : (height, width) of each view, px
        """
        return dict(maps)

    def prepare(self) -> None:
        """Compute what the maps of all views share, before threads make them side by side."""
        return

    def mapped(self, integral: Float[Tensor, "row column k"], view: int) -> Float[Tensor, "row column c"]:
        """Return what the map of a view holds of the integral: the integral itself."""
        return integral

    def field_scale(self, rays: Rays, measured: Float[Tensor, "n c"]) -> float:
        """Return the size of field that makes measurements of the size given; 0 where all of them are 0."""
        length = rays.far - rays.near
        through = length > GRAZING * length.max()
        rays, measured, length = rays[through], measured[through], length[through]
        middle = 0.5 * (rays.near + rays.far)
        sizes = self.weights(rays, middle[:, None], length[:, None]).sizes(length)
        return float((measured / sizes[:, None]).square().mean().sqrt()) / self.fill


def midpoints(rays: Rays, samples: int, of_pixel: int = 1) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m"]]:
    """Return the midpoints of `samples` equal intervals between near and far, and their length, both mm.

    Where several rays in a row are those of a pixel, the samples of each stand elsewhere in their intervals, evenly.
    """
    step = ((rays.far - rays.near) / samples)[:, None].expand(-1, samples)
    place = (torch.arange(of_pixel, dtype=rays.near.dtype, device=rays.near.device) + 0.5) / of_pixel
    index = torch.arange(samples, dtype=rays.near.dtype, device=rays.near.device)
    index = index + place.repeat(len(rays) // of_pixel)[:, None]
    return rays.near[:, None] + index * step, step
