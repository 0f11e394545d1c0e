"""nerif app: all steps from design to results in a browser."""

from __future__ import annotations

import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from nerif.app.server.guard import ADDRESS
from nerif.cli.settings import Settings, compute, read_settings
from nerif.common.conventions import InputError
from nerif.common.installation import install
from nerif.common.settings import Append, Positional

__all__ = ["App", "main", "run"]


@dataclass(frozen=True)
class App(Settings):
    """Work on a folder in the browser: design, images, calibration, reconstruction, results.

    Each step shows its command line; runs continue when page and server are closed.
    """

    folder: Annotated[Path | None, Positional] = None
    """Folder of the project, by default the current one; files outside it are neither read nor written. A result
    directory opens on the page Results."""
    demo: bool = False
    """Render a small experiment into a new folder (by default nerif-demo), with a guide that leads through all
    pages."""
    port: Annotated[int, Ge(1), Le(65535)] = 8620
    """Port to listen on; if it is in use, the next free one."""
    host: str = "127.0.0.1"
    """Address to listen on. Any other than this machine's own needs --token: everyone with access and the token can run
    nerif here and read and write the folder. The connection is not encrypted."""
    token: str | None = None
    """Token in the address, 16 characters or more; without it a new random one at each start. Other users of this
    machine can read the command line: set the token in a --config file that they cannot read."""
    allowed_host: Annotated[tuple[str, ...], Append] = ()
    """Address of a tunnel or proxy of yours that leads here, with its port, as the browser shows it: localhost:9000,
    hub.example.org. Once for each; all others are refused."""
    root_path: str = ""
    """Path that a proxy puts in front, such as /user/me/proxy/8620 of JupyterHub."""
    browser: bool = True
    """Open the browser."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for address in self.allowed_host:
            if not ADDRESS.fullmatch(address):
                raise InputError(
                    f"expected HOST or HOST:PORT as the browser shows it, such as localhost:9000, got '{address}'",
                    field="allowed_host",
                )
        if self.root_path and not re.fullmatch(r"(/[\w.~@%+-]+)+/?", self.root_path, re.ASCII):
            raise InputError(f"expected a path such as /user/me/proxy/8620, got '{self.root_path}'", field="root_path")
        if self.token is not None and not re.fullmatch(r"[\w.~-]{16,}", self.token, re.ASCII):
            raise InputError(
                f"expected 16 or more of A-Z a-z 0-9 _ . ~ -, got {len(self.token)} characters", field="token"
            )


def run(settings: App) -> None:
    """Start the server; Ctrl-C ends it."""
    if importlib.util.find_spec("nicegui") is None:
        raise InputError(f"expected NiceGUI, which is not installed; {install('app')}", field="app")
    from nerif.app.server.server import Address, serve

    address = Address.of(
        settings.host, settings.port, settings.token, settings.allowed_host, settings.root_path.rstrip("/")
    )
    folder = settings.folder or Path(".")
    if settings.demo:
        from nerif.app.project.demo_project import FOLDER, fill

        folder = settings.folder or FOLDER
        fill(folder)
    serve(folder, address, settings.browser)


def main(arguments: list[str]) -> None:
    """Parse the arguments and start the server."""
    compute(run, read_settings(App(), arguments, "app"))
