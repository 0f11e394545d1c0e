"""A network evaluated in mixed precision, and compiled where that pays."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.mlp import Network
from nerif.reconstruction.device import autocast_dtype

__all__ = ["MixedPrecision"]


class MixedPrecision:
    """The network in bf16 while `low` is set and the settings allow it; an Evaluator, see losses.py.

    Parameters
    ----------
    precision : auto, float32, tf32 or bf16
    compile : on, off, or auto (on CUDA only)
    """

    def __init__(self, network: Network, device: torch.device, precision: str, compile: str) -> None:
        self.network, self.device, self.low = network, device, True
        self.dtype = autocast_dtype(precision, device)
        self.both = network.value_and_gradient
        if compile == "on" or (compile == "auto" and device.type == "cuda"):
            self.both = torch.compile(network.value_and_gradient, dynamic=True)

    def value(self, p: Float[Tensor, "n k"]) -> Float[Tensor, " n"]:
        """Return the n head."""
        with self._precision():
            return self.network(p)

    def value_and_gradient(
        self, p: Float[Tensor, "n k"], heads: bool
    ) -> tuple[Tensor, Float[Tensor, "n 3"], Float[Tensor, "n 3"] | None]:
        """Return the n head, its exact gradient, and what the gradient heads say (None unless asked)."""
        with self._precision():
            return self.both(p, heads)

    def _precision(self) -> torch.autocast:
        bf16 = self.low and self.dtype is not None
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=bf16)
