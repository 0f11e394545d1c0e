"""Interferometry: the phase, in fringes, of light through the flow relative to light through the ambient.

y = (1 / wavelength) integral (n - n_ambient) ds
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from nerif.common.conventions import InputError
from nerif.forward.forward_model import ForwardModel, Light, Map, Mask
from nerif.forward.line_integral import GAUSSIAN, LineIntegral

__all__ = ["Interferometry"]

MM_PER_NM = 1e-6
WRAPPED_RANGE = (0.8, 1.01)  # fringes between the lowest and the highest value of a wrapped phase
MIN_JUMP, CERTAIN_JUMP = 0.6, 0.8  # fringes between neighbours; more than the second is a jump whatever the noise
JUMP_NOISE = 5.0  # standard deviations of the noise of a difference, beyond which it is a jump
NOISE_PIXELS = 100_000  # for the estimate of the noise
MAX_JUMPS = 0.1  # times the shorter side of the image: fewer than around a small spot


@dataclass(frozen=True)
class Interferometry(LineIntegral):
    """Unwrapped phase in fringes; it is 0 on rays through the ambient alone, which fixes the index."""

    name = "interferometry"
    tomography = "interferometric tomography"
    measured, sigma = "fringes", "fringes_sigma"
    quantity = "index_excess"
    misscaled = "another wavelength, or a double pass"

    wavelength_nm: float = 532.0  # in vacuum

    @classmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        if light.wavelength_nm is None:
            raise InputError("expected the wavelength of the interferometer in nm, got none", field="wavelength_nm")
        return cls(light.wavelength_nm)

    @property
    def weight(self) -> float:
        return 1 / (self.wavelength_nm * MM_PER_NM)

    @classmethod
    def check(cls, values: Map, sigma: Map | None, usable: Mask) -> None:
        values = torch.where(usable[..., None], values, torch.nan)
        for fringe, unit in ((1.0, "fringes"), (2 * math.pi, "radians")):
            if _wrapped(values / fringe):
                phase = "2 pi fringes" if unit == "fringes" else unit
                raise InputError(
                    f"expected an unwrapped phase in fringes, got one in {unit} that jumps by a whole fringe between "
                    f"neighbours; unwrap it (skimage.restoration.unwrap_phase({phase}) / 2 pi)",
                    field="fringes",
                )


def _wrapped(values: Map) -> bool:
    """Whether a phase in fringes, NaN where not usable, spans about one fringe and jumps by nearly one along lines."""
    finite = values[values.isfinite()]
    if not len(finite) or not WRAPPED_RANGE[0] < float(finite.max() - finite.min()) < WRAPPED_RANGE[1]:
        return False
    most = 1 + MAX_JUMPS * min(values.shape[:2])
    jumps = torch.cat([(d := values.diff(dim=dim).abs())[d > MIN_JUMP] for dim in (0, 1)])
    if len(jumps) <= most:
        return False
    bends = torch.cat([(d := values.diff(n=2, dim=dim).abs())[d.isfinite()] for dim in (0, 1)])
    bends = bends[:: 1 + len(bends) // NOISE_PIXELS]  # noise alone where the phase is smooth
    noise = GAUSSIAN / math.sqrt(3) * float(bends.median()) if len(bends) else 0.0  # of a difference
    return int((jumps > min(JUMP_NOISE * noise, CERTAIN_JUMP)).sum()) > most
