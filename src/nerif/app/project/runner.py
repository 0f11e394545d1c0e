"""Run nerif in a process that outlives the server: `python -m nerif.app.project.runner DIRECTORY ARGUMENTS`.

The process id with its start time, and later the exit code, are written to the directory. Of two processes of one
directory, the second starts nothing.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.common.files import write_json
from nerif.common.interruption import OWN_GROUP, interrupt
from nerif.common.locks import locked

__all__ = ["ENDED", "JOB", "LOG", "STARTED", "began", "main"]

JOB, STARTED, ENDED, LOG = "job.json", "started.json", "ended.json", "log.txt"


def main(directory: Path, words: Sequence[str]) -> None:
    """Run nerif with these arguments and wait for its end, unless that has been started already."""
    with locked(directory, inside=True):
        if not (directory / STARTED).exists():
            _run(directory, words)


def _run(directory: Path, words: Sequence[str]) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have set it to be ignored
    arguments = [sys.executable, "-P", "-m", "nerif", *words]  # -P: import no module of the folder
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with (directory / LOG).open("ab") as log:
        process = subprocess.Popen(
            arguments, cwd=directory.parents[2], stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment,
            **OWN_GROUP,
        )  # fmt: skip
        write_json(directory / STARTED, {"pid": process.pid, "began": began(process.pid), "time": time.time()})
        job = json.loads((directory / JOB).read_text(encoding="utf-8"))
        if job["request"]:  # to stop, before this process could get a signal
            interrupt(process.pid)
        code = process.wait()
    write_json(directory / ENDED, {"code": code, "time": time.time()})


def began(pid: int) -> str:
    """Return the start of a process, different for a later one of the same number; empty if there is none.

    On Linux that is the start of the system and the ticks since then: a time of day changes when the clock is set.
    """
    import psutil

    try:
        process = psutil.Process(pid)
        if process.status() == psutil.STATUS_ZOMBIE:
            return ""
        if not psutil.LINUX:  # where the system keeps the time of day at the start
            return f"{process.create_time():.2f}"
        boot, stat = Path("/proc/sys/kernel/random/boot_id"), Path(f"/proc/{pid}/stat")
        ticks = stat.read_bytes().rpartition(b")")[2].split()[19].decode()
        return f"{boot.read_text(encoding='utf-8')[:8] if boot.is_file() else ''}.{ticks}"
    except (psutil.Error, OSError):
        return ""


if __name__ == "__main__":
    with suppress(InputError):  # another process runs it
        main(Path(sys.argv[1]), sys.argv[2:])
