"""The Gaussian prior of a velocity: vorticity where the density varies.

    w(x, t) = a(x, t) F^-1 [S(k) F z],      a ~ |grad theta|,      S = (1 + (k L / 2 pi)^2)^-1

z is white. A gradient of density makes vorticity, and both diffuse at about the same rate; where the fluid is uniform,
the flow is that which the vorticity elsewhere induces. In a flow that moves as a whole, the mean of z is its velocity,
scaled.

A film determines the large waves of the first instant, where the density varies most, far better than the rest. So the
minimum is sought in other variables, y, in which its curvature is more uniform:

    z(x, t) = b(t) (1 + B a^2)^(-1/2) F^-1 [(1 + A (S / k)^2)^(-1/2) F y],      a and S / k relative to their largest
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.flow.frame_resampling import smooth, squared_slope
from nerif.flow.periodic_box import PeriodicBox

__all__ = ["VorticityPrior"]

FLOOR = 0.003  # of the amplitude where the density is uniform
VERTICAL = 0.4  # of the component along gravity, which buoyancy does not make
LONG_WAVES, STEEP, START = 30.0, 10.0, 3.0  # A, B and b of the first instant, by trial on 20^3 voxels (decision 061)


class VorticityPrior:
    """Vorticity of given controls z, and the amplitudes of first instant and forcing.

    Parameters
    ----------
    box : with margins, in which the forcing is free: fluid enters from there
    theta : of all instants, on the grid of the box
    amplitude : largest vorticity, 1/s
    forcing : change of vorticity per step that the equations do not explain, relative to `amplitude`
    common : velocity of a flow that moves as a whole, mm/s; it may change per step by the share `forcing` of itself
    correlation : wavelength below which the vorticity falls, mm
    gravity : along it the vorticity is smaller; zeros for none
    """

    def __init__(
        self, box: PeriodicBox, theta: Float[Tensor, "t z y x"], amplitude: float, forcing: float,
        correlation: float, gravity: tuple[float, float, float], common: Float[Tensor, 3] | None,
    ) -> None:  # fmt: skip
        self.box, self.common = box, common
        self.response = box.low_pass(correlation)
        slope = smooth(squared_slope(theta, box.spacing), [0.6 for _ in box.spacing]).sqrt()
        relative = box.extended(slope / slope.max().clamp_min(1e-30)).clamp_min(FLOOR)
        down = torch.tensor(gravity)
        direction = down / down.norm().clamp_min(1e-30)
        along = 1 - (1 - VERTICAL) * direction.abs()
        self.amplitude = amplitude * relative[:, None] * along[:, None, None, None]
        margins = box.margins()
        speed = 0.0 if common is None else float(common.norm())
        self._means = speed * math.prod(box.shape) ** 0.5 * torch.tensor([1.0] + [forcing] * (len(theta) - 1))[:, None]
        self.forcing = forcing * (1 - margins) + margins
        reach = self.response * box.inverse_square.sqrt()
        self._waves = (1 + LONG_WAVES * (reach / reach.max()) ** 2).rsqrt()
        first = torch.ones(len(theta), 1, 1, 1, 1)
        first[0] = START
        self._places = first * (1 + STEEP * (self.amplitude / self.amplitude.max()) ** 2).rsqrt()

    def vorticity(self, controls: Float[Tensor, "t 3 z y x"]) -> Float[Tensor, "t 3 z y x"]:
        """Return the vorticity at the first instant, then its changes, 1/s."""
        if self._means.any():
            controls = controls - controls.mean(dim=(2, 3, 4), keepdim=True)
        vorticity = self.box.values(self.box.spectrum(controls) * self.response) * self.amplitude
        return torch.cat([vorticity[:1], vorticity[1:] * self.forcing])

    def mean(self, controls: Float[Tensor, "t 3 z y x"]) -> Float[Tensor, "t 3"]:
        """Return the mean velocity at all instants, mm/s."""
        return (self._means * controls.mean(dim=(2, 3, 4))).cumsum(dim=0)

    def start(self) -> Float[Tensor, "t 3 z y x"]:
        """Return the controls of fluid at rest, or that moves as a whole."""
        controls = torch.zeros(len(self._means), 3, *self.box.shape)
        if self.common is not None and self._means.any():
            controls[0] = (self.common / self._means[0])[:, None, None, None]
        return controls

    def controls(self, variables: Float[Tensor, "t 3 z y x"]) -> Float[Tensor, "t 3 z y x"]:
        """Return z of given variables y."""
        return self.box.values(self.box.spectrum(variables) * self._waves) * self._places

    def variables(self, controls: Float[Tensor, "t 3 z y x"]) -> Float[Tensor, "t 3 z y x"]:
        """Return y of given controls z."""
        return self.box.values(self.box.spectrum(controls / self._places) / self._waves)
