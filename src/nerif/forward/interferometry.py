"""Interferometry: the phase, in fringes, by which light through the flow lags behind light through the ambient.

y = (1 / wavelength) integral (n - n_ambient) ds
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.forward.base import ForwardModel, Light
from nerif.forward.line_integral import LineIntegral

__all__ = ["Interferometry"]

MM_PER_NM = 1e-6
WITHIN = (0.8, 1.01)  # fringes from the least to the largest of a wrapped phase
JUMP, LARGEST_JUMP, NOISE = 0.6, 0.8, 5.0  # fringes between neighbours; where there is noise, so many of its deviations
ENOUGH = 100_000  # pixels to tell the noise from
TOLERATED = 0.1  # jumps, times the shorter side of the image: fewer than the outline of a small spot


@dataclass(frozen=True)
class Interferometry(LineIntegral):
    """Unwrapped phase in fringes; where rays pass the ambient alone it is 0, which fixes the index.

    Parameters
    ----------
    wavelength_nm : of the light in vacuum, nm
    """

    name = "interferometry"
    tomography = "interferometric tomography"
    measured, sigma = "fringes", "fringes_sigma"
    quantity = "index_excess"
    misscaled = "another wavelength, or a double pass"

    wavelength_nm: float = 532.0

    @classmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        if light.wavelength_nm is None:
            raise InputError("expected the wavelength of the interferometer in nm, got none", field="wavelength_nm")
        return cls(light.wavelength_nm)

    @property
    def weight(self) -> float:
        return 1 / (self.wavelength_nm * MM_PER_NM)

    @classmethod
    def check(
        cls,
        values: Float[Tensor, "row column c"],
        sigma: Float[Tensor, "row column c"] | None,
        usable: Bool[Tensor, "row column"],
    ) -> None:
        values = torch.where(usable[..., None], values, torch.nan)
        for fringe, unit, remedy in (
            (1.0, "fringes", "skimage.restoration.unwrap_phase(2 pi fringes) / 2 pi"),
            (2 * math.pi, "radians", "skimage.restoration.unwrap_phase(radians) / 2 pi"),
        ):
            if _wrapped(values / fringe):
                raise InputError(
                    f"expected an unwrapped phase in fringes, got one in {unit} that jumps by a whole fringe "
                    f"between neighbours and stays within one; unwrap it ({remedy})",
                    field="fringes",
                )


def _wrapped(values: Float[Tensor, "row column c"]) -> bool:
    """Whether a phase in fringes, NaN where it is not known, stays within one and jumps by nearly one along lines."""
    known = values[values.isfinite()]
    if not len(known) or not WITHIN[0] < float(known.max() - known.min()) < WITHIN[1]:
        return False
    tolerated = 1 + TOLERATED * min(values.shape[:2])
    jumps = torch.cat([(d := values.diff(dim=dim).abs())[d > JUMP] for dim in (0, 1)])
    if len(jumps) <= tolerated:
        return False
    bends = torch.cat([(d := values.diff(n=2, dim=dim).abs())[d.isfinite()] for dim in (0, 1)])
    bends = bends[:: 1 + len(bends) // ENOUGH]  # where the phase is smooth they are noise alone
    noise = 1.4826 / math.sqrt(3) * float(bends.median()) if len(bends) else 0.0  # of a step
    return int((jumps > min(NOISE * noise, LARGEST_JUMP)).sum()) > tolerated
