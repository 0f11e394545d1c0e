"""Grey values of 9 to 15 bit, packed one after the other."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import UInt8, UInt16

__all__ = ["unpack"]


def unpack(data: UInt8[np.ndarray, " byte"], bits: int, count: int) -> UInt16[np.ndarray, " count"]:
    """Unpack `count` values of `bits` each, their most significant bits first, from bytes."""
    period = math.lcm(bits, 8)  # bits, after which values and bytes begin together again
    groups, size = -(-count * bits // period), period // 8
    if len(data) < groups * size:
        data = np.concatenate([data, np.zeros(groups * size - len(data), np.uint8)])
    octets = data[: groups * size].reshape(groups, size).astype(np.uint16)
    values = np.empty((groups, period // bits), np.uint16)
    for k in range(period // bits):
        byte, bit = divmod(k * bits, 8)
        word, excess = octets[:, byte] << 8 | octets[:, min(byte + 1, size - 1)], bit + bits - 16
        word = word >> -excess if excess <= 0 else word << excess | octets[:, byte + 2] >> (8 - excess)
        values[:, k] = word & ((1 << bits) - 1)
    return values.ravel()[:count]
