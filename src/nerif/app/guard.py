"""Who may ask the server anything: the browser that was given the token, on a page of this server.

Each request, of a page, a static file or the websocket, is refused unless

    Host      is an address of this server        (a foreign name that leads here is not: DNS rebinding)
    Origin    is this server, where it is sent    (pages of others may not post or open websockets)
    cookie    is the session's                    (or the token in the address, which is exchanged for the cookie)

Pages may load nothing from elsewhere (Content-Security-Policy).
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Awaitable, Callable, Collection, MutableMapping
from typing import Any
from urllib.parse import parse_qsl, urlencode

__all__ = ["Guard", "cookie_of"]

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


def cookie_of(token: str) -> str:
    """Return what the cookie holds: known to who has the token, and of no use as one."""
    return hashlib.sha256(b"nerif app session " + token.encode()).hexdigest()


class Guard:
    """ASGI middleware that lets nobody else in.

    Parameters
    ----------
    app : what is guarded
    token : of the address
    hosts : names and addresses of this server, without port
    port : of this server
    """

    def __init__(self, app: Any, token: str, hosts: Collection[str], port: int) -> None:
        self.app, self.token, self.cookie = app, token, cookie_of(token)
        self.name = f"nerif-{port}"  # cookies know no ports
        self.allowed = {f"{host}:{port}".lower() for host in hosts}
        if port == 80:
            self.allowed |= {host.lower() for host in hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        lines = [(name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in scope["headers"]]
        headers, cookies = dict(lines), ";".join(value for name, value in lines if name == "cookie")
        if headers.get("host", "").lower() not in self.allowed:
            await _refuse(scope, receive, send, 421, "This address is not the one of this server.")
        elif "origin" in headers and not self._own(headers["origin"]):
            await _refuse(scope, receive, send, 403, "This request comes from another page.")
        elif self._known(cookies):
            await self._pass(scope, receive, send)
        elif scope["type"] == "http" and self._given(scope):
            await self._exchange(scope, send)
        else:
            await _refuse(scope, receive, send, 403, "Open the address that nerif app has printed, with its token.")

    def _own(self, origin: str) -> bool:
        scheme, _, host = origin.lower().partition("://")
        return scheme in ("http", "https") and host in self.allowed

    def _known(self, cookies: str) -> bool:
        """Whether the session's cookie is among those sent: other programs on this machine set theirs, in any form."""
        pairs = (cookie.partition("=") for cookie in cookies.split(";"))
        values = [value.strip() for name, _, value in pairs if name.strip() == self.name]
        return any(hmac.compare_digest(value.encode(), self.cookie.encode()) for value in values)

    def _given(self, scope: Scope) -> bool:
        query = dict(parse_qsl(scope["query_string"].decode("latin-1")))
        return hmac.compare_digest(query.get("token", "").encode(), self.token.encode())

    async def _pass(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def with_headers(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                local = list(message.get("headers", ()))
                named = {name.lower() for name, _ in local}  # an answer may have a policy of its own
                message["headers"] = [*local, *((name, value) for name, value in HEADERS if name not in named)]
            await send(message)

        await self.app(scope, receive, with_headers)

    async def _exchange(self, scope: Scope, send: Send) -> None:
        """Give the cookie, and lead to the same page without the token in its address.

        By a page of this server: where another one led here, a browser does not send a cookie that is SameSite=Strict
        to the target of an HTTP redirect.
        """
        rest = [(k, v) for k, v in parse_qsl(scope["query_string"].decode("latin-1")) if k != "token"]
        where = "/" + scope["path"].lstrip("/\\") + ("?" + urlencode(rest) if rest else "")
        headers = [
            (b"refresh", b"0; url=" + where.encode("ascii", "ignore").replace(b"\r", b"").replace(b"\n", b"")),
            (b"content-type", b"text/plain; charset=utf-8"),
            (b"set-cookie", f"{self.name}={self.cookie}; HttpOnly; SameSite=Strict; Path=/".encode()),
            (b"cache-control", b"no-store"),
            *HEADERS,
        ]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await receive()  # websocket.connect; closed before it is accepted, it is answered with 403
        await send({"type": "websocket.close", "code": 1008})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"cache-control", b"no-store"), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": why.encode()})
