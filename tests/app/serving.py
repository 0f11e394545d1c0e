"""A server of the app in a process of its own, on a free port."""

from __future__ import annotations

import http.client
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from report.browsing import wait_for

__all__ = ["Served", "opened", "served"]


@dataclass(frozen=True)
class Served:
    """A server that answers.

    Parameters
    ----------
    link : address with the token
    port : that it listens on
    process : of the server
    said : its first lines
    """

    link: str
    port: int
    process: subprocess.Popen[str]
    said: str

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


@contextmanager
def served(folder: Path, *arguments: str, port: int | None = None) -> Iterator[Served]:
    """Start nerif app on a folder, and end it by Ctrl-C."""
    words = [sys.executable, "-m", "nerif", "app", str(folder), "--no-browser", "--port", str(port or free_port())]
    # NiceGUI behaves otherwise where it is told of a test
    outside = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    environment = {**outside, "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [*words, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    )
    assert process.stdout is not None
    said = ""
    try:
        for line in process.stdout:
            said += line
            if found := re.search(r"http://[^:]+:(\d+)/\?token=\S+", line):
                yield Served(found[0], int(found[1]), process, said)
                break
        else:
            raise AssertionError(f"it did not start: {said}")
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def opened(driver: Any, server: Served, page: str, ready: str) -> None:
    """Open a page, and wait until it answers and a script says that all is there; forget what was logged before."""
    driver.get_log("browser")
    driver.get_log("performance")
    driver.get(f"http://127.0.0.1:{server.port}/{page}?token={server.token}")
    wait_for(driver, f"return ({ready}) && window.socket?.connected")
