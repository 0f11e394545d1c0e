"""One reconstruction on several processes, under torchrun: each takes a share of the rays of every step.

The processes draw the same batch, differentiate the loss of their own rays, and average the gradients, so that they all
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


@dataclass(frozen=True)
class Ranks:
    """The processes that work on one reconstruction.

    Parameters
    ----------
    rank : number of this process; that with 0 decides, and writes
    size : how many there are
    """

    rank: int = 0
    size: int = 1

    @classmethod
    def from_environment(cls) -> Ranks:
        """Return what torchrun tells in RANK and WORLD_SIZE; one process where it tells nothing."""
        return cls(int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)))

    @property
    def is_first(self) -> bool:
        """Whether this process decides, and writes."""
        return self.rank == 0

    def join(self, device: torch.device) -> None:
        """Meet the other processes, by NCCL between GPUs and by gloo between CPUs."""
        if self.size > 1 and not dist.is_initialized():
            if device.type == "cuda":
                torch.cuda.set_device(device)
            dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
            atexit.register(dist.destroy_process_group)

    @property
    def share(self) -> slice:
        """Which rays of a batch are this process's."""
        return slice(self.rank, None, self.size)

    def average_gradients(self, network: nn.Module, mine: int, rays: int) -> None:
        """Replace gradients of a mean over `mine` rays by those of the mean over all `rays` of the batch."""
        if self.size == 1:
            return
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        flat = torch.cat([g.reshape(-1) for g in gradients]) * (mine / rays)
        dist.all_reduce(flat)
        for g, part in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            g.copy_(part.reshape(g.shape))

    def average(self, values: Tensor, mine: int, rays: int) -> Tensor:
        """Return the mean over the batch of what are means over `mine` of its rays."""
        if self.size == 1:
            return values
        values = values * (mine / rays)
        dist.all_reduce(values)
        return values

    def decided(self, values: list[float], device: torch.device) -> list[float]:
        """Return the values of the first process."""
        if self.size == 1:
            return values
        told = torch.tensor(values, dtype=torch.float64, device=device)
        dist.broadcast(told, 0)
        return [float(v) for v in told]
