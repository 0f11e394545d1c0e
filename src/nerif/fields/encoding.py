"""Sinusoidal encoding of coordinates (paper, Eq. (postionencode)), with its derivative written out."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["encode", "encode_pullback", "encoded_width"]


def encoded_width(octaves: int) -> int:
    """Return 3 (2 N + 1), the width of the encoding of a point."""
    return 3 * (2 * octaves + 1)


def encode(p: Float[Tensor, "n 3"], octaves: int, gains: Float[Tensor, " k"] | None = None) -> Float[Tensor, "n e"]:
    """Return (p, sin(2^k pi p), cos(2^k pi p)), k = 0 .. octaves - 1, each octave times its gain.

    Parameters
    ----------
    p : (n, 3) coordinates, the box mapped to [-1, 1]
    octaves : N
    gains : (N,) weights of the octaves; the paper's are all 1
    """
    if octaves == 0:
        return p
    frequency = math.pi * 2.0 ** torch.arange(octaves, dtype=p.dtype, device=p.device)
    angle = (p[:, None, :] * frequency[:, None]).reshape(-1, 3 * octaves)
    sine, cosine = angle.sin(), angle.cos()
    if gains is not None:
        gain = gains.repeat_interleave(3)
        sine, cosine = sine * gain, cosine * gain
    return torch.cat([p, sine, cosine], dim=1)


def encode_pullback(
    encoded: Float[Tensor, "n e"], cotangent: Float[Tensor, "n e"], octaves: int
) -> Float[Tensor, "n 3"]:
    """Return J^T cotangent, where J = d encode / d p and `encoded` = encode(p).

    d sin(w p) = w cos(w p), so the two halves of the encoding are each other's derivative, gains included.
    """
    if octaves == 0:
        return cotangent
    frequency = math.pi * 2.0 ** torch.arange(octaves, dtype=encoded.dtype, device=encoded.device)
    m = 3 * octaves
    sine, cosine = encoded[:, 3 : 3 + m], encoded[:, 3 + m :]
    swirl = cotangent[:, 3 : 3 + m] * cosine - cotangent[:, 3 + m :] * sine
    return cotangent[:, :3] + (swirl.reshape(-1, octaves, 3) * frequency[:, None]).sum(1)
