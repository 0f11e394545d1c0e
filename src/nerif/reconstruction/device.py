"""Device, precision, memory and threads of a computation.

Torch and Numba use the same number of threads, at most the number of cores that no other program uses. Threads that
share a step wait for one another: two threads on two cores, one of them busy, take eight times as long as one thread
(docs/decisions/026).
"""

from __future__ import annotations

import ctypes
import functools
import math
import os
import platform
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Literal, NamedTuple, ParamSpec, TypeVar

import torch

from nerif.common.conventions import InputError
from nerif.common.pauses import at_pauses

__all__ = [
    "Cores",
    "autocast_dtype",
    "available_memory",
    "float32_products",
    "free_threads",
    "keep_freed_memory",
    "on_free_cores",
    "peak_memory",
    "resolve_device",
    "share_threads",
]

Given = ParamSpec("Given")
Result = TypeVar("Result")

_here = threading.local()  # torch has a number of threads for each thread that asks it too

FIRST, EVERY = 0.5, 2.0  # seconds until the first look at what the cores do, and between looks
LEAST, SHARED = 0.25, 0.8  # of a core others may use before it is left to them: the least, and what all threads share
CALM, MOST_CALM = 2, 64  # looks in a row with cores free before they are taken, at first and at most
KNOWN = 0.5  # of the time of the cores that their counters have to tell


def share_threads() -> None:
    """Give what Numba compiles as many threads as torch has.

    Numba sets OpenMP's number, which is torch's, to all cores when it starts its own; torch's is set back.
    """
    import numba

    threads = torch.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    _set(threads)


def free_threads(idle: float, own: float, most: int) -> int:
    """Return how many threads to compute with: as many as have a core for themselves, or nearly.

    Parameters
    ----------
    idle : mean number of cores that nobody used
    own : mean number of cores that this process used
    most : threads that it may have
    """
    fit = (k for k in range(most, 1, -1) if idle + own + max(LEAST, SHARED / k) >= k)
    return next(fit, 1)


class Used(NamedTuple):
    """Seconds: a clock, what the cores that this process may use were idle, what they did in all, what it used."""

    clock: float
    idle: float
    counted: float
    own: float


class Cores:
    """Within it, torch has as many threads as there are cores that are idle or its own, looked at every two seconds.

    It never has more threads than when it was entered, or than a container may use, and afterwards what it had before.
    On a machine with nothing else to do the number stays, and with it the order in which numbers are added. Threads
    are left at once, and taken when there has been room for a while: a longer one, each time it was in vain.

    It looks at every pause of the thread (pauses.py). Within another one, on a CPU, it is that one that looks, and goes
    on with what it knows: pieces of work that are short by themselves are not each begun with all threads.

    Parameters
    ----------
    device : where the work is done; on a GPU nothing is looked at
    """

    def __init__(self, device: torch.device) -> None:
        self.before = torch.get_num_threads()
        self.most = min(self.before, _quota()) if device.type == "cpu" else self.before
        self._watching = device.type == "cpu" and self.most > 1
        self._next, self._then = 0.0, Used(0.0, 0.0, 0.0, 0.0)
        self._calm, self._patience, self._taken = 0, CALM, False
        self._entered = ExitStack()

    def __enter__(self) -> Cores:
        if getattr(_here, "cores", None) is None:
            _here.cores = self
            self._entered.callback(_set, self.before)
            self._entered.callback(setattr, _here, "cores", None)
            self._entered.enter_context(at_pauses(self.look))
            _set(self.most)
            self._begin(FIRST)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._entered.close()

    def look(self) -> None:
        """Take the threads that there are cores for."""
        if not self._watching or time.perf_counter() < self._next:
            return
        then = self._then
        self._begin(EVERY)
        spent = Used(*(b - a for a, b in zip(then, self._then, strict=True)))
        if self._watching and spent.counted >= KNOWN * self.most * spent.clock:
            self._settle(free_threads(spent.idle / spent.clock, spent.own / spent.clock, self.most))

    def _settle(self, free: int) -> None:
        threads = torch.get_num_threads()
        self._calm = self._calm + 1 if free > threads else 0
        if free < threads:
            if self._taken:
                self._patience = min(2 * self._patience, MOST_CALM)
            _set(free)
        elif self._calm >= self._patience:
            self._calm, self._taken = 0, True
            _set(free)

    def _begin(self, seconds: float) -> None:
        if self._watching:
            used = _used()
            self._watching = used is not None
            self._then = self._then if used is None else used
            self._next = time.perf_counter() + seconds


def on_free_cores(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Let all of a function compute with the threads that there are cores for (Cores)."""

    @functools.wraps(function)
    def within(*given: Given.args, **named: Given.kwargs) -> Result:
        with Cores(torch.device("cpu")):
            return function(*given, **named)

    return within


def _set(threads: int) -> None:
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)


def _used() -> Used | None:
    """Return what has been used so far; None where the system does not tell."""
    import psutil

    try:
        cores = psutil.cpu_times(percpu=True)
        allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(len(cores))
        if not cores or max(allowed) >= len(cores):  # rows that are not those of the numbers
            return None
        own = psutil.Process().cpu_times()
    except (OSError, psutil.Error):
        return None
    idle = sum(cores[i].idle + getattr(cores[i], "iowait", 0.0) for i in allowed)
    counted = sum(sum(cores[i]) for i in allowed)
    return Used(time.perf_counter(), idle, counted, own.user + own.system)


def _quota() -> int:
    """Return how many cores a container may use, by the kernel's rule for its group; many where there is none."""
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return sys.maxsize if quota == "max" else max(1, math.floor(int(quota) / int(period) + LEAST))
    except (OSError, ValueError):
        return sys.maxsize


def resolve_device(name: str) -> torch.device:
    """Return the device called `name`; "auto" is the GPU where there is one. "cuda" is the first, under torchrun the
    process's own.

    Raises
    ------
    InputError
        If the device does not exist here.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError(f"expected auto, cpu, cuda or cuda:N, got '{name}'", field="device") from None
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"expected auto, cpu, cuda or cuda:N, got '{name}'", field="device")
    if name == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))  # torchrun: a GPU for each process
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(
            f"expected one of {torch.cuda.device_count()} GPUs, got '{name}'; use --device cpu, "
            "or install the CUDA build of torch",
            field="device",
        )
    return device


def autocast_dtype(precision: str, device: torch.device) -> torch.dtype | None:
    """Return bfloat16 where the precision asks for it (or, with "auto", where the hardware has it), else None."""
    if device.type == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        fast = bool(torch.cpu._is_avx512_bf16_supported())
    if precision == "bf16" or (precision == "auto" and fast):
        return torch.bfloat16
    return None


@contextmanager
def float32_products(precision: Literal["highest", "high"]) -> Iterator[None]:
    """Set the precision of torch's products of float32 matrices within a block; "high" is TF32 on CUDA.

    Directions of rays lose 9e-5 rad to TF32, so that only a network may run with it.
    """
    try:
        before = torch.get_float32_matmul_precision()
    except RuntimeError:  # the process has set CUDA's alone, by torch's newer switch
        before = "high" if torch.backends.cuda.matmul.fp32_precision == "tf32" else "highest"
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def available_memory(device: torch.device) -> int:
    """Return the free memory in bytes: of a GPU, or of the machine and what a container or job leaves of it."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    import psutil

    free = int(psutil.virtual_memory().available)
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
        return free if limit == "max" else min(free, max(0, int(limit) - used))
    except (OSError, ValueError):  # no such limit here
        return free


def peak_memory(device: torch.device) -> int:
    """Return the highest memory in bytes: of tensors on a GPU, of the whole process on a CPU."""
    if device.type == "cuda":
        return int(torch.cuda.max_memory_allocated(device))
    try:
        import resource
    except ImportError:  # not on Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak if sys.platform == "darwin" else peak * 1024)


def keep_freed_memory() -> None:
    """Ask glibc to keep freed blocks for the next step, rather than hand megabytes back to the kernel each time.

    A step on the CPU allocates the same few arrays again and again; with the default thresholds their pages are
    unmapped and zeroed anew every time, which takes as long as the arithmetic (docs/decisions/006).
    """
    if platform.libc_ver()[0] != "glibc":
        return
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3  # malloc.h
    libc = ctypes.CDLL(None)
    for option, value in ((mmap_threshold, 32 << 20), (trim_threshold, 1 << 30), (top_pad, 64 << 20)):
        libc.mallopt(option, value)
