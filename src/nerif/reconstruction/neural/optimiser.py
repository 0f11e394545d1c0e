"""The optimiser of a network: Muon for the weight matrices and Adam for the rest, or Adam for all.

Muon steps along the orthogonal matrix U V^T nearest to the momentum U S V^T, so that all directions of a layer move
equally, however small their gradients (docs/decisions/003).

    Muon   B <- mu B + (1 - mu) G,      U S V^T = mu B + (1 - mu) G,      W <- W - rate U V^T
    Adam   m <- b1 m + (1 - b1) g,      v <- b2 v + (1 - b2) g^2,
           w <- w - rate m / (1 - b1^t) / (sqrt(v / (1 - b2^t)) + 1e-8)

U V^T comes from five Newton-Schulz iterations of fifth order, which leave its singular values in 0.7 to 1.2; on a CPU
in float32, since bf16 products take 14 to 40 times as long without AVX512-BF16. PyTorch's optimiser classes import its
compiler when they are made, its arithmetic does not (docs/decisions/017).

Rates are those of the reference, a network of 4 x 128 and five octaves along the axes. In another shape each weight has
a share of them, such that a step changes the output of a layer as much as in the reference (maximal-update
parametrisation):

    Muon   |dW|_2 ~ sqrt(fan_out / fan_in)
    Adam   |dW_ij| ~ 1 / fan_in,      biases and first layer ~ 1

Source: Jordan et al., Muon (2024), kellerjordan.github.io/posts/muon; Kingma & Ba, Adam, ICLR (2015); Yang et al.,
Tensor Programs V, arXiv:2203.03466 (2022), for Adam; Yang, Simon & Bernstein, A spectral condition for feature
learning, arXiv:2310.17813 (2023), for Muon.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim.adam import adam

from nerif.common.conventions import InputError
from nerif.fields.network import Network
from nerif.fields.network_shape import NetworkShape, encoded_width
from nerif.reconstruction.device import FAST

__all__ = ["OPTIMISERS", "NetworkOptimiser", "Optimiser", "adam_step"]

OPTIMISERS = ("muon", "adam")
REFERENCE = NetworkShape(width=128, directions=3)
SPECTRAL = 0.2 * math.sqrt(REFERENCE.width)  # of a square matrix of the reference: the root mean square of Adam's step
ITERATIONS = 5
A, B, C = 3.4445, -4.7750, 2.0315  # of the polynomial a s + b s^3 + c s^5 of the singular values


class Optimiser:
    """Updates weights by a rule, with a memory for each.

    Parameters
    ----------
    shares : of the rate, one for each weight
    rule : updates a weight and its memory, empty at first, in place; called with weight, gradient, memory and rate
    """

    def __init__(self, weights: Iterable[Tensor], shares: Iterable[float], rule: Callable[..., None]) -> None:
        self.weights, self.shares, self.rule = list(weights), list(shares), rule
        self.memory: list[dict[str, Tensor]] = [{} for _ in self.weights]

    def zero_grad(self) -> None:
        """Discard the gradients."""
        for weight in self.weights:
            weight.grad = None

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Update all weights that have a gradient."""
        for weight, share, memory in zip(self.weights, self.shares, self.memory, strict=True):
            if weight.grad is not None:
                self.rule(weight, weight.grad, memory, rate * share)


def muon_step(weight: Tensor, gradient: Tensor, memory: dict[str, Tensor], rate: float, momentum: float) -> None:
    """Update a weight matrix by Muon."""
    if not memory:
        memory["momentum_buffer"] = torch.zeros_like(weight)
    buffer = memory["momentum_buffer"]
    buffer.lerp_(gradient, 1 - momentum)
    weight.add_(orthogonal(gradient.lerp(buffer, momentum)).to(weight), alpha=-rate)


def orthogonal(matrix: Float[Tensor, "m n"]) -> Float[Tensor, "m n"]:
    """Return approximately U V^T of the matrix U S V^T."""
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    x = wide.bfloat16() if matrix.device.type in FAST else wide.float()
    x = x / x.norm().clamp_min(1e-7)
    for _ in range(ITERATIONS):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=B, alpha=C), x, beta=A)
    return x if wide is matrix else x.T


def adam_step(
    weight: Tensor, gradient: Tensor, memory: dict[str, Tensor], rate: float, betas: tuple[float, float]
) -> None:
    """Update a weight by Adam."""
    if not memory:
        memory |= {"step": torch.tensor(0.0), "exp_avg": torch.zeros_like(weight)}
        memory["exp_avg_sq"] = torch.zeros_like(weight)
    adam(
        [weight], [gradient], [memory["exp_avg"]], [memory["exp_avg_sq"]], [], [memory["step"]], amsgrad=False,
        beta1=betas[0], beta2=betas[1], lr=rate, weight_decay=0.0, eps=1e-8, maximize=False,
    )  # fmt: skip


class NetworkOptimiser:
    """Updates the weights of a network by one of OPTIMISERS; with `by_shape` Adam's rates depend on its shape."""

    def __init__(
        self, kind: str, network: Network, betas: tuple[float, float], momentum: float, by_shape: bool = True
    ) -> None:
        matrices: list[Tensor] = []
        others: list[Tensor] = []
        for p in network.parameters():
            (matrices if kind == "muon" and p.ndim == 2 and min(p.shape) > 1 else others).append(p)
        shares = [adam_share(network, p) if by_shape else 1.0 for p in others]
        self.parts: dict[str, Optimiser] = {"adam": Optimiser(others, shares, partial(adam_step, betas=betas))}
        if matrices:
            shares = [muon_share(network, p) for p in matrices]
            self.parts["muon"] = Optimiser(matrices, shares, partial(muon_step, momentum=momentum))

    def zero_grad(self) -> None:
        """Discard the gradients."""
        for part in self.parts.values():
            part.zero_grad()

    def step(self, rates: dict[str, float]) -> None:
        """Step with a learning rate for each part by name."""
        for name, part in self.parts.items():
            part.step(rates[name])

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the memories by part, number of the weight, and entry."""
        return {
            f"{name}.{i}.{key}": value.clone()
            for name, part in self.parts.items()
            for i, memory in enumerate(part.memory)
            for key, value in memory.items()
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Load what `state_dict` returned; that of another optimiser is an error."""
        names = {key.split(".")[0] for key in state}
        if state and names != set(self.parts):  # empty before the first step
            expected, got = (" and ".join(sorted(n)) for n in (self.parts, names))
            raise InputError(
                f"expected a checkpoint of {expected}, got {got}; give the same --optimiser", field="resume"
            )
        for part in self.parts.values():
            for memory in part.memory:
                memory.clear()
        for key, tensor in state.items():
            name, i, entry = key.split(".")
            part = self.parts[name]
            device = tensor.device if entry == "step" else part.weights[int(i)].device  # Adam counts on the CPU
            part.memory[int(i)][entry] = tensor.to(device, copy=True)


def muon_share(network: Network, matrix: Tensor) -> float:
    """Return the spectral norm of a step of Muon, in units of its rate."""
    fan_out, fan_in = matrix.shape
    if matrix is network.layers[0].weight:  # its fan-in depends on the octaves, not on the width
        inputs = [encoded_width(shape.octaves, shape.directions) for shape in (REFERENCE, network.shape)]
        return SPECTRAL * math.sqrt(fan_out / REFERENCE.width * inputs[0] / inputs[1])
    return SPECTRAL * math.sqrt(fan_out / fan_in)


def adam_share(network: Network, weight: Tensor) -> float:
    """Return the rate of a weight, in units of Adam's rate in the reference."""
    if weight.ndim < 2 or weight is network.layers[0].weight:
        return 1.0
    return REFERENCE.width / weight.shape[1]
