"""What a reconstruction is to meet: the usable rays of a measurement, what they measured and how far to trust it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.transfer import sent
from nerif.data.measurement import Measurement, Observation
from nerif.forward.base import ForwardModel
from nerif.forward.registry import AUTO, forward_models
from nerif.geometry import Rays
from nerif.reconstruction.neural.bins import binned_rays, patches

__all__ = ["Part", "Target", "check_target"]

PIECE = 1 << 17  # rays


@dataclass(frozen=True)
class Part:
    """Rays, and what they measured by one technique.

    Parameters
    ----------
    model : ForwardModel
    rays : Rays
    measured : (n, c) as the model reads it
    inverse_scale : (n, c) one over the unit of `measured`; residuals are multiplied by it: 1/sigma, scaled so that the
        ambient field has mean square 1 over all parts of a target
    outlier : scaled residual beyond which a number counts by its size and not by its square
    offset : (n, k) added to what is predicted, or None
    """

    model: ForwardModel
    rays: Rays
    measured: Float[Tensor, "n c"]
    inverse_scale: Float[Tensor, "n c"]
    outlier: float = math.inf
    offset: Float[Tensor, "n k"] | None = None

    def __len__(self) -> int:
        return len(self.rays)

    def __getitem__(self, index: Tensor | slice) -> Part:
        measured, inverse = self.measured[index], self.inverse_scale[index]
        offset = None if self.offset is None else self.offset[index]
        return replace(self, rays=self.rays[index], measured=measured, inverse_scale=inverse, offset=offset)

    def to(self, device: torch.device | str) -> Part:
        """Return the same on another device."""
        measured, inverse = self.measured.to(device), self.inverse_scale.to(device)
        return replace(self, rays=self.rays.to(device), measured=measured, inverse_scale=inverse)

    def residual(self, prediction: Float[Tensor, "n k"]) -> Float[Tensor, "n c"]:
        """Return the scaled difference between a path integral and what was measured.

        One beyond `outlier` is made smaller by a factor that counts as constant, so that the slope of its square is
        that of Huber's loss.
        """
        return self._robust(self._difference(prediction))

    @property
    def of_nothing(self) -> Float[Tensor, "n c"]:
        """The scaled residual of the ambient field."""
        integrals = self.model.integrals or self.measured.shape[1]
        return self._robust(self._difference(self.measured.new_zeros(len(self), integrals)))

    @property
    def of_field(self) -> Float[Tensor, "n c"]:
        """What was measured without what is added to a prediction, for models whose integral is what is measured."""
        return self.measured if self.offset is None else self.measured - self.offset.to(self.measured)

    def split(self) -> list[Part]:
        """Return the part in pieces that need little memory."""
        return [self[i : i + PIECE] for i in range(0, len(self), PIECE)]

    def _robust(self, r: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        if math.isinf(self.outlier):
            return r
        return r * (self.outlier / r.detach().abs().clamp(min=self.outlier)).sqrt()

    def _difference(self, prediction: Float[Tensor, "n k"]) -> Float[Tensor, "n c"]:
        moved = prediction if self.offset is None else prediction + self.offset
        return self.model.residual(moved, self.measured, self.rays) * self.inverse_scale


def check_target(measurement: Measurement, model: str = AUTO, linear: bool = False) -> None:
    """Refuse a model that a technique of the measurement does not have, and several techniques without their noise.

    Raises
    ------
    InputError
        Naming it.
    """
    forward_models(measurement.techniques, measurement, model, linear)
    observations = measurement.observations
    if len(observations) > 1 and any(o.sigma is None for o in observations):
        names, wanted = (" and ".join(getattr(o.technique, a) for o in observations) for a in ("name", "sigma"))
        raise InputError(
            f"{names} together are weighed by their noise: expected {wanted}, got not both", field="technique"
        )


@dataclass(frozen=True)
class Target:
    """What was measured, technique by technique.

    Parameters
    ----------
    parts : one for each technique
    scale : the size of field that makes measurements of the size given
    chi_square : mean square of the ambient field's residual over sigma (over 1, where sigma is not known), which turns
        the mean square of a scaled residual into that in units of the noise
    sigma_known : whether it is
    noise : mean square of the noise's residual over that of the ambient field's; None where sigma is not known
    """

    parts: tuple[Part, ...]
    scale: float
    chi_square: float
    sigma_known: bool
    noise: float | None = None

    @classmethod
    def of(
        cls, measurement: Measurement, open_faces: tuple[str, ...] = (), edge: int = 1, model: str = AUTO,
        linear: bool = False, single: bool = False,
    ) -> Target:  # fmt: skip
        """Collect the usable rays that cross none of the open faces, or those of bins of edge x edge pixels.

        Parameters
        ----------
        model : name of the forward model, or auto
        linear : whether it has to be linear
        single : whether every pixel has a ray of its own, also where a model has patches

        Raises
        ------
        InputError
            If no ray is left, or there is no such model.
        """
        check_target(measurement, model, linear)
        models = forward_models(measurement.techniques, measurement, model, linear)
        parts, scales = [], []
        known = all(o.sigma is not None for o in measurement.observations)
        for forward, observation in zip(models, measurement.observations, strict=True):
            patch = 1 if single else forward.patch
            rays, values, sigma = _rays(measurement, observation, open_faces, edge, patch)
            scales.append(forward.field_scale(rays, values))
            read, noise = forward.reading(values, sigma if observation.sigma is not None else None, rays)
            noise = sigma if observation.sigma is None else noise  # of bins: by how many pixels they have
            inverse = torch.ones_like(read) if noise is None else 1 / noise
            parts.append(Part(forward, rays, read, inverse))
        empty = torch.cat([p.of_nothing.flatten() for part in parts for p in part.split()])
        # nothing measured at all: the answer is the ambient, in whatever scale
        chi_square = float(empty.square().mean()) or 1.0
        unit = 1 / math.sqrt(chi_square)
        parts = [
            replace(p, inverse_scale=p.inverse_scale * unit, outlier=p.model.outlier * unit if known else math.inf)
            for p in parts
        ]
        scale = math.sqrt(sum(s**2 for s in scales) / len(scales)) or 1e-6
        return cls(tuple(parts), scale, chi_square, known, _noise_share(parts, chi_square) if known else None)

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    @property
    def numbers(self) -> int:
        """How many numbers were measured."""
        return sum(part.measured.numel() for part in self.parts)

    def __getitem__(self, index: Tensor) -> Target:
        """Return the rays of those numbers, which are on the CPU, counted through all parts."""
        chosen, first = [], 0
        for part in self.parts:
            own = index[(index >= first) & (index < first + len(part))]
            chosen.append(part[sent(own - first, part.measured.device)])
            first += len(part)
        return replace(self, parts=tuple(chosen))

    def without_outliers(self) -> Target:
        """Return the same by which every number counts by its square."""
        return replace(self, parts=tuple(replace(part, outlier=math.inf) for part in self.parts))

    def to(self, device: torch.device | str) -> Target:
        """Return the same on another device."""
        return replace(self, parts=tuple(part.to(device) for part in self.parts))


def _rays(
    measurement: Measurement, observation: Observation, open_faces: tuple[str, ...], edge: int, patch: int
) -> tuple[Rays, Tensor, Tensor | None]:
    """Rays that cross none of the open faces, what they or their patches measured, and its sigma."""
    if patch > 1:
        return patches(measurement, observation, patch, open_faces)
    if edge > 1 and observation.technique.averaged:
        found: tuple[Rays, Tensor, Tensor | None] = binned_rays(measurement, observation, edge, open_faces)
    else:
        found = measurement.rays(observation)
    rays, values, sigma = found
    keep = ~rays.exit_faces(measurement.box, open_faces)
    if not bool(keep.any()):
        raise InputError("every ray crosses one of them, so none is left; name fewer faces", field="open_faces")
    if bool(keep.all()):
        return rays, values, sigma
    return rays[keep], values[keep], None if sigma is None else sigma[keep]


def _noise_share(parts: list[Part], chi_square: float) -> float:
    """Mean square of the noise's residual over that of the ambient field's, outliers of either by their size."""
    if all(math.isinf(part.outlier) for part in parts):
        return 1 / chi_square
    numbers = sum(part.measured.numel() for part in parts)
    noise = sum(_robust_square(part.model.outlier) * part.measured.numel() for part in parts)
    empty = sum(float(p.of_nothing.square().sum()) for part in parts for p in part.split())
    return noise / chi_square / (empty or numbers)


def _robust_square(outlier: float) -> float:
    """The mean of min(z^2, c |z|) of a standard normal variable: what Huber's loss leaves of noise.

    erf(c / sqrt 2) - 2 c phi(c) + 2 c phi(c) = erf(c / sqrt 2),     phi the normal density
    """
    return 1.0 if math.isinf(outlier) else math.erf(outlier / math.sqrt(2))
