"""The equations of a gas with large differences of temperature at low Mach number, of a known density.

    du/dt + u . grad u = -(1 - theta)^-1 (grad p + theta g) + nu(T) lap u,      div u = kappa lap T^1.7 / 1.7

T = 1 / (1 - theta), temperature over that of the ambient gas, of the same composition. Conductivity and viscosity grow
as T^0.7, so that nu = nu_0 T^1.7; the gradient of the viscosity is neglected. No heat is released. The velocity is a
gradient that expands, kappa grad T^1.7 / 1.7, and a part without divergence. For small theta these are the equations
of Boussinesq. The pressure of the variable density is found by a few steps of a fixed-point iteration from that of
the instant before.

Source: Rehm & Baum, J. Res. Natl. Bur. Stand. 83 (1978) 297; Dodd & Ferrante, J. Comput. Phys. 273 (2014) 416.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.flow.boussinesq import Boussinesq, Spectrum
from nerif.geometry import Grid

__all__ = ["LARGEST", "LowMach"]

LARGEST = 0.9  # theta: ten times the ambient temperature
HEAT = 1.7  # power of the temperature of viscosity and diffusivity
FIRST, LATER = 1e-3, 0.05  # error of the pressure relative to that of its estimate: of none, and of the instant before


class LowMach(Boussinesq):
    """The equations on a periodic box; viscosity and diffusivity are those of the ambient gas."""

    def rate(self, theta: Float[Tensor, "t z y x"], grid: Grid) -> Float[Tensor, "t z y x"]:
        """Return the change of theta along the path of the fluid, 1/s: (1 - theta) div u."""
        heat = self.diffusivity / HEAT * self._temperature(theta) ** HEAT
        return self.box.laplacian(heat, grid) / self._temperature(theta)

    def _temperature(self, theta: Tensor) -> Tensor:
        return 1 / (1 - theta.clamp(max=LARGEST))

    def _buoyancy(self, theta: Tensor) -> Tensor:
        return theta * self._temperature(theta)

    def _expansion(self, theta: Float[Tensor, "z y x"]) -> Spectrum:
        heat = self.diffusivity / HEAT * self._temperature(theta) ** HEAT
        return 1j * self.box.wave * self.box.spectrum(heat)

    def _pressed(self, velocity: Spectrum, theta: Float[Tensor, "z y x"], rate: Float[Tensor, "z y x"]) -> Spectrum:
        temperature = self._temperature(theta)
        expansion = self.box.spectrum(self.diffusivity * temperature ** (HEAT + 1) * rate)  # its rate
        friction = self.viscosity * temperature**HEAT * self.box.values(self.box.filtered(velocity, torch.neg))
        force = self._force(velocity, theta) + friction  # nu(T) lap u
        wanted = self._potential_part(self.box.spectrum(force)) - 1j * self.box.wave * expansion
        return self._of_variable_density(wanted, temperature, torch.zeros(force.shape), FIRST)

    def _gradient(self, pressed: Spectrum, theta: Float[Tensor, "z y x"]) -> Spectrum:
        return self.box.spectrum(self.box.values(pressed) / self._temperature(theta))

    def _projected(
        self, pushed: Spectrum, before: Float[Tensor, "z y x"], now: Float[Tensor, "z y x"], seconds: float,
        pressed: Spectrum,
    ) -> tuple[Spectrum, Spectrum]:  # fmt: skip
        temperature, expansion = self._temperature(now), self._expansion(now)
        wanted = (self._potential_part(pushed) - expansion) / (0.5 * seconds)
        gradient = self.box.values(pressed) / self._temperature(before)
        pressed = self._of_variable_density(wanted, temperature, gradient, LATER)
        return self.box.solenoidal(pushed - 0.5 * seconds * pressed) + expansion, pressed

    def _diffused(self, velocity: Spectrum, now: Float[Tensor, "z y x"], seconds: float) -> Spectrum:
        """Velocity after viscosity, between those of the smallest and the largest one."""
        box, relative = self.box, self._temperature(now) ** HEAT
        amount, lowest, highest = self.viscosity * seconds, float(relative.min()), float(relative.max())
        least = box.filtered(velocity, lambda k2: torch.exp(-amount * lowest * k2))
        if not highest > lowest:
            return least
        more = box.values(box.filtered(velocity, lambda k2: torch.exp(-amount * highest * k2)) - least)
        return least + box.spectrum((relative - lowest) / (highest - lowest) * more)

    def _potential_part(self, vectors: Spectrum) -> Spectrum:
        return vectors - self.box.solenoidal(vectors)

    def _of_variable_density(
        self, wanted: Spectrum, temperature: Tensor, gradient: Float[Tensor, "3 z y x"], tolerance: float
    ) -> Spectrum:
        """T grad p whose potential part is given, from an estimate of grad p whose error is reduced by `tolerance`."""
        box, lowest, highest = self.box, float(temperature.min()), float(temperature.max())
        mean = 0.5 * (highest + lowest)
        rate = (highest - lowest) / (highest + lowest)  # of an iteration
        for _ in range(max(1, math.ceil(math.log(tolerance) / math.log(max(rate, tolerance))))):
            rest = self._potential_part(box.spectrum((temperature - mean) * gradient))
            gradient = box.values(wanted - rest) / mean
        return box.spectrum(temperature * gradient)
