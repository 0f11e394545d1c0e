"""The memory that the header of a file asks for, checked before it is taken."""

from __future__ import annotations

from pathlib import Path

from nerif.common.conventions import InputError

__all__ = ["check_memory", "free_memory", "is_out_of_memory"]

NOT_CHECKED = 1 << 27  # bytes: masks of one value compress without limit
COMPRESSION = 1032
"""Bytes that one byte holds at most (zlib technical details, "Maximum Compression Factor")."""
OUT_OF_MEMORY = ("not enough memory", "out of memory", "can't allocate memory", "failed to allocate")
"""Parts of the messages of torch, which raises RuntimeError, and OpenCV."""


def check_memory(size: float, path: Path | None, field: object = "") -> None:
    """Refuse data that their file cannot hold, even compressed, or that do not fit into the free memory.

    Parameters
    ----------
    size : of the data as the header states it, bytes
    path : file or folder that holds the data, and possibly more; None to compare with the memory alone
    """
    if size <= NOT_CHECKED:
        return
    if path is not None and size > COMPRESSION * (stored := _stored(path)):
        raise InputError(
            f"damaged header: expected data of the {stored:,} bytes stored, got a size of {size / 1e9:,.1f} GB; "
            "copy or export it again",
            field=field,
        )
    if size > (free := free_memory()):
        raise InputError(
            f"expected data that fit into the free memory ({free / 1e9:.1f} GB), got {size / 1e9:,.1f} GB; close other "
            "programs, or give a part of the data",
            field=field,
        )


def _stored(path: Path) -> int:
    files = (file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files)


def free_memory() -> int:
    """Return the free memory of the machine in bytes, within the limit of a container or job."""
    import psutil

    free = int(psutil.virtual_memory().available)
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text(encoding="utf-8").strip()
        used = int(Path("/sys/fs/cgroup/memory.current").read_text(encoding="utf-8"))
        return free if limit == "max" else min(free, max(0, int(limit) - used))
    except (OSError, ValueError):  # no such limit
        return free


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error, of any library, is a lack of memory."""
    message = str(error).lower()
    return isinstance(error, MemoryError) or any(text in message for text in OUT_OF_MEMORY)
