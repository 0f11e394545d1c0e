"""The optimiser of a network: Muon for the weight matrices and Adam for the rest, or Adam for all.

Muon steps along the matrix U V^T nearest to the momentum U S V^T, so that each direction of a layer moves alike,
however small its gradient. What that is worth: benchmarks/results/choices-cpu.md.

A rate is that of the reference, a network of 4 x 128 and five octaves along the axes. In another shape each weight has
a share of it, such that a step changes what a layer gives as much as in the reference, whatever the width
(maximal-update parametrisation):

    Muon   |dW|_2 ~ sqrt(fan_out / fan_in)
    Adam   |dW_ij| ~ 1 / fan_in,      biases and first layer ~ 1

Source: Kingma & Ba, Adam, ICLR (2015); Yang et al., Tensor Programs V, arXiv:2203.03466 (2022), for Adam; Yang, Simon &
Bernstein, A spectral condition for feature learning, arXiv:2310.17813 (2023), for Muon.
"""

from __future__ import annotations

import math

from torch import Tensor

from nerif.common.conventions import InputError
from nerif.fields.network import Network, NetworkShape, encoded_width
from nerif.reconstruction.adam import Adam
from nerif.reconstruction.muon import Muon
from nerif.reconstruction.update import Update

__all__ = ["OPTIMISERS", "NetworkOptimiser"]

OPTIMISERS = ("muon", "adam")
REFERENCE = NetworkShape(width=128, directions=3)
SPECTRAL = 0.2 * math.sqrt(REFERENCE.width)  # of a square matrix of the reference: the root mean square of Adam's step


class NetworkOptimiser:
    """Steps the weights of a network.

    Parameters
    ----------
    kind : one of OPTIMISERS
    betas : Adam's decay rates
    momentum : Muon's
    by_shape : whether the rates of other shapes than the reference's follow from it; else all weights have Adam's
    """

    def __init__(
        self, kind: str, network: Network, betas: tuple[float, float], momentum: float, by_shape: bool = True
    ) -> None:
        parameters = list(network.parameters())
        matrices = [p for p in parameters if kind == "muon" and p.ndim == 2 and min(p.shape) > 1]
        chosen = {id(p) for p in matrices}
        others = [p for p in parameters if id(p) not in chosen]
        shares = [adam_share(network, p) if by_shape else 1.0 for p in others]
        self.parts: dict[str, Update] = {"adam": Adam(others, shares, betas)}
        if matrices:
            self.parts["muon"] = Muon(matrices, [muon_share(network, p) for p in matrices], momentum)

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for part in self.parts.values():
            part.zero_grad()

    def step(self, rates: dict[str, float]) -> None:
        """Step, with a learning rate for each part by name."""
        for name, part in self.parts.items():
            part.step(rates[name])

    def tensors(self) -> dict[str, Tensor]:
        """Return copies of all that the next step depends on, by name."""
        return {
            f"{name}.{i}.{key}": value.clone()
            for name, part in self.parts.items()
            for i, memory in enumerate(part.memory)
            for key, value in memory.items()
        }

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take back what `tensors` gave; those of another optimiser are an error."""
        found = {key.split(".")[0] for key in tensors}
        if tensors and found != set(self.parts):  # before the first step there is nothing to take back
            asked = " and ".join(sorted(self.parts))
            raise InputError(
                f"resume: expected a checkpoint of {asked}, got one of {' and '.join(sorted(found))}; "
                "give the same --optimiser"
            )
        for part in self.parts.values():
            for memory in part.memory:
                memory.clear()
        for key, tensor in tensors.items():
            name, i, entry = key.split(".")
            part = self.parts[name]
            where = tensor.device if entry == "step" else part.weights[int(i)].device  # Adam counts on the CPU
            part.memory[int(i)][entry] = tensor.to(where, copy=True)


def muon_share(network: Network, matrix: Tensor) -> float:
    """Return the spectral norm of a step of Muon, in units of its rate."""
    fan_out, fan_in = matrix.shape
    if matrix is network.layers[0].weight:  # its inputs are as many as the octaves ask for, whatever the width
        inputs = [encoded_width(shape.octaves, shape.directions) for shape in (REFERENCE, network.shape)]
        return SPECTRAL * math.sqrt(fan_out / REFERENCE.width * inputs[0] / inputs[1])
    return SPECTRAL * math.sqrt(fan_out / fan_in)


def adam_share(network: Network, weight: Tensor) -> float:
    """Return the rate of a weight, in units of Adam's rate in the reference."""
    if weight.ndim < 2 or weight is network.layers[0].weight:
        return 1.0
    return REFERENCE.width / weight.shape[1]
