"""Muon: steps along the orthogonal matrix nearest to the momentum of the gradient.

    B <- mu B + (1 - mu) G,      U S V^T = mu B + (1 - mu) G,      W <- W - rate U V^T

U V^T comes from five steps of a Newton-Schulz iteration of fifth order, which leave its singular values in 0.7 to 1.2.
On a CPU they are in float32: without AVX512-BF16, products in bf16 take 14 to 40 times as long.

Source: Jordan et al., Muon (2024), kellerjordan.github.io/posts/muon.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.reconstruction.update import Update

__all__ = ["Muon"]

NEWTON_SCHULZ = 5
A, B, C = 3.4445, -4.7750, 2.0315  # of the polynomial a s + b s^3 + c s^5 of the singular values


class Muon(Update):
    """Muon for weight matrices.

    Parameters
    ----------
    weights, shares : see Update
    momentum : mu
    """

    def __init__(self, weights: Iterable[Tensor], shares: Iterable[float], momentum: float) -> None:
        super().__init__(weights, shares)
        self.momentum = momentum

    def move(self, weight: Tensor, gradient: Tensor, memory: dict[str, Tensor], rate: float) -> None:
        if not memory:
            memory["momentum_buffer"] = torch.zeros_like(weight)
        kept = memory["momentum_buffer"]
        kept.lerp_(gradient, 1 - self.momentum)
        weight.add_(orthogonal(gradient.lerp(kept, self.momentum)).to(weight), alpha=-rate)


def orthogonal(matrix: Float[Tensor, "m n"]) -> Float[Tensor, "m n"]:
    """Return nearly U V^T, where U S V^T is the matrix."""
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    x = wide.bfloat16() if matrix.is_cuda else wide.float()
    x = x / x.norm().clamp_min(1e-7)
    for _ in range(NEWTON_SCHULZ):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=B, alpha=C), x, beta=A)
    return x if wide is matrix else x.T
