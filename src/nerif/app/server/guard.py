"""Access control: only the browser with the token, on a page of this server.

Every request, whether for a page, a static file or the websocket, is refused unless

    Host      is an address of this server,     (against DNS rebinding)
              or one that --allowed-host states
    Origin    is this server, if it is sent     (other pages may neither post nor open websockets)
    cookie    is that of the session            (or the token in the address, which is exchanged for the cookie)

Pages load nothing from other servers (Content-Security-Policy).
"""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Awaitable, Callable, Collection, MutableMapping
from typing import Any
from urllib.parse import parse_qsl, unquote, urlencode

__all__ = ["ADDRESS", "Guard", "cookie_of"]

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]

POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; worker-src 'self' blob:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'; object-src 'none'"
)
HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
OPEN = (
    "Open the address that nerif app printed, with its token; through a tunnel or a proxy, the address of that, with "
    "/?token=... from the one printed."
)
ADDRESS = re.compile(r"(?:[\w.-]+|\[[\da-f:.]+\])(?::\d{1,5})?", re.ASCII | re.IGNORECASE)
"""A host name or IP address, maybe with a port."""
MOST_REPORTED = 10  # refused addresses


def cookie_of(token: str) -> str:
    """Return the value of the cookie: a hash from which the token cannot be computed."""
    return hashlib.sha256(b"nerif app session " + token.encode()).hexdigest()


class Guard:
    """ASGI middleware that refuses requests without token or cookie.

    Parameters
    ----------
    app : ASGI application behind the guard
    token : token in the address
    hosts : names and addresses of this server, without port
    port : port of this server
    allowed : addresses of tunnels and proxies that lead to it, as in the browser's address bar, with their port
    root : path that a proxy puts in front, which it may remove or keep; pages link to addresses with it
    say : called once with a line about each address that is refused
    """

    def __init__(
        self, app: Any, token: str, hosts: Collection[str], port: int, allowed: Collection[str] = (), root: str = "",
        say: Callable[[str], None] = lambda line: None,
    ) -> None:  # fmt: skip
        self.app, self.token, self.cookie, self.root, self.say = app, token, cookie_of(token), root, say
        self.refused: set[str] = set()
        self.name = f"nerif-{port}"  # cookies do not depend on the port
        self.addresses = {f"{host}:{port}".lower() for host in hosts}
        if port == 80:
            self.addresses |= {host.lower() for host in hosts}
        self.addresses |= {address.lower() for address in allowed}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request to the application, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        lines = [(name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in scope["headers"]]
        headers, cookies = dict(lines), ";".join(value for name, value in lines if name == "cookie")
        host, origin = headers.get("host", ""), headers.get("origin", "")
        if host.lower() not in self.addresses:
            await _refuse(scope, receive, send, 421, self._remedy("This is not an address of this server", host))
        elif "origin" in headers and not self._same_origin(origin):
            why = self._remedy("The request came from another page", origin.partition("://")[2])
            await _refuse(scope, receive, send, 403, why)
        elif self._has_cookie(cookies):
            await self._pass(self._rooted(scope), receive, send)
        elif scope["type"] == "http" and self._has_token(scope):
            await self._exchange(scope, send)
        else:
            await _refuse(scope, receive, send, 403, OPEN)

    def _remedy(self, problem: str, address: str) -> str:
        """Return and report the problem with an address, and the option for tunnels and proxies."""
        if not ADDRESS.fullmatch(address):
            return f"{problem}."
        text = (
            f"{problem}: {address}. If that is a tunnel or proxy of yours, start nerif app with --allowed-host "
            f"{address} (and --root-path /PATH, if the proxy puts a path in front). Otherwise leave this page."
        )
        if address not in self.refused and len(self.refused) < MOST_REPORTED:
            self.refused.add(address)
            self.say(f"refused: {text}")
        return text

    def _rooted(self, scope: Scope) -> Scope:
        """Return the request with the root path by which pages link, and without one that the request states."""
        headers = [(name, value) for name, value in scope["headers"] if name.lower() != b"x-forwarded-prefix"]
        return {**scope, "headers": headers, "root_path": self.root, "path": self.root + self._inner(scope["path"])}

    def _inner(self, path: str) -> str:
        """Return a path without the root."""
        for root in (self.root, unquote(self.root)):
            if path == root or path.startswith(f"{root}/"):
                path = path.removeprefix(root)
                break
        return "/" + path.lstrip("/\\")

    def _same_origin(self, origin: str) -> bool:
        scheme, _, host = origin.lower().partition("://")
        return scheme in ("http", "https") and host in self.addresses

    def _has_cookie(self, cookies: str) -> bool:
        """Return whether the cookies, of any program on this machine, include that of the session."""
        pairs = (cookie.partition("=") for cookie in cookies.split(";"))
        values = [value.strip() for name, _, value in pairs if name.strip() == self.name]
        return any(hmac.compare_digest(value.encode(), self.cookie.encode()) for value in values)

    def _has_token(self, scope: Scope) -> bool:
        query = dict(parse_qsl(scope["query_string"].decode("latin-1")))
        return hmac.compare_digest(query.get("token", "").encode(), self.token.encode())

    async def _pass(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def with_headers(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                headers = list(message.get("headers", ()))
                names = {name.lower() for name, _ in headers}  # a response may set its own policy
                message["headers"] = [*headers, *((name, value) for name, value in HEADERS if name not in names)]
            await send(message)

        await self.app(scope, receive, with_headers)

    async def _exchange(self, scope: Scope, send: Send) -> None:
        """Set the cookie and reload the page without the token in its address."""
        # by a refresh: after a link from another site, browsers send no SameSite=Strict cookie along an HTTP redirect
        rest = [(k, v) for k, v in parse_qsl(scope["query_string"].decode("latin-1")) if k != "token"]
        where = self.root + self._inner(scope["path"]) + ("?" + urlencode(rest) if rest else "")
        headers = [
            (b"refresh", b"0; url=" + where.encode("ascii", "ignore").replace(b"\r", b"").replace(b"\n", b"")),
            (b"content-type", b"text/plain; charset=utf-8"),
            (b"set-cookie", f"{self.name}={self.cookie}; HttpOnly; SameSite=Strict; Path={self.root or '/'}".encode()),
            (b"cache-control", b"no-store"),
            *HEADERS,
        ]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await receive()  # websocket.connect; closing before accepting answers with 403
        await send({"type": "websocket.close", "code": 1008})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"cache-control", b"no-store"), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": why.encode()})
