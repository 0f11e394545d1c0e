"""A random order without a list of it: a permutation that is computed where it is asked.

A Feistel network on 2 h bits exchanges two halves, each time adding to one a hash of the other; that is one-to-one
whatever the hash. Numbers that it carries beyond the count are sent through it again until they are below.

Source: Black & Rogaway, Ciphers with arbitrary finite domains, CT-RSA (2002).
"""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Int
from torch import Tensor

__all__ = ["shuffled"]

ROUNDS = 6
BLOCK = 1 << 14  # places computed at once
MULTIPLIER = 0x9E3779B1  # 2^32 / golden ratio, odd


def shuffled(first: int, length: int, count: int, seed: int) -> Int[Tensor, " n"]:
    """Return places first .. first + length - 1 of an endless order that has each of 0 .. count - 1 once an epoch.

    Parameters
    ----------
    first : place, counted from the first epoch's beginning
    count : things to put in order
    seed : of the order; each epoch has its own
    """
    place, end, parts = first, first + length, [torch.empty(0, dtype=torch.long)]
    while place < end:
        epoch, inside = divmod(place, count)
        start = inside - inside % BLOCK
        part = _block(start, count, _hash(seed * MULTIPLIER + epoch))[inside - start :][: end - place]
        parts.append(part)
        place += len(part)
    return torch.cat(parts)


@lru_cache(maxsize=4)  # of batches that are smaller, several are cut out of one block
def _block(start: int, count: int, key: int) -> Int[Tensor, " n"]:
    """Up to BLOCK places of an epoch."""
    return _permuted(torch.arange(start, min(start + BLOCK, count)), count, key)


def _permuted(x: Int[Tensor, " n"], count: int, key: int) -> Int[Tensor, " n"]:
    half = max(1, (max(count - 1, 1).bit_length() + 1) // 2)
    mask = (1 << half) - 1
    outside = torch.ones_like(x, dtype=torch.bool)
    while bool(outside.any()):
        left, right = x[outside] >> half, x[outside] & mask
        for turn in range(ROUNDS):
            mixed = (right + key + turn * MULTIPLIER) & 0x7FFFFFFF
            mixed = ((mixed ^ (mixed >> 15)) * 0x2C1B3C6D) & 0x7FFFFFFF
            mixed = ((mixed ^ (mixed >> 12)) * 0x297A2D39) & 0x7FFFFFFF
            left, right = right, left ^ ((mixed ^ (mixed >> 15)) & mask)
        x[outside] = left << half | right
        outside = x >= count
    return x


def _hash(x: int) -> int:
    """Thirty-one bits that change all when one of x does."""
    for factor in (0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53):
        x = ((x ^ (x >> 33)) * factor) & 0xFFFFFFFFFFFFFFFF
    return (x >> 33) & 0x7FFFFFFF
