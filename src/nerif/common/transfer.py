"""Transfers to a device that do not stall the GPU."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

__all__ = ["constant", "to_device"]


def to_device(x: Tensor, device: torch.device) -> Tensor:
    """Return a CPU tensor on a device; the copy to a GPU is asynchronous."""
    return x if device.type == "cpu" else x.pin_memory().to(device, non_blocking=True)


def constant(values: tuple[float, ...], like: Tensor) -> Tensor:
    """Return a cached tensor with the type and device of `like`; do not modify it in place."""
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=64)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)
