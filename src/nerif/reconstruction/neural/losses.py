"""The loss of NeRIF (paper, Eq. (lossfunction)) in normalised units, and the evaluation of the network in it.

    loss = w_c |grad(n)_AD - grad(n)_net| + w_n |d_ND - d| + w_h |d_net - d| + w_a |d_AD - d| + w_g |n|_ambient

d_ND integrates central differences of n, d_net the gradient heads, d_AD the exact gradient of n; the first three
terms are the paper's. The fourth is their noise-free twin, the last the gauge. The forward model defines the path
integral (forward/); a technique without a gradient has one prediction, weighted by w_n + w_h + w_a.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.network import Network, NeuralField
from nerif.forward.forward_model import Weights
from nerif.forward.path_integral import places
from nerif.geometry import Rays
from nerif.reconstruction.device import FAST, autocast_dtype, float32_products, keep_compiled_code_private
from nerif.reconstruction.neural.training_settings import LossWeights
from nerif.reconstruction.target import TechniqueData

__all__ = ["DATA_TERMS", "Evaluator", "MixedPrecision", "loss_terms"]

DATA_TERMS = ("automatic", "head", "numerical")
"""Terms that compare a prediction with the measurement."""


@runtime_checkable
class Evaluator(Protocol):
    """Evaluates the n head of a network."""

    def value(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]: ...

    def value_and_gradient(
        self, p: Float[Tensor, "n 3"], heads: bool
    ) -> tuple[Tensor, Float[Tensor, "n 3"], Float[Tensor, "n 3"] | None]:
        """Return the n head, its exact gradient, and the gradient heads (None unless `heads`)."""


Evaluation = Callable[[Tensor, bool], tuple[Tensor, Tensor, Tensor | None]]
"""Network.value_and_gradient"""


class MixedPrecision:
    """Evaluator of a network in bf16 while `low` is set and the settings allow it.

    Parameters
    ----------
    precision : auto, float32, tf32 or bf16
    compile : on, off, or auto: on GPUs of FAST by PyTorch, on a CPU in float32 by Numba (fused.py)
    """

    def __init__(self, network: Network, device: torch.device, precision: str, compile: str) -> None:
        self.network, self.device, self.low = network, device, True
        self.dtype = autocast_dtype(precision, device)
        tf32 = device.type == "cuda" and precision != "float32"
        self.products: Literal["highest", "high"] = "high" if tf32 else "highest"
        self.remark = ""
        """Why the network is not compiled."""
        self.evaluate: Evaluation = network.value_and_gradient
        if network.compilable and (compile == "on" or (compile == "auto" and device.type in FAST)):
            self.evaluate = self._compiled(network.value_and_gradient)
        elif compile == "on":
            self.remark = "; a network beside thin bodies is not compiled"
        self.fused: Callable[[Network, Tensor], tuple[Tensor, Tensor]] | None = None
        if compile == "auto" and device.type == "cpu" and _fusible(network):
            from nerif.reconstruction.neural.fused import value_and_gradient

            self.fused = value_and_gradient

    def value(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        with self._precision():
            return self.network(p)

    def value_and_gradient(
        self, p: Float[Tensor, "n 3"], heads: bool
    ) -> tuple[Tensor, Float[Tensor, "n 3"], Float[Tensor, "n 3"] | None]:
        if self.fused is not None and torch.is_grad_enabled() and not self._is_low:
            return *self.fused(self.network, p), None
        with self._precision():
            return self.evaluate(p, heads)

    def backward(self, loss: Tensor) -> None:
        """Differentiate a loss with matrix products in the precision of the network."""
        with float32_products(self.products):
            loss.backward()

    def _compiled(self, plain: Evaluation) -> Evaluation:
        """Compiled at the first call; if that fails, as without a C compiler, plain from then on."""
        keep_compiled_code_private()
        compiled = torch.compile(plain, dynamic=True)

        def call(p: Tensor, heads: bool) -> tuple[Tensor, Tensor, Tensor | None]:
            try:
                return compiled(p, heads)
            except torch.OutOfMemoryError:
                raise
            except Exception as error:  # any error of the compiler; an error of the call itself the plain one raises
                result = plain(p, heads)
                reason = (str(error).strip() or type(error).__name__).splitlines()[0]
                self.evaluate, self.remark = plain, f"; the network was not compiled ({reason}): slower, same results"
                return result

        return call

    @contextmanager
    def _precision(self) -> Iterator[None]:
        autocast = torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self._is_low)
        with float32_products(self.products), autocast:
            yield

    @property
    def _is_low(self) -> bool:
        return self.low and self.dtype is not None


def _fusible(network: Network) -> bool:
    """Whether fused.py has this network: layers without skip and heads, SiLU, float32."""
    shape, dtype = network.shape, network.outputs[0].weight.dtype
    plain = network.layered and not (shape.skip or shape.head_width or shape.gradient_head)
    return plain and shape.activation == "silu" and dtype == torch.float32


def loss_terms(
    field: NeuralField, network: Evaluator, part: TechniqueData, rays: Rays, s: Float[Tensor, "n m"],
    step: Float[Tensor, "n m"], weights: LossWeights, norm: str,
) -> dict[str, Tensor]:  # fmt: skip
    """Return the terms of positive weight by name, unweighted.

    Only the network may run in low precision; the path integral is summed in float32.

    Parameters
    ----------
    part : pixels, measured values and forward model
    rays : of the part; with a lens several consecutive thin rays per pixel, of which the pixel is the mean
    s : path lengths of the samples, mm
    step : length of ray per sample, mm; central differences reach half of it to either side, divided by the rays per
        pixel, whose samples interleave
    norm : "l2" (mean length of the residual vectors, the paper's) or "squared" (mean square)
    """
    model, shape, rays_per_pixel = part.model, s.shape, len(rays) // len(part)

    def compared(prediction: Float[Tensor, "n c"]) -> Tensor:
        pixels = prediction if rays_per_pixel == 1 else rays.mean_of(rays_per_pixel, prediction)
        return reduce(part.residual(pixels), norm)

    unit = field.scale / field.half_edge  # 1/mm of one unit of network gradient
    integral = model.weights(rays, s, step).in_units(field.scale, unit)

    @torch.no_grad()
    def evaluate(points: Float[Tensor, "n m 3"]) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m 3"]]:
        value, slope, _ = network.value_and_gradient(field.normalise(points).reshape(-1, 3), False)
        return value.float().reshape(shape) * field.scale, slope.float().reshape(*shape, 3) * unit

    points, tilt = places(model, rays, s, step, evaluate)
    tilt = None if tilt is None else tilt / unit
    p = field.normalise(points).reshape(-1, 3)
    if integral.slope is None:  # without a gradient all three predictions are one
        term = compared(integral(network.value(p).float().reshape(shape), None))
        return {name: term for name in DATA_TERMS if getattr(weights, name)}

    def data(value: Tensor, gradient: Float[Tensor, "p 3"]) -> Tensor:
        gradient = gradient.float().reshape(*shape, 3)
        return compared(integral(value.float().reshape(shape), gradient if tilt is None else gradient - tilt))

    terms = {}
    if weights.automatic or weights.head or weights.consistency:
        value, automatic, head = network.value_and_gradient(p, bool(weights.head or weights.consistency))
        if weights.automatic:
            terms["automatic"] = data(value, automatic)
        if head is not None:
            if weights.head:
                terms["head"] = data(value, head)
            if weights.consistency:
                terms["consistency"] = reduce(automatic.float() - head.float(), norm)
    if weights.numerical:
        reach = step / (2 * rays_per_pixel * field.half_edge)
        prediction = by_differences(network.value, integral, p.reshape(*shape, 3), reach)
        if tilt is not None:
            prediction = prediction - Weights(integral.profile, slope=integral.slope)(None, tilt)
        terms["numerical"] = compared(prediction)
    return terms


def by_differences(
    value: Callable[[Float[Tensor, "n 3"]], Float[Tensor, " n"]], integral: Weights, p: Float[Tensor, "n m 3"],
    reach: Float[Tensor, "n m"],
) -> Float[Tensor, "n c"]:  # fmt: skip
    """Return the prediction by central differences of n (paper, Eq. (samplegrad)), in units of the network.

    B grad(n) needs derivatives along the rows of B only: two evaluations per sample and channel, at a distance `reach`
    to either side, which is 0 where a ray misses the box.
    """
    assert integral.slope is not None
    length = integral.slope.norm(dim=-1)
    along = integral.slope / torch.where(length > 0, length, 1.0)[..., None]
    reach = torch.where(reach > 0, reach, 1.0)  # arbitrary: such a sample has no weight
    offset = reach[..., None, None] * along[:, None]  # n m c 3
    centre = p[:, :, None, :]
    points = torch.stack([centre + offset, centre - offset])  # 2 n m c 3
    n = value(points.reshape(-1, 3)).float().reshape(points.shape[:-1])
    slope = (n[0] - n[1]) / (2 * reach[..., None])  # n m c
    total = (integral.profile[..., None] * slope).sum(dim=1) * length
    if integral.value is not None:
        total = total + Weights(integral.profile, value=integral.value)(n.mean(dim=(0, 3)), None)
    return total


def reduce(residual: Float[Tensor, "n k"], norm: str) -> Tensor:
    """Return the mean length of the residual vectors ("l2") or the mean square of their components ("squared")."""
    if norm == "l2":
        # the tiny term keeps the slope finite where a residual is exactly 0
        return (residual.square().sum(dim=-1) + 1e-24).sqrt().mean()
    return residual.square().mean()
