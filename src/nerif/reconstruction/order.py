"""A random order without a list of it: a permutation that is computed where it is asked.

A Feistel network on pairs of numbers below a = ceil(sqrt(count)) exchanges the two, each time adding a hash of one to
the other, modulo a; that is one-to-one whatever the hash. The few numbers that it carries to count or beyond are sent
through it again until they are below.

Source: Black & Rogaway, Ciphers with arbitrary finite domains, CT-RSA (2002).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

__all__ = ["shuffled"]

ROUNDS = 6
MULTIPLIER = 0x9E3779B1  # 2^32 / golden ratio, odd


def shuffled(first: int, length: int, count: int, seed: int) -> Int[Tensor, " n"]:
    """Return places first .. first + length - 1 of an endless order that has each of 0 .. count - 1 once an epoch.

    Parameters
    ----------
    first : place, counted from the first epoch's beginning
    count : things to put in order
    seed : of the order; each epoch has its own
    """
    place = np.arange(first, first + length, dtype=np.int64)
    epochs = place // count
    parts = [
        _permuted(place[epochs == epoch] % count, count, _hash(seed * MULTIPLIER + epoch))
        for epoch in range(first // count, (first + length - 1) // count + 1)
    ]
    return torch.from_numpy(np.concatenate(parts))


def _permuted(x: Int[np.ndarray, " n"], count: int, key: int) -> Int[np.ndarray, " n"]:
    side = math.isqrt(count - 1) + 1
    left, right = np.divmod(x, side)
    for turn in range(ROUNDS):
        mixed = (right + key + turn * MULTIPLIER) & 0x7FFFFFFF
        mixed = ((mixed ^ (mixed >> 15)) * 0x2C1B3C6D) & 0x7FFFFFFF
        mixed = ((mixed ^ (mixed >> 12)) * 0x297A2D39) & 0x7FFFFFFF
        left, right = right, (left + (mixed ^ (mixed >> 15))) % side
    x = left * side + right
    outside = x >= count
    if outside.any():
        x[outside] = _permuted(x[outside], count, key)
    return x


def _hash(x: int) -> int:
    """Thirty-one bits that change all when one of x does."""
    for factor in (0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53):
        x = ((x ^ (x >> 33)) * factor) & 0xFFFFFFFFFFFFFFFF
    return (x >> 33) & 0x7FFFFFFF
