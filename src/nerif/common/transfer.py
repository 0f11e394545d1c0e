"""Numbers on their way to a device: a copy that is waited for keeps a GPU from working ahead."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

__all__ = ["constant", "sent"]


def sent(x: Tensor, device: torch.device) -> Tensor:
    """Return a tensor of the CPU on a device; a GPU is not waited for."""
    if device.type == "cpu":
        return x
    return x.pin_memory().to(device, non_blocking=True)


def constant(values: tuple[float, ...], like: Tensor) -> Tensor:
    """Return numbers in the precision and on the device of a tensor, copied there once; not to be changed in place."""
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=64)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)
