"""What is assumed of a velocity before the film is analysed: vorticity where the density varies.

    w(x, t) = a(x, t) F^-1 [S(k) F z],      a ~ |grad theta|,      S = (1 + (k L / 2 pi)^2)^-1

z is white. A gradient of density makes vorticity, and both diffuse at about the same rate; where the fluid is uniform,
the flow is that which the vorticity elsewhere induces.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.reconstruction.velocity.periodic_box import PeriodicBox
from nerif.reconstruction.velocity.resampling import smooth

__all__ = ["VorticityPrior"]

FLOOR = 0.003  # of the amplitude where the density is uniform
VERTICAL = 0.4  # of the component along gravity, which buoyancy does not make


class VorticityPrior:
    """Vorticity of given controls z, and the amplitudes of first instant and forcing.

    Parameters
    ----------
    box : with margins, in which the forcing is free: fluid enters from there
    theta : of all instants, on the grid of the box
    amplitude : largest vorticity, 1/s
    forcing : change of vorticity per step that the equations do not explain, relative to `amplitude`
    correlation : wavelength below which the vorticity falls, mm
    gravity : along it the vorticity is smaller; zeros for none
    """

    def __init__(
        self, box: PeriodicBox, theta: Float[Tensor, "t z y x"], amplitude: float, forcing: float,
        correlation: float, gravity: tuple[float, float, float],
    ) -> None:  # fmt: skip
        self.box = box
        response = 1 / (1 + box.wave_square * (correlation / (2 * math.pi)) ** 2)
        twice = torch.full_like(response, 2.0)
        twice[..., 0] = 1  # the spectrum holds half of the waves
        if box.shape[2] % 2 == 0:
            twice[..., -1] = 1
        self.response = response / ((twice * response.square()).sum() / math.prod(box.shape)).sqrt()
        slopes = torch.stack(torch.gradient(theta, spacing=box.spacing, dim=(1, 2, 3))).square().sum(dim=0)
        slope = smooth(slopes, [0.6 for _ in box.spacing]).sqrt()
        relative = box.extended(slope / slope.max().clamp_min(1e-30)).clamp_min(FLOOR)
        down = torch.tensor(gravity)
        direction = down / down.norm().clamp_min(1e-30)
        along = 1 - (1 - VERTICAL) * direction.abs()
        self.amplitude = amplitude * relative[:, None] * along[:, None, None, None]
        margins = box.margins()
        self.forcing = forcing * (1 - margins) + margins

    def vorticity(self, controls: Float[Tensor, "t 3 z y x"]) -> Float[Tensor, "t 3 z y x"]:
        """Return the vorticity at the first instant, then its changes, 1/s."""
        vorticity = self.box.values(self.box.spectrum(controls) * self.response) * self.amplitude
        return torch.cat([vorticity[:1], vorticity[1:] * self.forcing])
