"""Muon: steps along the orthogonal matrix nearest to the momentum of the gradient.

    B <- mu B + (1 - mu) G,      U S V^T = mu B + (1 - mu) G,      W <- W - rate U V^T

U V^T comes from five steps of a Newton-Schulz iteration of fifth order, which leave its singular values in 0.7 to 1.2.
On a CPU they are in float32: without AVX512-BF16, products in bf16 take 14 to 40 times as long.

Source: Jordan et al., Muon (2024), kellerjordan.github.io/posts/muon.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["Muon"]

NEWTON_SCHULZ = 5
A, B, C = 3.4445, -4.7750, 2.0315  # of the polynomial a s + b s^3 + c s^5 of the singular values


class Muon(torch.optim.Optimizer):
    """Muon for weight matrices.

    Parameters
    ----------
    groups : of parameters, as torch's optimisers take them
    momentum : mu
    """

    def __init__(self, groups: list[dict[str, Any]], momentum: float) -> None:
        super().__init__(groups, {"lr": 1.0, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Step all matrices that have a gradient."""
        for group in self.param_groups:
            for matrix in group["params"]:
                if matrix.grad is None:
                    continue
                state = self.state[matrix]
                kept = state.setdefault("momentum_buffer", torch.zeros_like(matrix))
                kept.lerp_(matrix.grad, 1 - group["momentum"])
                direction = orthogonal(matrix.grad.lerp(kept, group["momentum"]))
                matrix.add_(direction.to(matrix), alpha=-group["lr"])


def orthogonal(matrix: Float[Tensor, "m n"]) -> Float[Tensor, "m n"]:
    """Return nearly U V^T, where U S V^T is the matrix."""
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    x = wide.bfloat16() if matrix.is_cuda else wide.float()
    x = x / x.norm().clamp_min(1e-7)
    for _ in range(NEWTON_SCHULZ):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=B, alpha=C), x, beta=A)
    return x if wide is matrix else x.T
