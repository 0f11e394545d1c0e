"""How weights are moved along their gradients: what Adam (adam.py) and Muon (muon.py) have in common.

PyTorch's own optimisers import its compiler when they are made, which takes two seconds; their arithmetic does not.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable

import torch
from torch import Tensor

__all__ = ["Update"]


class Update(ABC):
    """A rule that moves weights, with a memory of each.

    Parameters
    ----------
    weights : to move
    shares : of the rate of a step, one for each
    """

    def __init__(self, weights: Iterable[Tensor], shares: Iterable[float]) -> None:
        self.weights, self.shares = list(weights), list(shares)
        self.memory: list[dict[str, Tensor]] = [{} for _ in self.weights]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for weight in self.weights:
            weight.grad = None

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move all weights that have a gradient."""
        for weight, share, memory in zip(self.weights, self.shares, self.memory, strict=True):
            if weight.grad is not None:
                self.move(weight, weight.grad, memory, rate * share)

    @abstractmethod
    def move(self, weight: Tensor, gradient: Tensor, memory: dict[str, Tensor], rate: float) -> None:
        """Move one weight in place, and remember what the next step asks for; the memory is empty at first."""
