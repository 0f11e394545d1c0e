"""Transfers to a device that do not stall the GPU, and to the CPU for double precision that a device lacks."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

__all__ = ["constant", "double_device", "in_double", "to_device"]


def to_device(x: Tensor, device: torch.device) -> Tensor:
    """Return a CPU tensor on a device; the copy to a GPU is asynchronous."""
    return x.pin_memory().to(device, non_blocking=True) if device.type in ("cuda", "xpu") else x.to(device)


@lru_cache(maxsize=64)
def double_device(device: torch.device) -> torch.device:
    """Return a device, or the CPU where it has no double precision: Apple's GPUs, some of Intel's."""
    if device.type == "mps" or (device.type == "xpu" and not torch.xpu.get_device_properties(device).has_fp64):
        return torch.device("cpu")
    return device


def in_double(x: Tensor) -> Tensor:
    """Return a tensor in double precision, on its `double_device`."""
    return x.to(double_device(x.device)).double()


def constant(values: tuple[float, ...], like: Tensor) -> Tensor:
    """Return a cached tensor with the type and device of `like`; do not modify it in place."""
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=64)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)
