"""The Gauss-Newton step of parameters t with Gaussian priors, in units of their standard deviations.

    min  |r - J dt|^2 + |t + dt|^2,      (N + 1) dt = J^T r - t,      covariance of t = (N + 1)^-1

r and J are the residual and its derivatives over the noise. N = J^T J is the information of the data or, for a field
that adapts to the parameters, N = J^T (J - F (F^T F + P)^-1 F^T J): the field explains J as far as it can, and only the
rest determines t. F is the projector, P the penalty of the field.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["AdaptingField", "Information"]


class Information:
    """The information N = D diag(n) D^T of the data; its lower triangle is used."""

    def __init__(self, matrix: Float[Tensor, "*batch k k"]) -> None:
        values, self.directions = torch.linalg.eigh(matrix)
        self.values = values.clamp(min=0)

    def step(
        self, pull: Float[Tensor, "*batch k"], at: Float[Tensor, "*batch k"], weight: Tensor | float = 1.0
    ) -> Float[Tensor, "*batch k"]:
        """Return dt = D (1 + w n)^-1 D^T (w J^T r - t).

        Parameters
        ----------
        pull, at : J^T r and t
        weight : (*batch, k) w of the data along each of the directions D
        """
        pull, at = (torch.einsum("...ij,...i->...j", self.directions, x) for x in (pull, at))
        return torch.einsum("...ij,...j->...i", self.directions, (weight * pull - at) / (1 + weight * self.values))

    @property
    def covariance(self) -> Float[Tensor, "*batch k k"]:
        """(N + 1)^-1."""
        return (self.directions / (1 + self.values)[..., None, :]) @ self.directions.mT


class AdaptingField:
    """The coefficients c = (F^T F + P)^-1 F^T y that explain data y, and the rest y - F c.

    Parameters
    ----------
    projector, penalty : F and P
    ridge : added to the diagonal, of its mean, for coefficients that no ray crosses
    """

    def __init__(self, projector: Float[Tensor, "n m"], penalty: Float[Tensor, "m m"], ridge: float) -> None:
        normal = projector.T @ projector + penalty
        normal.diagonal().add_(ridge * float(normal.diagonal().mean()))
        self.projector, self.factor = projector, torch.linalg.cholesky(normal)

    def fit(self, data: Float[Tensor, "n k"]) -> Float[Tensor, "m k"]:
        """Return c of each column."""
        return torch.cholesky_solve(self.projector.T @ data, self.factor)

    def rest(self, data: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """Return y - F c of each column."""
        return data - self.projector @ self.fit(data)
