"""The layers of a network on a CPU: value and slope in one function, with its derivative written out, in float32.

What `Network.value_and_gradient` lets autograd record as some fifteen operations a layer are four passes here, over
tiles of points that stay in the cache. With h_i = f(a_i), a_i = W_i h_{i-1} + b_i, f = SiLU, v = w . h_L + b,

    u_i = c_i f'(a_i),      c_{i-1} = W_i^T u_i,      c_L = w,      dv / dh_0 = c_0,

a loss whose derivatives in v and c_0 are given as g and e_0 has

    e_i = f'(a_i) (W_i e_{i-1}),   k_i = f'(a_i) d_i + f''(a_i) c_i (W_i e_{i-1}),   d_{i-1} = W_i^T k_i,   d_L = g w
    dW_i = u_i e_{i-1}^T + k_i h_{i-1}^T,   db_i = k_i,   dw = e_L + g h_L.

The plain twin is in fields/network.py; tests compare the two.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import njit, prange
from torch import Tensor

from nerif.fields.network import Network
from nerif.reconstruction.device import share_threads

__all__ = ["value_and_gradient"]

share_threads()  # before Numba compiles
TILE = 4096  # points
FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit("void(f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1])", parallel=True, fastmath=FAST, cache=True)
def _activate(a: np.ndarray, s: np.ndarray, h: np.ndarray, d: np.ndarray) -> None:
    """h = f(a) and d = f'(a) of a and its sigmoid s."""
    for row in prange(a.shape[0]):
        for i in range(a.shape[1]):
            value = a[row, i] * s[row, i]
            h[row, i] = value
            d[row, i] = s[row, i] + value - value * s[row, i]


@njit(f"void({', '.join(['f4[:, ::1]'] * 6)})", parallel=True, fastmath=FAST, cache=True)
def _turn(a: np.ndarray, s: np.ndarray, c: np.ndarray, back: np.ndarray, forth: np.ndarray, out: np.ndarray) -> None:
    """out = f'(a) back + f''(a) c forth."""
    one, two = np.float32(1), np.float32(2)
    for row in prange(a.shape[0]):
        for i in range(a.shape[1]):
            x, sigmoid = a[row, i], s[row, i]
            rest = one - sigmoid
            slope = sigmoid + x * sigmoid * rest
            bend = sigmoid * rest * (two + x * (one - two * sigmoid))
            out[row, i] = slope * back[row, i] + bend * c[row, i] * forth[row, i]


def value_and_gradient(network: Network, p: Float[Tensor, "n k"]) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Return what `Network.value_and_gradient` does, of a network of SiLU layers without skip and heads."""
    encoded, output = network.encode(p), network.outputs[0]
    weights = [z for layer in network.layers for z in (layer.weight, layer.bias)]
    value, slope = _Layers.apply(encoded, output.weight, output.bias, *weights)
    value, bend = network.bounded(value)
    return value, network.pull_back(p, encoded, slope if bend is None else slope * bend[:, None])


class _Layers(torch.autograd.Function):
    """(h_0, w, b, W_1, b_1, ...) -> (v, c_0)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, out: Tensor, shift: Tensor, *layers: Tensor) -> tuple[Tensor, Tensor]:
        """Return v (n) and c_0 (n, e) of h_0 (n, e)."""
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
        """Return the derivatives in h_0, w, b, W_1, b_1, ..."""
        share_threads()
        g, e = derivatives
        x, out, *weights, a, s, h, d, c, u = ctx.saved_tensors
        n, depth = len(x), len(weights)
        e, total = e.contiguous(), torch.zeros_like(out)
        in_weights, in_biases = [torch.zeros_like(w) for w in weights], [w.new_zeros(len(w)) for w in weights]
        in_x = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        forth, k = a.new_empty(depth, min(n, TILE), a.shape[2]), a.new_empty(min(n, TILE), a.shape[2])
        rising, back = torch.empty_like(k), torch.empty_like(k)
        for begin in range(0, n, TILE):
            tile = slice(begin, min(begin + TILE, n))
            size, below = tile.stop - tile.start, e[tile]
            for i in range(depth):
                torch.mm(below, weights[i].T, out=forth[i, :size])
                in_weights[i].addmm_(u[i, tile].T, below)
                below = torch.mul(forth[i, :size], d[i, tile], out=rising[:size])
            total += below.sum(dim=0)
            total[0].addmv_(h[-1, tile].T, g[tile])
            torch.mul(g[tile, None], out, out=back[:size])
            for i in range(depth - 1, -1, -1):
                given = a[i, tile], s[i, tile], c[i, tile], back[:size], forth[i, :size], k[:size]
                _turn(*(z.numpy() for z in given))
                in_weights[i].addmm_(k[:size].T, h[i - 1, tile] if i else x[tile])
                in_biases[i] += k[:size].sum(dim=0)
                if i:
                    torch.mm(k[:size], weights[i], out=back[:size])
                elif in_x is not None:
                    torch.mm(k[:size], weights[i], out=in_x[tile])
        of_layers = [z for pair in zip(in_weights, in_biases, strict=True) for z in pair]
        return in_x, total, g.sum()[None], *of_layers
