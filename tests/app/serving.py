"""A server of the app in a process of its own, on a free port."""

from __future__ import annotations

import http.client
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from report.browsing import wait_for

__all__ = ["Served", "answering", "free_port", "opened", "outside", "served"]


@dataclass(frozen=True)
class Served:
    """A server that answers.

    Parameters
    ----------
    folder : of the project
    link : address with the token
    port : that it listens on
    output : its first lines
    """

    folder: Path
    link: str
    port: int
    output: str

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
    """The environment without pytest's variables, with which NiceGUI behaves otherwise."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    return {**environment, "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}


@contextmanager
def served(folder: Path, *arguments: str, by: Sequence[str] = (), cwd: Path | None = None) -> Iterator[Served]:
    """Start nerif app on a folder, by way of another command if one is given, and end it by force."""
    words = [*by, sys.executable, "-P", "-m", "nerif", "app", str(folder), "--no-browser", "--port", str(free_port())]
    with subprocess.Popen(
        [*words, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=outside(), cwd=cwd
    ) as process:
        assert process.stdout is not None
        try:
            yield answering(folder, process.stdout)
        finally:
            process.kill()


def answering(folder: Path, printed: Iterable[str]) -> Served:
    """Wait until a server says that it answers."""
    output = ""
    for line in printed:
        output += line
        if match := re.search(r"http://[^:]+:(\d+)/\?token=\S+", line):
            return Served(folder, match[0], int(match[1]), output)
    raise AssertionError(f"it did not start: {output}")


def opened(driver: Any, server: Served, page: str, ready: str) -> None:
    """Open a page, and wait until it answers and a script says that all is there; forget what was logged before."""
    driver.get_log("browser")
    driver.get_log("performance")
    driver.get(f"http://127.0.0.1:{server.port}/{page}?token={server.token}")
    wait_for(driver, f"return ({ready}) && window.socket?.connected")
