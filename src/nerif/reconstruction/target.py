"""What a reconstruction is to meet: the usable rays of a measurement, their displacements and how far to trust them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.geometry import Rays
from nerif.measurement import Measurement
from nerif.reconstruction.bins import binned_rays

__all__ = ["Target"]


@dataclass(frozen=True)
class Target:
    """Rays and what they measured.

    Parameters
    ----------
    rays : Rays
    displacement : (n, 2) px
    inverse_scale : (n, 2) 1/px; residuals are multiplied by it: 1/sigma, scaled so that a zero field has mean square 1
    index_scale : the index excess that makes displacements of the size measured
    chi_square_scale : mean square of displacement/sigma, which turns the mean square of a scaled residual into that in
        units of the noise; None where sigma is not known
    """

    rays: Rays
    displacement: Float[Tensor, "n 2"]
    inverse_scale: Float[Tensor, "n 2"]
    index_scale: float = 1.0
    chi_square_scale: float | None = None

    @classmethod
    def of(cls, measurement: Measurement, open_faces: tuple[str, ...] = (), edge: int = 1) -> Target:
        """Collect the usable rays that cross none of the open faces, or those of bins of edge x edge pixels.

        Raises
        ------
        InputError
            If no ray is left.
        """
        binned = edge > 1
        rays, displacement, sigma = binned_rays(measurement, edge, open_faces) if binned else measurement.rays()
        keep = ~rays.exit_faces(measurement.box, open_faces)
        if not bool(keep.any()):
            raise InputError("open_faces: every ray crosses one of them, so none is left; name fewer faces")
        if not bool(keep.all()):
            rays, displacement, sigma = rays[keep], displacement[keep], None if sigma is None else sigma[keep]
        rms = float(displacement.square().mean().sqrt())
        if rms == 0:
            rms = 1.0  # no displacement at all: the answer is the ambient index, in whatever scale
        lever = rays.ends.distance - 0.5 * (rays.near + rays.far)
        pixels_per_radian = lever * rays.ends.sensitivity.norm(dim=(1, 2)) / math.sqrt(2)
        index_scale = float((displacement / pixels_per_radian[:, None]).square().mean().sqrt()) or 1e-6
        if sigma is None:
            return cls(rays, displacement, torch.full_like(displacement, 1 / rms), index_scale)
        inverse = 1 / sigma
        chi_square = float((displacement * inverse).square().mean()) or 1.0
        known = None if measurement.sigma is None else chi_square
        return cls(rays, displacement, inverse / math.sqrt(chi_square), index_scale, known)

    def __len__(self) -> int:
        return len(self.rays)

    def __getitem__(self, index: Tensor | slice) -> Target:
        return replace(
            self,
            rays=self.rays[index],
            displacement=self.displacement[index],
            inverse_scale=self.inverse_scale[index],
        )

    def to(self, device: torch.device | str) -> Target:
        """Return the same on another device."""
        return replace(
            self,
            rays=self.rays.to(device),
            displacement=self.displacement.to(device),
            inverse_scale=self.inverse_scale.to(device),
        )
