"""Value and gradient of a network on a CPU as one function with its derivative written out, in float32.

`Network.value_and_gradient` makes autograd record about fifteen operations per layer; here they are four passes over
tiles of points that stay in the cache. With h_i = f(a_i), a_i = W_i h_{i-1} + b_i, f = SiLU, v = w . h_L + b,

    u_i = c_i f'(a_i),      c_{i-1} = W_i^T u_i,      c_L = w,      dv / dh_0 = c_0,

a loss with the derivatives g in v and e_0 in c_0 has

    e_i = f'(a_i) (W_i e_{i-1}),   k_i = f'(a_i) d_i + f''(a_i) c_i (W_i e_{i-1}),   d_{i-1} = W_i^T k_i,   d_L = g w
    dW_i = u_i e_{i-1}^T + k_i h_{i-1}^T,   db_i = k_i,   dw = e_L + g h_L.

The plain version is in fields/network.py; tests compare the two.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import njit, prange
from torch import Tensor

from nerif.fields.network import Network
from nerif.fields.spline_kernel import FASTMATH
from nerif.reconstruction.device import share_threads

__all__ = ["value_and_gradient"]

share_threads()  # before Numba compiles
TILE = 4096  # points


@njit("void(f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1])", parallel=True, fastmath=FASTMATH, cache=True)
def _activate(a: np.ndarray, s: np.ndarray, h: np.ndarray, d: np.ndarray) -> None:
    """h = f(a) and d = f'(a), where s is the sigmoid of a."""
    for row in prange(a.shape[0]):
        for i in range(a.shape[1]):
            value = a[row, i] * s[row, i]
            h[row, i] = value
            d[row, i] = s[row, i] + value - value * s[row, i]


@njit(f"void({', '.join(['f4[:, ::1]'] * 6)})", parallel=True, fastmath=FASTMATH, cache=True)
def _combine(a: np.ndarray, s: np.ndarray, c: np.ndarray, d: np.ndarray, we: np.ndarray, k: np.ndarray) -> None:
    """k = f'(a) d + f''(a) c (W e), where s is the sigmoid of a."""
    one, two = np.float32(1), np.float32(2)
    for row in prange(a.shape[0]):
        for i in range(a.shape[1]):
            x, sigmoid = a[row, i], s[row, i]
            rest = one - sigmoid
            slope = sigmoid + x * sigmoid * rest
            bend = sigmoid * rest * (two + x * (one - two * sigmoid))
            k[row, i] = slope * d[row, i] + bend * c[row, i] * we[row, i]


def value_and_gradient(network: Network, p: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Return n and its gradient as `Network.value_and_gradient`, for a network of SiLU layers without skip and heads.

    p must not require a derivative.
    """
    encoding, output = network.encode(p), network.outputs[0]
    weights = [z for layer in network.layers for z in (layer.weight, layer.bias)]
    value, slope = _Layers.apply(encoding, output.weight, output.bias, *weights)
    value, bend = network.bounded(value)
    return value, network.pull_back(p, encoding, slope if bend is None else slope * bend[:, None])


class _Layers(torch.autograd.Function):
    """(h_0, w, b, W_1, b_1, ...) -> (v, c_0); h_0 has no derivative."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, out: Tensor, shift: Tensor, *layers: Tensor) -> tuple[Tensor, Tensor]:
        share_threads()
        weights, biases = layers[::2], layers[1::2]
        n, depth, width = len(x), len(weights), weights[0].shape[0]
        a, s, h, d, c, u = (x.new_empty(depth, n, width) for _ in range(6))
        value, first = x.new_empty(n), x.new_empty(x.shape)
        for begin in range(0, n, TILE):
            tile = slice(begin, min(begin + TILE, n))
            below = x[tile]
            for i in range(depth):
                torch.addmm(biases[i], below, weights[i].T, out=a[i, tile])
                torch.sigmoid(a[i, tile], out=s[i, tile])
                below = h[i, tile]
                _activate(*(z[i, tile].numpy() for z in (a, s, h, d)))
            torch.addmv(shift.expand(len(below)), below, out[0], out=value[tile])
            c[-1, tile] = out
            for i in range(depth - 1, -1, -1):
                torch.mul(c[i, tile], d[i, tile], out=u[i, tile])
                torch.mm(u[i, tile], weights[i], out=c[i - 1, tile] if i else first[tile])
        ctx.save_for_backward(x, out, *weights, a, s, h, d, c, u)
        return value, first

    @staticmethod
    def backward(ctx: Any, *derivatives: Tensor) -> tuple[Tensor | None, ...]:
        share_threads()
        g, e = derivatives
        x, out, *weights, a, s, h, d, c, u = ctx.saved_tensors
        n, depth = len(x), len(weights)
        e, dw = e.contiguous(), torch.zeros_like(out)
        d_weights, d_biases = [torch.zeros_like(w) for w in weights], [w.new_zeros(len(w)) for w in weights]
        we, k = a.new_empty(depth, min(n, TILE), a.shape[2]), a.new_empty(min(n, TILE), a.shape[2])
        e_above, back = torch.empty_like(k), torch.empty_like(k)
        for begin in range(0, n, TILE):
            tile = slice(begin, min(begin + TILE, n))
            size, below = tile.stop - tile.start, e[tile]
            for i in range(depth):
                torch.mm(below, weights[i].T, out=we[i, :size])
                d_weights[i].addmm_(u[i, tile].T, below)
                below = torch.mul(we[i, :size], d[i, tile], out=e_above[:size])
            dw += below.sum(dim=0)
            dw[0].addmv_(h[-1, tile].T, g[tile])
            torch.mul(g[tile, None], out, out=back[:size])
            for i in range(depth - 1, -1, -1):
                arrays = a[i, tile], s[i, tile], c[i, tile], back[:size], we[i, :size], k[:size]
                _combine(*(z.numpy() for z in arrays))
                d_weights[i].addmm_(k[:size].T, h[i - 1, tile] if i else x[tile])
                d_biases[i] += k[:size].sum(dim=0)
                if i:
                    torch.mm(k[:size], weights[i], out=back[:size])
        return None, dw, g.sum()[None], *(z for pair in zip(d_weights, d_biases, strict=True) for z in pair)
