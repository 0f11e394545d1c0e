"""What the page's JavaScript computes from the packed arrays, in Python."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np

from nerif.report.packing import MASKED


def unpack(packed: dict[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    """The packed values, to within half a step."""
    data = np.frombuffer(zlib.decompress(base64.b64decode(packed["text"])), dtype=np.uint8).astype(np.uint16)
    codes = np.cumsum(data[: len(data) // 2] | (data[len(data) // 2 :] << 8), dtype=np.uint16)
    values = packed["low"] + codes * packed["step"]
    return np.where(codes == MASKED, np.nan, values).reshape(shape)


def quantity_of(relation: dict[str, Any], x: np.ndarray) -> np.ndarray:
    """The quantity of an index excess, NaN where masked."""
    if relation["kind"] == "table":
        values = np.array(relation["values"], dtype=np.float64)
        t = (x - relation["low"]) / relation["step"]
        i = np.clip(np.floor(t), 0, len(values) - 2).astype(int)
        return values[i] + (values[i + 1] - values[i]) * (t - i)
    with np.errstate(divide="ignore", invalid="ignore"):
        shifted = x.astype(np.float64) + relation["offset"]
        q = shifted * relation["factor"] if relation["kind"] == "linear" else relation["factor"] / shifted
        good = shifted > 0 if relation["lower"] is not None else np.isfinite(q)
        if relation["upper"] is not None:
            good &= (q >= relation["lower"]) & (q <= relation["upper"])
        return np.where(good, q, np.nan)
