"""Access control: only the browser with the token, on a page of this server.

Every request, whether for a page, a static file or the websocket, is refused unless

    Host      is an address of this server      (against DNS rebinding)
    Origin    is this server, if it is sent     (other pages may neither post nor open websockets)
    cookie    is that of the session            (or the token in the address, which is exchanged for the cookie)

Pages load nothing from other servers (Content-Security-Policy).
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
    """

    def __init__(self, app: Any, token: str, hosts: Collection[str], port: int) -> None:
        self.app, self.token, self.cookie = app, token, cookie_of(token)
        self.name = f"nerif-{port}"  # cookies do not depend on the port
        self.addresses = {f"{host}:{port}".lower() for host in hosts}
        if port == 80:
            self.addresses |= {host.lower() for host in hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request to the application, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        lines = [(name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in scope["headers"]]
        headers, cookies = dict(lines), ";".join(value for name, value in lines if name == "cookie")
        if headers.get("host", "").lower() not in self.addresses:
            await _refuse(scope, receive, send, 421, "This is not an address of this server.")
        elif "origin" in headers and not self._same_origin(headers["origin"]):
            await _refuse(scope, receive, send, 403, "The request came from another page.")
        elif self._has_cookie(cookies):
            await self._pass(scope, receive, send)
        elif scope["type"] == "http" and self._has_token(scope):
            await self._exchange(scope, send)
        else:
            await _refuse(scope, receive, send, 403, "Open the address printed by nerif app, with its token.")

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
        await receive()  # websocket.connect; closing before accepting answers with 403
        await send({"type": "websocket.close", "code": 1008})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"cache-control", b"no-store"), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": why.encode()})
