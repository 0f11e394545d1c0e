"""Device, precision, memory and threads of a computation.

Torch and Numba use the same number of threads, at most the number of cores that no other program uses. Threads that
share a step wait for each other: two threads on two cores, one of them busy, take eight times as long as one thread
(docs/decisions/026).
"""

from __future__ import annotations

import ctypes
import functools
import math
import os
import platform
import stat
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal, NamedTuple, ParamSpec, TypeVar

import torch

from nerif.common.conventions import InputError
from nerif.common.memory import free_memory
from nerif.common.pauses import at_pauses
from nerif.common.transfer import double_device

__all__ = [
    "FAST", "Cores", "autocast_dtype", "available_memory", "float32_products", "free_threads",
    "keep_compiled_code_private", "keep_freed_memory", "on_free_cores", "peak_memory", "remark_on", "resolve_device",
    "share_threads",
]  # fmt: skip

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

FAST = ("cuda", "xpu")
"""Types of device that multiply matrices faster in bfloat16, and for which PyTorch compiles networks.

"auto" is the first of them that is there. ROCm's is "cuda". Apple's "mps" is used on request only: it has neither, no
double precision, and no twin of the compiled step for CPUs, so it is not known to be faster.
"""
BUILDS = {
    "cuda": "the CUDA or ROCm build of PyTorch",
    "xpu": "the XPU build of PyTorch",
    "mps": "macOS on an Apple GPU",
}

_here = threading.local()  # torch's number of threads is per calling thread, too

FIRST_SECONDS, SECONDS = 0.5, 2.0  # until the first measurement of the cores, and between measurements
MIN_LOAD, SHARED_LOAD = 0.25, 0.8  # of a core, tolerated from others: at least, and divided by the number of threads
CALM, MAX_CALM = 2, 64  # successive measurements with free cores before they are used: at first, at most
MIN_COUNTED = 0.5  # of the time of the cores that their counters must account for


def share_threads() -> None:
    """Give Numba as many threads as torch has.

    When Numba starts its own threads it sets OpenMP's number, which is torch's, to all cores; torch's is set back.
    """
    import numba

    threads = torch.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    _set(threads)


def keep_compiled_code_private() -> None:
    """Let PyTorch keep compiled code, which it unpickles, where only this user can write, unless a place is set.

    Its default has a fixed name in the temporary directory, where another user may have made it. Triton follows.
    """
    if os.name != "posix" or "TORCHINDUCTOR_CACHE_DIR" in os.environ:
        return
    home = os.environ.get("XDG_CACHE_HOME", "")
    try:
        where = (Path(home) if os.path.isabs(home) else Path.home() / ".cache") / "nerif" / "torchinductor"
        where.mkdir(0o700, parents=True, exist_ok=True)
        about = where.lstat()
        is_private = stat.S_ISDIR(about.st_mode) and about.st_uid == os.geteuid() and not about.st_mode & 0o077
    except (OSError, RuntimeError):  # no home, or none to write to
        is_private = False
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(where) if is_private else tempfile.mkdtemp(prefix="nerif-")


def free_threads(idle: float, process: float, most: int) -> int:
    """Return the number of threads to use, from the mean numbers of cores that were idle and that this process used."""
    return next((k for k in range(most, 1, -1) if idle + process + max(MIN_LOAD, SHARED_LOAD / k) >= k), 1)


class Used(NamedTuple):
    """Counters in s: clock; idle time, all time of the cores of this process; time of the process."""

    clock: float
    idle: float
    counted: float
    process: float


class Cores:
    """A context in which torch has as many threads as there are cores idle or used by this process.

    At most as many as when it was entered, and as a container may use; afterwards the number from before. On a machine
    without other load the number is constant, and with it the order of summation. Threads are given up at once, and
    used again when cores have been free for a while, which becomes longer each time it was in vain.

    Cores are measured at the pauses of the thread (pauses.py). A nested context leaves that to the outer one, so that
    short computations do not each begin with all threads. For a GPU nothing is measured.

    Parameters
    ----------
    device : of the computation
    threads : fixed number, so that sums are in the same order on every machine; nested contexts keep it; 0: free cores
    """

    def __init__(self, device: torch.device, threads: int = 0) -> None:
        self.before, self.fixed = torch.get_num_threads(), threads > 0
        self.most = threads or (min(self.before, _quota()) if device.type == "cpu" else self.before)
        self._measures = device.type == "cpu" and self.most > 1 and not self.fixed
        self._next, self._last = 0.0, Used(0.0, 0.0, 0.0, 0.0)
        self._calm, self._patience, self._raised = 0, CALM, False
        self._stack = ExitStack()

    def __enter__(self) -> Cores:
        outer = getattr(_here, "cores", None)
        if outer is None or self.fixed:
            _here.cores = self
            self._stack.callback(_set, self.before)
            self._stack.callback(setattr, _here, "cores", outer)
            self._stack.enter_context(at_pauses(self.look))
            _set(self.most)
            self._measure(FIRST_SECONDS)
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def look(self) -> None:
        """Adapt the number of threads to the load since the last measurement, if that is due."""
        if not self._measures or _here.cores is not self or time.perf_counter() < self._next:
            return
        last = self._last
        self._measure(SECONDS)
        spent = Used(*(b - a for a, b in zip(last, self._last, strict=True)))
        if not self._measures or spent.counted < MIN_COUNTED * self.most * spent.clock:
            return
        free = free_threads(spent.idle / spent.clock, spent.process / spent.clock, self.most)
        threads = torch.get_num_threads()
        self._calm = self._calm + 1 if free > threads else 0
        if free < threads:
            if self._raised:
                self._patience = min(2 * self._patience, MAX_CALM)
            _set(free)
        elif self._calm >= self._patience:
            self._calm, self._raised = 0, True
            _set(free)

    def _measure(self, seconds: float) -> None:
        """Read the counters; the next time is due after some seconds."""
        used = _used() if self._measures else None
        self._measures = used is not None
        if used is not None:
            self._last, self._next = used, time.perf_counter() + seconds


def on_free_cores(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Run a function within Cores."""

    @functools.wraps(function)
    def within(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with Cores(torch.device("cpu")):
            return function(*args, **kwargs)

    return within


def _set(threads: int) -> None:
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)


def _used() -> Used | None:
    """Read the counters of the cores and the process; None if the system does not provide them."""
    import psutil

    try:
        cores = psutil.cpu_times(percpu=True)
        allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(len(cores))
        if not cores or max(allowed) >= len(cores):  # rows do not match the numbers of the cores
            return None
        process = psutil.Process().cpu_times()
    except (OSError, psutil.Error):
        return None
    idle = sum(cores[i].idle + getattr(cores[i], "iowait", 0.0) for i in allowed)
    counted = sum(sum(cores[i]) for i in allowed)
    return Used(time.perf_counter(), idle, counted, process.user + process.system)


def _quota() -> int:
    """The number of cores that a container may use, by the kernel's limit for its group; sys.maxsize without one."""
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="utf-8").split()
        return sys.maxsize if quota == "max" else max(1, math.floor(int(quota) / int(period) + MIN_LOAD))
    except (OSError, ValueError):
        return sys.maxsize


def resolve_device(name: str, dtype: torch.dtype = torch.float32) -> torch.device:
    """Return the device of a name, or the CPU where it does not have the precision.

    "auto" is a GPU of a type in FAST if there is one; "cuda" the first GPU, under torchrun that of the process.
    """
    counts = {kind: int(getattr(torch, kind).device_count()) for kind in BUILDS}
    if name == "auto":
        name = next((kind for kind in FAST if counts[kind]), "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type in BUILDS and device.index is None:
        device = torch.device(device.type, int(os.environ.get("LOCAL_RANK", 0)))
    if device.type != "cpu" and (device.index or 0) >= counts.get(device.type, 0):
        here = ", ".join(["auto", "cpu", *(f"{kind}:{i}" for kind, count in counts.items() for i in range(count))])
        absent = device.type in BUILDS and not counts[device.type]
        remedy = f"; {device.type} needs {BUILDS[device.type]}" if absent else ""
        raise InputError(f"expected a device of this machine ({here}), got '{name}'{remedy}", field="device")
    return double_device(device) if dtype == torch.float64 else device


def remark_on(device: torch.device, dtype: torch.dtype = torch.float32) -> str:
    """Return a remark on what runs on the CPU for lack of double precision, or nothing."""
    if double_device(device) == device:
        return ""
    return f"; {device} has no double precision: {'all' if dtype == torch.float64 else 'what needs it'} ran on the CPU"


def autocast_dtype(precision: str, device: torch.device) -> torch.dtype | None:
    """Return bfloat16 for precision "bf16", and for "auto" if the hardware supports it; else None."""
    if device.type in FAST:
        fast = bool(torch.get_device_module(device).is_bf16_supported(including_emulation=False))
    else:
        fast = device.type == "cpu" and bool(torch.cpu._is_avx512_bf16_supported())
    return torch.bfloat16 if precision == "bf16" or (precision == "auto" and fast) else None


@contextmanager
def float32_products(precision: Literal["highest", "high"]) -> Iterator[None]:
    """Set the precision of torch's products of float32 matrices in a block; "high" is TF32 on CUDA.

    TF32 costs directions of rays 9e-5 rad, so it is for networks only.
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
    """Return the free memory in bytes of a GPU, or of the machine within the limit of a container or job."""
    if device.type in FAST:
        return int(torch.get_device_module(device).mem_get_info(device)[0])
    return free_memory()


def peak_memory(device: torch.device) -> int:
    """Return the highest memory in bytes: of tensors on a GPU, of the whole process on a CPU and Apple's GPU."""
    if device.type in FAST:
        return int(torch.get_device_module(device).max_memory_allocated(device))
    try:
        import resource
    except ImportError:  # Windows
        import psutil

        return int(psutil.Process().memory_info().peak_wset)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak if sys.platform == "darwin" else peak * 1024)


def keep_freed_memory() -> None:
    """Make glibc keep freed blocks for the next step instead of returning them to the kernel.

    A step on the CPU allocates the same few arrays again and again; with the default thresholds their pages are
    unmapped and zeroed each time, which takes as long as the arithmetic (docs/decisions/006).
    """
    if platform.libc_ver()[0] != "glibc":
        return
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3  # malloc.h
    libc = ctypes.CDLL(None)
    for option, value in ((mmap_threshold, 32 << 20), (trim_threshold, 1 << 30), (top_pad, 64 << 20)):
        libc.mallopt(option, value)
