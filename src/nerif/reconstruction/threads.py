"""How many threads compute: the same of torch and Numba, and no more than there are cores that nobody else uses.

Threads that share a step wait for one another in a loop. Where one of them has to share its core with another program
all of them wait for it, many times in a step: two threads on two cores, one of which is taken, are ten times slower
than one (benchmarks/results/busy-cpu.md).
"""

from __future__ import annotations

import math
import os
import time
from types import TracebackType

import torch

__all__ = ["Cores", "free_threads", "share_threads"]

FIRST, EVERY = 0.5, 2.0  # seconds until the first look at what the cores do, and between looks
SPARED = 0.4  # share of a core that others may use before it is left to them


def share_threads() -> None:
    """Give what Numba compiles as many threads as torch has.

    Numba sets OpenMP's number, which is torch's, to all cores when it starts its own; torch's is set back.
    """
    import numba

    threads = torch.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)


def free_threads(idle: float, own: float, most: int) -> int:
    """Return how many threads to compute with.

    Parameters
    ----------
    idle : mean number of cores that nobody used
    own : mean number of cores that this process used
    most : threads that it may have
    """
    return max(1, min(most, math.floor(idle + own + SPARED)))


class Cores:
    """Within it, torch has as many threads as there are cores that are idle or its own, looked at every two seconds.

    It never has more threads than when it was entered, which is what it has again afterwards. On a machine with nothing
    else to do the number stays, and with it the order in which numbers are added.

    Parameters
    ----------
    device : where the work is done; on a GPU nothing is looked at
    """

    def __init__(self, device: torch.device) -> None:
        self.most = torch.get_num_threads()
        self._watching = device.type == "cpu" and self.most > 1
        self._next, self._then = 0.0, (0.0, 0.0, 0.0)

    def __enter__(self) -> Cores:
        if self._watching:
            self._begin(FIRST)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._watching:
            torch.set_num_threads(self.most)

    def look(self) -> None:
        """Take the threads that there are cores for; to be called often."""
        if not self._watching or time.perf_counter() < self._next:
            return
        now, idle, own = (b - a for a, b in zip(self._then, _used(), strict=True))
        threads = free_threads(idle / now, own / now, self.most)
        if threads != torch.get_num_threads():
            torch.set_num_threads(threads)
        self._begin(EVERY)

    def _begin(self, seconds: float) -> None:
        self._then = _used()
        self._next = time.perf_counter() + seconds


def _used() -> tuple[float, float, float]:
    """Return a clock, and what the cores that this process may use have been idle, and what it has used, in seconds."""
    import psutil

    cores = psutil.cpu_times(percpu=True)
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(len(cores))
    idle = sum(cores[i].idle + getattr(cores[i], "iowait", 0.0) for i in allowed if i < len(cores))
    own = psutil.Process().cpu_times()
    return time.perf_counter(), idle, own.user + own.system
