"""The server: address, access, pages, and the queue of runs."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import secrets
import socket
import webbrowser
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

import psutil
from nicegui import app, background_tasks, ui
from nicegui.server import Server
from starlette.responses import RedirectResponse

from nerif.app.pages import PAGES
from nerif.app.pages.frame import frame
from nerif.app.pages.page import Page
from nerif.app.project.folder import ProjectFolder
from nerif.app.project.workspace import READ_ONLY, Workspace
from nerif.app.server.guard import Guard
from nerif.app.server.private import page_leading_to
from nerif.app.views.routes import routes
from nerif.cli.output import say
from nerif.common.conventions import InputError

__all__ = ["Address", "is_relevant", "serve"]

PORTS = 20  # that are tried
LOCAL = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = ("0.0.0.0", "::")
QUEUE_EVERY = 0.5  # seconds
FAVICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><rect width="32" height="32" rx="6" fill="#0b5a9c"/>'
    '<path d="M6 22c5-12 8 6 13-6 2-4 4-6 7-6" fill="none" stroke="#fff" stroke-width="3"/></svg>'
)


@dataclass(frozen=True)
class Address:
    """Host, port and token of the server."""

    host: str  #: name or IP address to listen on
    port: int  #: port to listen on
    token: str  #: token that a browser must send
    allowed: tuple[str, ...] = ()  #: addresses of tunnels and proxies that lead to the server
    root: str = ""  #: path that a proxy puts in front

    @classmethod
    def of(cls, host: str, port: int, token: str | None, allowed: tuple[str, ...] = (), root: str = "") -> Address:
        """Return an address with a free port; a host that others can reach needs a token, else it is random."""
        if not _is_local(host):
            if token is None:
                raise InputError(
                    f"expected --token together with --host {host}, got none; others can reach that address, and with "
                    "the token they can run nerif here and read and write the folder",
                    field="host",
                )
            say(f"note: others can reach {host}; with the token they can run nerif here and read and write the folder;")
            say("      the connection is not encrypted. Safer: ssh -L 8620:127.0.0.1:8620 THIS_MACHINE")
        free = _free_port(host, port)
        if free != port:
            say(f"port {port} is in use; using {free}")
        return cls(host, free, token or secrets.token_urlsafe(24), allowed, root)

    @property
    def names(self) -> tuple[str, ...]:
        """Host names that a browser may use for this server."""
        names = {self.host}
        if not _is_local(self.host):
            names |= {socket.gethostname(), socket.getfqdn()}
        if self.host in EVERYWHERE:
            names |= _interfaces()
        return (*LOCAL, *sorted(f"[{name}]" if ":" in name else name for name in names))

    @property
    def link(self) -> str:
        """The address to open."""
        host = socket.gethostname() if self.host in EVERYWHERE else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self.query}"

    @property
    def query(self) -> str:
        """The token as the end of an address."""
        return f"?{urlencode({'token': self.token})}"


def serve(folder: Path, address: Address, browser: bool = True) -> None:
    """Serve the pages of a project until Ctrl-C; runs continue after that."""
    work = Workspace(ProjectFolder(folder))
    if not work.project.writable:
        say(f"note: {READ_ONLY}")
    logging.getLogger("uvicorn.error").addFilter(is_relevant)
    app.add_middleware(
        Guard, token=address.token, hosts=address.names, port=address.port, allowed=address.allowed,
        root=address.root, say=say,
    )  # fmt: skip
    first_page = "results" if work.project.is_result else PAGES[0].name
    first_path = f"{'' if address.root else '/'}{first_page}"  # a proxy changes absolute ones
    app.add_api_route("/", lambda: RedirectResponse(first_path), include_in_schema=False)
    for path, handler in routes(work).items():
        app.add_api_route(path, handler, include_in_schema=False)
    for page in PAGES:
        ui.page(page.path, response_timeout=30)(_handler(work, page))

    async def announce() -> None:
        while not Server.instance.started:
            await asyncio.sleep(0.01)
        say(f"{work.project.folder}: {address.link}")
        for host in address.allowed:
            say(f"through a tunnel or proxy: http(s)://{host}{address.root}/{address.query}")
        say("Ctrl-C ends the server; runs continue.")
        if first:
            webbrowser.open(first)

    app.on_startup(lambda: background_tasks.create(announce()))
    app.on_startup(work.contents)  # fills the cache: the first search takes longest
    app.timer(QUEUE_EVERY, work.jobs.advance)
    with ExitStack() as ending:
        first = ending.enter_context(page_leading_to(address.link)) if browser else ""
        try:
            ui.run(
                host=address.host, port=address.port, title="nerif", show=False, reload=False, dark=None,
                language="en-US", tailwind=False, show_welcome_message=False, reconnect_timeout=30.0, favicon=FAVICON,
                access_log=False,
            )  # fmt: skip
        except KeyboardInterrupt:
            say("")
    say("The server has ended; start nerif app to see its runs again.")


def is_relevant(record: logging.LogRecord) -> bool:
    """Whether a record of the server's log is written: not for a request that the browser has cancelled.

    Starlette's BaseHTTPMiddleware raises RuntimeError for it.
    """
    error = record.exc_info[1] if record.exc_info else None
    return not (isinstance(error, RuntimeError) and str(error) == "No response returned.")


def _handler(work: Workspace, page: Page) -> Callable[[], Awaitable[None]]:
    async def build() -> None:
        with frame(work, page, PAGES):
            try:
                coroutine = page.build(work)
                if coroutine is not None:
                    await coroutine
            except (TypeError, ValueError, AttributeError, LookupError):
                if not work.forget_drafts():
                    raise
                ui.navigate.reload()  # with the defaults: drafts of a file may be anything

    return build


def _is_local(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name
        return False


def _interfaces() -> set[str]:
    """The addresses of the network interfaces; the host name may resolve to 127.0.1.1 only."""
    addresses = [address for interface in psutil.net_if_addrs().values() for address in interface]
    return {a.address.partition("%")[0] for a in addresses if a.family in (socket.AF_INET, socket.AF_INET6)}


def _free_port(host: str, port: int) -> int:
    """The first free port from `port` on."""
    reason = "all are in use"
    for number in range(port, min(port + PORTS, 65536)):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            # on Windows SO_REUSEADDR would allow a port that is in use
            probe.setsockopt(socket.SOL_SOCKET, getattr(socket, "SO_EXCLUSIVEADDRUSE", socket.SO_REUSEADDR), 1)
            try:
                probe.bind((host, number))
                return number
            except PermissionError:
                reason = "ports below 1024 need system rights"
            except socket.gaierror:
                raise InputError(f"expected an address of this machine, got '{host}'", field="host") from None
            except OSError as error:
                reason = error.strerror or reason
    raise InputError(f"expected a free port from {port} on, got none: {reason}; set another --port", field="port")
