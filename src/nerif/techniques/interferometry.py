"""Interferometry: the phase, in fringes, by which light through the flow lags behind light through the ambient.

    y = (1 / wavelength) integral (n - n_ambient) ds
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.techniques.base import ForwardModel, Light
from nerif.techniques.line_integral import LineIntegral

__all__ = ["Interferometry"]

MM_PER_NM = 1e-6
LEAST_FRINGES, JUMP, TOLERATED = 0.9, 0.6, 2e-3  # a whole fringe between neighbours, and the share of such pairs


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
            raise InputError("wavelength_nm: expected the wavelength of the interferometer in nm, got none")
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
        known = values[usable]
        if not len(known) or not LEAST_FRINGES < float(known.max() - known.min()) < 1.01:
            return
        steps = [d[d.isfinite()] for d in (values.diff(dim=0), values.diff(dim=1))]
        jumps = sum(int((d.abs() > JUMP).sum()) for d in steps)
        if jumps > TOLERATED * sum(len(d) for d in steps):
            raise InputError(
                "fringes: expected an unwrapped phase, got one that jumps by a whole fringe between neighbours and "
                "stays within one; unwrap it (skimage.restoration.unwrap_phase(2 pi fringes) / 2 pi)"
            )
