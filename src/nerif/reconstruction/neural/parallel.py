"""One reconstruction on several processes, under torchrun.

All processes draw the same batch, differentiate the loss of their share of its rays, and average the gradients. So all
take the step that one process would take with the whole batch.
"""

from __future__ import annotations

import atexit
import os
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn

__all__ = ["Ranks"]

BACKENDS = {"cuda": "nccl", "xpu": "xccl"}


@dataclass(frozen=True)
class Ranks:
    """The processes of one reconstruction: number of this one, and count. Process 0 decides and writes."""

    rank: int = 0
    size: int = 1

    @classmethod
    def from_environment(cls) -> Ranks:
        """Return RANK and WORLD_SIZE as torchrun sets them; one process without torchrun."""
        return cls(int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)))

    @property
    def is_first(self) -> bool:
        """Whether this process decides and writes."""
        return self.rank == 0

    @property
    def share(self) -> slice:
        """This process's rays of a batch."""
        return slice(self.rank, None, self.size)

    def join(self, device: torch.device) -> None:
        """Connect to the other processes, by the library of the GPUs, and by gloo between CPUs."""
        if self.size > 1 and not dist.is_initialized():
            backend = BACKENDS.get(device.type, "gloo")
            if backend != "gloo":
                torch.get_device_module(device).set_device(device)
            dist.init_process_group(backend)
            atexit.register(dist.destroy_process_group)

    def average(self, values: Tensor, own_rays: int, rays: int) -> Tensor:
        """Return the mean over the rays of the batch of what each process has averaged over its own rays."""
        if self.size == 1:
            return values
        values = values * (own_rays / rays)
        dist.all_reduce(values)
        return values

    def average_gradients(self, network: nn.Module, own_rays: int, rays: int) -> None:
        """Replace the gradients of each process by their mean over the batch."""
        if self.size == 1:
            return
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        flat = self.average(torch.cat([g.reshape(-1) for g in gradients]), own_rays, rays)
        for g, part in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            g.copy_(part.reshape(g.shape))

    def broadcast(self, values: list[float], device: torch.device) -> list[float]:
        """Return the values of the first process."""
        if self.size == 1:
            return values
        bits = torch.tensor(values, dtype=torch.float64).view(torch.int64).to(device)  # no GPU need have float64
        dist.broadcast(bits, 0)
        return bits.cpu().view(torch.float64).tolist()
