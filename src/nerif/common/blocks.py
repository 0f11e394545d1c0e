"""Blocks of neighbouring pixels, for sums and means over bins."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from torch import Tensor

__all__ = ["blocks"]

Array = TypeVar("Array", np.ndarray, Tensor)


def blocks(image: Array, down: int, across: int) -> Array:
    """Return the whole blocks of `down` x `across` pixels as (rows, down, columns, across, ...), from the top left."""
    rows, columns = image.shape[0] // down, image.shape[1] // across
    return image[: rows * down, : columns * across].reshape(rows, down, columns, across, *image.shape[2:])
