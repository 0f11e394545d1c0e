"""A Gaussian prior of fine detail with a standard deviation that varies in space, and its posterior.

    x = a h,   h = F^-1 S^(1/2) F z,   S ~ (k^2 + 1 / L^2)^(-11/6)

z is white noise, h homogeneous of variance 1 with the spectrum of von Karman, whose outer scale is L, and a its local
standard deviation. With n values of noise v (mean square) the posterior mean is

    min_z  |F x - b|^2 / v + |z|^2

and the minimum of |F x - e|^2 / v + |z - z0|^2, with noise e and z0 drawn from the prior, is a draw of its error.

Sources: von Karman, PNAS 34 (1948) 530; perturb and solve: Papandreou & Yuille, NIPS (2010), Bardsley et al., SIAM J.
Sci. Comput. 36 (2014) A1895.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.geometry import Grid
from nerif.reconstruction.voxels.voxel_problem import Iterate, Penalty, Problem, conjugate_gradients

__all__ = ["Prior", "WhiteProblem", "von_karman"]

MIN_EXCESS = 0.05  # of the noise: the least that detail is expected to explain
SAMPLES = 3  # of the prior, for its mean square in the data
POWER = -11 / 6  # of k^2: a spectrum of the inertial range, E(k) ~ k^(-5/3), in three dimensions


def von_karman(grid: Grid, outer_mm: float) -> Float[Tensor, "z y k"]:
    """Return the spectrum S of a homogeneous field of variance 1 on a grid, with an outer scale in mm."""
    waves = [torch.fft.fftfreq(n, d, dtype=torch.float64) for n, d in zip(grid.shape, grid.spacing[::-1], strict=True)]
    waves[2] = waves[2][: grid.shape[2] // 2 + 1].abs()
    z, y, x = ((2 * math.pi * wave).square() for wave in waves)
    spectrum = (z[:, None, None] + y[:, None] + x + outer_mm**-2) ** POWER
    covariance = torch.fft.irfftn(spectrum.to(torch.complex128), s=grid.shape)
    return spectrum / covariance[0, 0, 0]


@dataclass(frozen=True)
class Prior:
    """A Gaussian field of mean 0: its local standard deviation a and its spectrum S."""

    deviation: Float[Tensor, "z y x"]
    spectrum: Float[Tensor, "z y k"]

    @cached_property
    def root(self) -> Float[Tensor, "z y k"]:
        return self.spectrum.sqrt()

    def __call__(self, z: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return the field of white noise."""
        return self.deviation * torch.fft.irfftn(torch.fft.rfftn(z) * self.root, s=z.shape)

    def adjoint(self, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Apply the adjoint."""
        return torch.fft.irfftn(torch.fft.rfftn(self.deviation * x) * self.root, s=x.shape)

    def times(self, factor: float) -> Prior:
        """Return the prior of the field times a factor."""
        return Prior(factor * self.deviation, self.spectrum)


class WhiteProblem(Problem):
    """A least-squares problem in the white noise z of a prior, with the data that a mean field leaves.

    Parameters
    ----------
    problem : of the field
    prior : of what the mean leaves
    mean : scaled coefficients
    ratio : of the errors of the data to their noise
    """

    def __init__(self, problem: Problem, prior: Prior, mean: Float[Tensor, "z y x"], ratio: float = 1.0) -> None:
        super().__init__(problem.operators, problem.target)
        self.problem, self.prior, self.mean, self.ratio = problem, prior, mean, ratio
        self.data = problem.data - problem.forward(mean)

    def forward(self, x: Float[Tensor, "z y x"]) -> Float[Tensor, " n"]:
        return self.problem.forward(self.prior(x))

    def adjoint(self, y: Float[Tensor, " n"]) -> Float[Tensor, "z y x"]:
        return self.prior.adjoint(self.problem.adjoint(y))

    @cached_property
    def response(self) -> Float[Tensor, "z y k"]:
        return float(self.prior.deviation.square().mean()) * self.prior.spectrum * self.problem.response

    @property
    def variance(self) -> float:
        """The mean square error v of a number of the data."""
        assert self.target.noise is not None
        return self.ratio**2 * self.target.noise / self.target.numbers

    def fits(self) -> WhiteProblem:
        """Return the problem with the size of the prior that explains what the data have above their noise."""
        generator = torch.Generator().manual_seed(0)
        samples = [float(self.forward(self._white(generator)).square().sum()) for _ in range(SAMPLES)]
        predicted = sum(samples) / SAMPLES
        noise = self.variance * self.target.numbers
        excess = max(float(self.data.square().sum()) - noise, MIN_EXCESS * noise)
        factor = math.sqrt(excess / predicted) if predicted > 0 else 1.0
        return WhiteProblem(self.problem, self.prior.times(factor), self.mean, self.ratio)

    def with_errors(self, ratio: float) -> WhiteProblem:
        """Return the problem of data whose errors have that ratio to their noise."""
        return WhiteProblem(self.problem, self.prior, self.mean, ratio)

    def solve(self) -> Iterator[Iterate]:
        """Yield iterates z towards the posterior mean, without end."""
        yield from conjugate_gradients(self, Penalty(self, "identity"), self.variance * self.voxels, self.zero())

    def draw(self, z: Float[Tensor, "z y x"], generator: torch.Generator) -> Iterator[Float[Tensor, "z y x"]]:
        """Yield approximations x of a draw from the posterior, whose mean is at z, without end."""
        start = self._white(generator)
        noise = torch.randn(self.data.shape, generator=generator).to(self.data) * math.sqrt(self.variance)
        moved = self.with_errors(self.ratio)
        moved.data = noise - self.forward(start)
        moved.__dict__["response"] = self.response
        for iterate in moved.solve():
            yield self.field(z + start + iterate.x)

    def field(self, z: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return mean + a h within the bounds of the problem."""
        return self.problem.clip(self.mean + self.prior(z))

    def objective(self, iterate: Iterate) -> float:
        """Return (|F x - b|^2 / v + |z|^2) / n."""
        return iterate.objective(self.variance * self.voxels) / (self.variance * self.target.numbers)

    def _white(self, generator: torch.Generator) -> Float[Tensor, "z y x"]:
        return torch.randn(self.operator.domain_shape, generator=generator).to(self.zero())
