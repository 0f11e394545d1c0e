"""Responses of the server other than pages: reports and isosurfaces.

A report may come from another machine, so it is sandboxed and cannot reach this server. Addresses are relative to the
pages, which a proxy may put below a path.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from urllib.parse import quote, urlencode

import numpy as np
from jaxtyping import Float
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response

from nerif.app.project.workspace import Workspace
from nerif.app.views.result_volumes import source_of
from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.report.isosurface import default_level, stl_of, surface_triangles
from nerif.results.directory import REPORT, ResultDirectory
from nerif.results.live import read_snapshot

__all__ = ["bodies_address", "live_address", "report_address", "report_file", "routes", "surface_address"]

SANDBOX = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
CACHE = "private, max-age=3600"  # the address changes with the file

Respond = Callable[[Workspace, Path, Mapping[str, str]], Response]
Handler = Callable[[Request], Awaitable[Response]]


def report_file(path: Path) -> Path:
    """Return the path of the report of a result directory or of a store over time."""
    return path.with_suffix(".html") if ending(path) == ".zarr" else path / REPORT


def report_address(name: str, stamp: int) -> str:
    """Return the address of a report; `stamp` changes with its file."""
    return _address("report", of=name, stamp=stamp)


def surface_address(name: str, quantity: str, level: float, frame: int, stamp: int) -> str:
    """Return the address of an isosurface."""
    return _address("surface", of=name, quantity=quantity, level=repr(level), frame=frame, stamp=stamp)


def bodies_address(name: str, stamp: int) -> str:
    """Return the address of the surface of the bodies in the flow of a result."""
    return _address("bodies", of=name, stamp=stamp)


def live_address(name: str, stamp: int) -> str:
    """Return the address of the isosurface of the last preview of a run."""
    return _address("live-surface", of=name, stamp=stamp)


def _address(path: str, **query: str | int) -> str:
    return f"{path}?{urlencode(query, quote_via=quote)}"


def _report(work: Workspace, path: Path, query: Mapping[str, str]) -> Response:
    file = work.project.path(report_file(path))
    if not file.is_file():
        raise InputError("There is no report yet: nerif report writes it.")
    headers = {"content-security-policy": SANDBOX, "cache-control": CACHE}
    return FileResponse(file, media_type="text/html; charset=utf-8", headers=headers)


def _surface(work: Workspace, path: Path, query: Mapping[str, str]) -> Response:
    level, frame = float(query.get("level", "0")), int(query.get("frame", "0"))
    return _stl(surface_triangles(source_of(path).volume(query.get("quantity", ""), frame), level))


def _live_surface(work: Workspace, path: Path, query: Mapping[str, str]) -> Response:
    snapshot = read_snapshot(path)
    if snapshot is None:
        raise InputError("There is no preview of the field yet.")
    return _stl(surface_triangles(snapshot.volume, default_level(snapshot.volume)))


def _bodies(work: Workspace, path: Path, query: Mapping[str, str]) -> Response:
    bodies = ResultDirectory(path).bodies()
    return _stl(np.concatenate([body.corners.numpy() for body in bodies] or [np.zeros((0, 3, 3))]))


def _stl(triangles: Float[np.ndarray, "n 3 3"]) -> Response:
    return Response(stl_of(triangles), media_type="model/stl", headers={"cache-control": CACHE})


RESPONSES = {"/report": _report, "/surface": _surface, "/live-surface": _live_surface, "/bodies": _bodies}


def routes(work: Workspace) -> dict[str, Handler]:
    """Return the handlers of requests by their path; they respond with 404 to invalid ones."""

    def handler(respond: Respond) -> Handler:
        async def handle(request: Request) -> Response:
            query = request.query_params
            try:
                return await work.in_thread(respond, work, work.project.path(query.get("of", "")), query)
            except ValueError as error:  # also an InputError
                return PlainTextResponse(str(error), 404)

        return handle

    return {path: handler(respond) for path, respond in RESPONSES.items()}
