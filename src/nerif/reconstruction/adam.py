"""Adam: steps along the mean of the gradient over the root of its mean square, by PyTorch's arithmetic.

    m <- b1 m + (1 - b1) g,    v <- b2 v + (1 - b2) g^2,    w <- w - rate m / (1 - b1^t) / (sqrt(v / (1 - b2^t)) + 1e-8)

Source: Kingma & Ba, Adam, ICLR (2015).
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.optim.adam import adam

from nerif.reconstruction.update import Update

__all__ = ["Adam"]


class Adam(Update):
    """Adam.

    Parameters
    ----------
    weights, shares : see Update
    betas : decay rates b1 and b2
    """

    def __init__(self, weights: Iterable[Tensor], shares: Iterable[float], betas: tuple[float, float]) -> None:
        super().__init__(weights, shares)
        self.betas = betas

    def move(self, weight: Tensor, gradient: Tensor, memory: dict[str, Tensor], rate: float) -> None:
        if not memory:
            memory |= {"step": torch.tensor(0.0), "exp_avg": torch.zeros_like(weight)}
            memory["exp_avg_sq"] = torch.zeros_like(weight)
        adam(
            [weight], [gradient], [memory["exp_avg"]], [memory["exp_avg_sq"]], [], [memory["step"]], amsgrad=False,
            beta1=self.betas[0], beta2=self.betas[1], lr=rate, weight_decay=0.0, eps=1e-8, maximize=False,
        )  # fmt: skip
