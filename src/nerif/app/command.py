"""nerif app: the whole road in a browser, on this machine."""

from __future__ import annotations

import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.settings import Settings, read_settings
from nerif.common.conventions import InputError
from nerif.common.installation import install

__all__ = ["App", "main", "run"]


@dataclass(frozen=True)
class App(Settings):
    """Work on a folder in the browser: design, images, calibration, reconstruction, results.

    Whatever is done there is a command line, which is shown; runs go on when page and server are closed.
    """

    folder: Annotated[Path, tyro.conf.Positional] = Path(".")
    """Folder of the project; nothing outside of it is read or written."""
    port: int = 8620
    """Port to listen on; the next free one if it is taken."""
    host: str = "127.0.0.1"
    """Address to listen on. Any other than this machine's own needs --token: whoever reaches it and knows the token can
    run nerif here and read and write the folder, and what goes to and fro is not encrypted."""
    token: str | None = None
    """Token in the address, of 16 letters or more; else a random one each time. Other users of the machine can read the
    command line: give it in a --config file that they cannot read."""
    browser: bool = True
    """Open the browser."""

    def __post_init__(self) -> None:
        if not 1 <= self.port <= 65535:
            raise InputError(f"expected 1 to 65535, got {self.port}", field="port")
        if self.token is not None and not re.fullmatch(r"[\w.~-]{16,}", self.token, re.ASCII):
            raise InputError(
                f"expected 16 or more of A-Z a-z 0-9 _ . ~ -, got {len(self.token)} characters", field="token"
            )


def run(settings: App) -> None:
    """Serve until Ctrl-C."""
    if importlib.util.find_spec("nicegui") is None:
        raise InputError(f"expected NiceGUI, which is not installed; {install('app')}", field="app")
    from nerif.app.server import Address, serve

    serve(settings.folder, Address.of(settings.host, settings.port, settings.token), settings.browser)


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(App(), arguments, "app"))
