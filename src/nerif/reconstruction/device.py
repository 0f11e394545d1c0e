"""Where to compute, in which precision, and how much memory it took."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import torch

from nerif.common.conventions import InputError

__all__ = [
    "autocast_dtype", "available_memory", "float32_products", "keep_freed_memory", "peak_memory", "resolve_device",
]  # fmt: skip


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
        raise InputError(f"device: expected auto, cpu, cuda or cuda:N, got '{name}'") from None
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"device: expected auto, cpu, cuda or cuda:N, got '{name}'")
    if name == "cuda":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))  # torchrun: a GPU for each process
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(
            f"device: expected one of {torch.cuda.device_count()} GPUs, got '{name}'; use --device cpu, "
            "or install the CUDA build of torch"
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
    unmapped and zeroed anew every time, which takes as long as the arithmetic (benchmarks/README.md).
    """
    if platform.libc_ver()[0] != "glibc":
        return
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3  # malloc.h
    libc = ctypes.CDLL(None)
    for option, value in ((mmap_threshold, 32 << 20), (trim_threshold, 1 << 30), (top_pad, 64 << 20)):
        libc.mallopt(option, value)
