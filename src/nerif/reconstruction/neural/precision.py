"""A network evaluated in mixed precision, compiled where that pays, and by layers of one function where that can be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.network import Network
from nerif.reconstruction.device import autocast_dtype, float32_products

__all__ = ["MixedPrecision"]

Both = Callable[[Tensor, bool], tuple[Tensor, Tensor, Tensor | None]]
"""Network.value_and_gradient"""


class MixedPrecision:
    """The network in bf16 while `low` is set and the settings allow it; an Evaluator, see losses.py.

    Parameters
    ----------
    precision : auto, float32, tf32 or bf16
    compile : on, off, or auto: on CUDA by PyTorch, on a CPU in float32 by Numba (fused.py)
    """

    def __init__(self, network: Network, device: torch.device, precision: str, compile: str) -> None:
        self.network, self.device, self.low = network, device, True
        self.dtype = autocast_dtype(precision, device)
        tf32 = device.type == "cuda" and precision != "float32"
        self.products: Literal["highest", "high"] = "high" if tf32 else "highest"
        self.remark = ""
        """Why it is not compiled, where it should be."""
        self.both: Both = network.value_and_gradient
        if compile == "on" or (compile == "auto" and device.type == "cuda"):
            self.both = self._compiled(network.value_and_gradient)
        self.by_layers: Callable[[Network, Tensor], tuple[Tensor, Tensor]] | None = None
        if compile == "auto" and device.type == "cpu" and _is_plain(network):
            from nerif.reconstruction.neural.fused import value_and_gradient

            self.by_layers = value_and_gradient

    def value(self, p: Float[Tensor, "n k"]) -> Float[Tensor, " n"]:
        """Return the n head."""
        with self._precision():
            return self.network(p)

    def value_and_gradient(
        self, p: Float[Tensor, "n k"], heads: bool
    ) -> tuple[Tensor, Float[Tensor, "n 3"], Float[Tensor, "n 3"] | None]:
        """Return the n head, its exact gradient, and what the gradient heads say (None unless asked)."""
        if self.by_layers is not None and torch.is_grad_enabled() and not self._is_low:
            return *self.by_layers(self.network, p), None
        with self._precision():
            return self.both(p, heads)

    def backward(self, loss: Tensor) -> None:
        """Differentiate a loss, with the products of matrices as the network has them."""
        with float32_products(self.products):
            loss.backward()

    def _compiled(self, plain: Both) -> Both:
        """A function compiled where it is called; where that fails, as without a C compiler, the plain one for good."""
        quick = torch.compile(plain, dynamic=True)

        def call(p: Tensor, heads: bool) -> tuple[Tensor, Tensor, Tensor | None]:
            try:
                return quick(p, heads)
            except torch.OutOfMemoryError:
                raise
            except Exception as error:  # whatever the compiler raises; what is wrong with the call, the plain one says
                found = plain(p, heads)
                reason = (str(error).strip() or type(error).__name__).splitlines()[0]
                self.both, self.remark = plain, f"; the network was not compiled ({reason}): slower, else the same"
                return found

        return call

    @contextmanager
    def _precision(self) -> Iterator[None]:
        low = torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self._is_low)
        with float32_products(self.products), low:
            yield

    @property
    def _is_low(self) -> bool:
        return self.low and self.dtype is not None


def _is_plain(network: Network) -> bool:
    """Whether it is of layers alone, in the precision and with the activation that fused.py has."""
    shape, dtype = network.shape, network.outputs[0].weight.dtype
    alone = network.layered and not (shape.skip or shape.head_width or shape.gradient_head)
    return alone and shape.activation == "silu" and dtype == torch.float32
