"""A server of the app in a process of its own, on a free port."""

from __future__ import annotations

import atexit
import http.client
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

from report.browsing import wait_for

__all__ = ["Served", "answering", "free_port", "opened", "outside", "served"]


@dataclass(frozen=True)
class Served:
    """A server that answers.

    Parameters
    ----------
    link : address with the token
    port : that it listens on
    pid : number of its process
    said : its first lines
    folder : of the project
    """

    link: str
    port: int
    pid: int
    said: str
    folder: Path = Path()

    @property
    def token(self) -> str:
        """Of the address."""
        return self.link.partition("token=")[2]

    def get(self, path: str, headers: Mapping[str, str] | None = None) -> tuple[int, dict[str, str], str]:
        """Ask for a path: status, headers and text of the answer."""
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)) as connection:
            connection.request("GET", path, headers={"Host": f"127.0.0.1:{self.port}", **(headers or {})})
            answer = connection.getresponse()
            text = answer.read().decode("utf-8", "replace")
            return answer.status, {k.lower(): v for k, v in answer.getheaders()}, text

    def cookie(self) -> str:
        """The cookie that the token is exchanged for."""
        return self.get(f"/?token={self.token}")[1]["set-cookie"].partition(";")[0]


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def outside() -> dict[str, str]:
    """The environment without what tells of a test: NiceGUI behaves otherwise where it is told of one."""
    known = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    return {**known, "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}


@cache
def nursery() -> subprocess.Popen[str]:
    """The process that forks servers, as long as these tests go on."""
    words = [sys.executable, str(Path(__file__).with_name("nursery.py"))]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=outside())

    def end() -> None:
        process.communicate(timeout=20)

    atexit.register(end)
    return process


def forked(words: Sequence[str], out: Path, by: Sequence[str] = ()) -> tuple[int, IO[str]]:
    """Let the nursery start `nerif ...`: process number, and what it prints."""
    process = nursery()
    assert process.stdin is not None
    assert process.stdout is not None
    os.mkfifo(out)
    process.stdin.write(json.dumps({"words": list(words), "out": str(out), "by": list(by)}) + "\n")
    process.stdin.flush()
    return int(process.stdout.readline()), out.open()


@contextmanager
def served(folder: Path, *arguments: str, port: int | None = None, by: Sequence[str] = ()) -> Iterator[Served]:
    """Start nerif app on a folder, by way of another command if one is given, and end it by force."""
    words = ["app", str(folder), "--no-browser", "--port", str(port or free_port()), *arguments]
    with TemporaryDirectory() as place:
        pid, printed = forked(words, Path(place) / "out", by)
        with printed:
            try:
                yield replace(answering(pid, printed), folder=folder)
            finally:
                end(pid, printed)


def answering(pid: int, printed: Iterable[str]) -> Served:
    """Wait until a server says that it answers."""
    said = ""
    for line in printed:
        said += line
        if found := re.search(r"http://[^:]+:(\d+)/\?token=\S+", line):
            return Served(found[0], int(found[1]), pid, said)
    raise AssertionError(f"it did not start: {said}")


def end(pid: int, printed: IO[str]) -> None:
    """End a server at once; one that has ended is left alone."""
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    until = time.monotonic() + 20
    while time.monotonic() < until:
        ready, _, _ = select.select([printed], [], [], 0.2)
        if ready and not os.read(printed.fileno(), 65536):  # nobody can write into it any more
            return
    raise AssertionError(f"process {pid} does not end")


def opened(driver: Any, server: Served, page: str, ready: str) -> None:
    """Open a page, and wait until it answers and a script says that all is there; forget what was logged before."""
    driver.get_log("browser")
    driver.get_log("performance")
    driver.get(f"http://127.0.0.1:{server.port}/{page}?token={server.token}")
    wait_for(driver, f"return ({ready}) && window.socket?.connected")
