"""Standard output whose reader has ended, as in `nerif info FILE | head -2`."""

from __future__ import annotations

import errno
import os
import sys

from nerif.common.files import WINDOWS

__all__ = ["is_closed_output", "silence"]


def is_closed_output(error: OSError) -> bool:
    """Return whether the reader of standard output has ended; Windows calls that an invalid argument (bpo-35754)."""
    is_invalid = WINDOWS and error.errno == errno.EINVAL and error.filename is None
    return isinstance(error, BrokenPipeError) or is_invalid


def silence() -> None:
    """Discard all further standard output."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
