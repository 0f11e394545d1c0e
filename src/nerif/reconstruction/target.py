"""The data of a reconstruction: the usable rays of a measurement, their measured values and weights."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.transfer import to_device
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import Observation
from nerif.forward.forward_model import ForwardModel
from nerif.forward.images import Images
from nerif.forward.model_names import AUTO
from nerif.forward.registry import forward_models
from nerif.geometry import Rays
from nerif.reconstruction.bins import binned_rays, patches

__all__ = ["Target", "TechniqueData", "check_target"]

PIECE_RAYS = 1 << 17


@dataclass(frozen=True)
class TechniqueData:
    """Rays and their measured values by one technique."""

    model: ForwardModel
    rays: Rays
    measured: Float[Tensor, "n c"]  # as the model's `reading` gives them
    inverse_scale: Float[Tensor, "n c"]  # 1/sigma, scaled to an ambient residual of mean square 1 over all parts
    outlier: float = math.inf  # scaled residual beyond which the loss is linear (Huber)
    offset: Float[Tensor, "n k"] | None = None  # added to predictions
    images: Images | None = None  # with which the integral is compared, if `measured` are grey values

    def __len__(self) -> int:
        return len(self.rays)

    def __getitem__(self, index: Tensor | slice) -> TechniqueData:
        measured, inverse = self.measured[index], self.inverse_scale[index]
        offset = None if self.offset is None else self.offset[index]
        return replace(self, rays=self.rays[index], measured=measured, inverse_scale=inverse, offset=offset)

    def to(self, device: torch.device | str) -> TechniqueData:
        measured, inverse = self.measured.to(device), self.inverse_scale.to(device)
        return replace(self, rays=self.rays.to(device), measured=measured, inverse_scale=inverse)

    def residual(self, prediction: Float[Tensor, "n k"]) -> Float[Tensor, "n c"]:
        """Return the scaled difference between a path integral and the measured values.

        Outliers are reduced by a factor without gradient, so that the slope of their square is that of Huber's loss.
        """
        integral = prediction if self.offset is None else prediction + self.offset
        r = self.difference(integral) * self.inverse_scale
        return r if math.isinf(self.outlier) else r * (self.outlier / r.detach().abs().clamp(min=self.outlier)).sqrt()

    def difference(self, integral: Float[Tensor, "n k"]) -> Float[Tensor, "n c"]:
        """Return the reading of a path integral minus the measured one."""
        if self.images is not None:
            return self.images.residual(integral, self.measured, self.rays)
        return self.model.read(integral, self.rays) - self.measured

    @property
    def ambient_residual(self) -> Float[Tensor, "n c"]:
        """The scaled residual of the ambient field."""
        return self.residual(self.measured.new_zeros(len(self), len(self.model.channels)))

    @property
    def of_field(self) -> Float[Tensor, "n c"]:
        """The measured values less the offset, for models whose path integral is the measured quantity."""
        return self.measured if self.offset is None else self.measured - self.offset.to(self.measured)

    def split(self) -> list[TechniqueData]:
        """Return the part in pieces that need little memory."""
        return [self[i : i + PIECE_RAYS] for i in range(0, len(self), PIECE_RAYS)]


def check_target(measurement: Measurement, model: str = AUTO, linear: bool = False) -> None:
    """Raise InputError for a model that no technique has, and for several techniques without sigma."""
    forward_models(measurement.techniques, measurement, model, linear)
    observations = measurement.observations
    if len(observations) > 1 and any(o.sigma is None for o in observations):
        names, sigmas = (" and ".join(getattr(o.technique, a) for o in observations) for a in ("name", "sigma"))
        raise InputError(f"{names} are weighted by their noise: expected {sigmas}, got not both", field="technique")


@dataclass(frozen=True)
class Target:
    """The data of all techniques."""

    parts: tuple[TechniqueData, ...]  # one for each technique
    scale: float  # typical size of the field, from that of the data
    # mean square of the ambient field's residual over sigma (over 1 without sigma): the factor from the mean square of
    # a scaled residual to that in units of the noise
    chi_square: float
    sigma_known: bool
    noise: float | None = None  # mean square residual of the noise over that of the ambient field; None without sigma

    @classmethod
    def of(
        cls, measurement: Measurement, open_faces: tuple[str, ...] = (), edge: int = 1, model: str = AUTO,
        linear: bool = False, single: bool = False,
    ) -> Target:  # fmt: skip
        """Collect the usable rays that cross none of the open faces, or those of bins of edge x edge pixels.

        `linear` requires a linear model; with `single` every pixel has a ray of its own, even if the model has patches.
        """
        check_target(measurement, model, linear)
        models = forward_models(measurement.techniques, measurement, model, linear)
        parts, scales = [], []
        sigma_known = all(o.sigma is not None for o in measurement.observations)
        for forward, observation in zip(models, measurement.observations, strict=True):
            images = forward if isinstance(forward, Images) and not forward.linear else None
            patch = 1 if single or images is None else images.patch
            rays, values, sigma = _rays(measurement, observation, open_faces, edge, patch)
            scales.append(forward.field_scale(rays, values))
            measured, noise = forward.reading(values, sigma if observation.sigma is not None else None, rays)
            noise = sigma if observation.sigma is None else noise  # of bins: by their number of pixels
            inverse = torch.ones_like(measured) if noise is None else 1 / noise
            of_rays = forward if images is None else images.integral
            parts.append(TechniqueData(of_rays, rays, measured, inverse, images=images))
        empty = torch.cat([p.ambient_residual.flatten() for part in parts for p in part.split()])
        chi_square = float(empty.square().mean()) or 1.0  # for data that are all 0
        unit = 1 / math.sqrt(chi_square)
        parts = [replace(p, inverse_scale=p.inverse_scale * unit) for p in parts]
        if sigma_known:
            parts = [replace(p, outlier=_outlier(p) * unit) for p in parts]
        scale = math.sqrt(sum(s**2 for s in scales) / len(scales)) or 1e-6
        noise_share = _noise_share(parts, chi_square) if sigma_known else None
        return cls(tuple(parts), scale, chi_square, sigma_known, noise_share)

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    @property
    def numbers(self) -> int:
        """Number of measured values."""
        return sum(part.measured.numel() for part in self.parts)

    def __getitem__(self, index: Tensor) -> Target:
        """Return the rays of an index (on the CPU) that counts through all parts."""
        parts, first = [], 0
        for part in self.parts:
            inside = index[(index >= first) & (index < first + len(part))]
            parts.append(part[to_device(inside - first, part.measured.device)])
            first += len(part)
        return replace(self, parts=tuple(parts))

    def without_outliers(self) -> Target:
        """Return the target with the square of every residual as loss."""
        return replace(self, parts=tuple(replace(part, outlier=math.inf) for part in self.parts))

    def to(self, device: torch.device | str) -> Target:
        return replace(self, parts=tuple(part.to(device) for part in self.parts))


def _rays(
    measurement: Measurement, observation: Observation, open_faces: tuple[str, ...], edge: int, patch: int
) -> tuple[Rays, Tensor, Tensor | None]:
    """The rays that cross none of the open faces, the values of them or their patches, and sigma."""
    if patch > 1:
        return patches(measurement, observation, patch, open_faces)
    binned = edge > 1 and not observation.technique.derived
    bins = binned_rays(measurement, observation, edge, open_faces) if binned else None
    rays, values, sigma = bins or measurement.rays(observation)
    keep = ~rays.exit_faces(measurement.box, open_faces)
    if not bool(keep.any()):
        raise InputError("every ray crosses one of them, so none is left; name fewer faces", field="open_faces")
    if bool(keep.all()):
        return rays, values, sigma
    return rays[keep], values[keep], None if sigma is None else sigma[keep]


def _outlier(part: TechniqueData) -> float:
    """Residual in sigma beyond which the loss is linear."""
    return math.inf if part.images is None else part.images.outlier


def _noise_share(parts: list[TechniqueData], chi_square: float) -> float:
    """Mean square residual of the noise over that of the ambient field, both by Huber's loss.

    Of a standard normal variable the mean of min(z^2, c |z|) is erf(c / sqrt 2).
    """
    if all(math.isinf(part.outlier) for part in parts):
        return 1 / chi_square
    numbers = sum(part.measured.numel() for part in parts)
    noise = sum(math.erf(_outlier(part) / math.sqrt(2)) * part.measured.numel() for part in parts)
    empty = sum(float(p.ambient_residual.square().sum()) for part in parts for p in part.split())
    return noise / chi_square / (empty or numbers)
