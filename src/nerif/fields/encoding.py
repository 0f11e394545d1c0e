"""Sinusoidal encoding of coordinates, octave by octave along several directions, with its derivative written out.

The paper's (Eq. (postionencode)) runs along the axes; waves along the diagonals as well let a network meet fronts that
lie askew.
"""

from __future__ import annotations

import itertools
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerif.common.conventions import InputError

__all__ = ["DIRECTIONS", "encode", "encode_pullback", "encoded_width", "wave_vectors"]


def _unit(count: int) -> list[tuple[float, ...]]:
    """Directions, up to their sign, with so many components other than 0, all equal in size."""
    found = [v for v in itertools.product((1, 0, -1), repeat=3) if sum(map(abs, v)) == count]
    return [tuple(x / math.sqrt(count) for x in v) for v in found if v > tuple(-x for x in v)]


AXES = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
DIRECTIONS = {3: AXES, 9: [*AXES, *_unit(2)], 13: [*AXES, *_unit(2), *_unit(3)]}
"""By their number: the axes of the box; with the diagonals of the faces of a cube; with those of the cube as well."""


def check_directions(count: int) -> None:
    """Raise InputError unless there are DIRECTIONS of that number."""
    if count not in DIRECTIONS:
        raise InputError(f"directions: expected one of {', '.join(map(str, DIRECTIONS))}, got {count}")


def wave_vectors(octaves: int, directions: int) -> tuple[Float[Tensor, "w 3"], Int[Tensor, " w"]]:
    """Return 2^k pi e for k = 0 .. octaves - 1 and each direction e, those along the axes first, and k of each."""
    unit, waves, octave = torch.tensor(DIRECTIONS[directions], dtype=torch.float64), [], []
    for some in (unit[:3], unit[3:]):
        for k in range(octaves):
            waves.append(math.pi * 2.0**k * some)
            octave += [k] * len(some)
    if not waves:
        return torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)
    return torch.cat(waves).float(), torch.tensor(octave)


def encoded_width(octaves: int, directions: int) -> int:
    """Return 3 + 2 N D, the width of the encoding of a point by N octaves along D directions."""
    return 3 + 2 * octaves * directions


def encode(
    p: Float[Tensor, "n 3"], waves: Float[Tensor, "w 3"], gains: Float[Tensor, " w"] | None = None
) -> Float[Tensor, "n e"]:
    """Return (p, g sin(k . p), g cos(k . p)) for each wave vector k and its gain g.

    Parameters
    ----------
    p : (n, 3) coordinates, the box mapped to [-1, 1]
    waves : (w, 3) see wave_vectors
    gains : (w,) weights of the waves; the paper's are all 1
    """
    x, y, z = waves.to(p).unbind(-1)
    # written out, since a matrix product in reduced precision would turn the phases
    phase = torch.addcmul(torch.addcmul(p[:, :1] * x, p[:, 1:2], y), p[:, 2:], z)
    sine, cosine = phase.sin(), phase.cos()
    if gains is not None:
        sine, cosine = sine * gains, cosine * gains
    return torch.cat([p, sine, cosine], dim=1)


def encode_pullback(
    encoded: Float[Tensor, "n e"], cotangent: Float[Tensor, "n e"], waves: Float[Tensor, "w 3"]
) -> Float[Tensor, "n 3"]:
    """Return J^T cotangent, where J = d encode / d p and `encoded` = encode(p, waves).

    d sin(k . p) = k cos(k . p), so the two halves of the encoding are each other's derivative, gains included.
    """
    w = len(waves)
    sine, cosine = encoded[:, 3 : 3 + w], encoded[:, 3 + w :]
    swirl = cotangent[:, 3 : 3 + w] * cosine - cotangent[:, 3 + w :] * sine
    # written out as well, so that no product is rounded
    return cotangent[:, :3] + torch.stack([(swirl * k).sum(dim=1) for k in waves.to(encoded).T], dim=1)
