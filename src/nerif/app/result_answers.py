"""Responses of the server other than pages: reports and isosurfaces.

A report may come from another machine, so it is sandboxed and cannot reach this server.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from urllib.parse import quote, urlencode

from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response

from nerif.app.result_volumes import source_of
from nerif.app.workspace import Workspace
from nerif.common.conventions import InputError
from nerif.report.isosurface import default_level, stl_of, surface_triangles
from nerif.results.directory import REPORT
from nerif.results.live import read_look

__all__ = ["ROUTES", "live_address", "report_address", "report_file", "surface_address"]

SANDBOX = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
CACHE = "private, max-age=3600"  # the address changes with the file

Answer = Callable[[Request], Awaitable[Response]]


def report_file(path: Path) -> Path:
    """Return the path of the report of a result directory or of a store over time."""
    return path.with_suffix(".html") if path.suffix == ".zarr" else path / REPORT


def report_address(name: str, stamp: int) -> str:
    """Return the address of a report; `stamp` changes with its file."""
    return "/report?" + urlencode({"of": name, "stamp": stamp}, quote_via=quote)


def surface_address(name: str, quantity: str, level: float, frame: int, stamp: int) -> str:
    """Return the address of an isosurface."""
    query = {"of": name, "quantity": quantity, "level": repr(level), "frame": frame, "stamp": stamp}
    return "/surface?" + urlencode(query, quote_via=quote)


def live_address(name: str, stamp: int) -> str:
    """Return the address of the isosurface of the last preview of a run."""
    return "/live-surface?" + urlencode({"of": name, "stamp": stamp}, quote_via=quote)


def _report(work: Workspace) -> Answer:
    async def answer(request: Request) -> Response:
        try:
            file = work.project.path(report_file(work.project.path(request.query_params.get("of", ""))))
        except InputError as error:
            return PlainTextResponse(str(error), 404)
        if not file.is_file():
            return PlainTextResponse("There is no report yet: nerif report writes it.", 404)
        headers = {"content-security-policy": SANDBOX, "cache-control": CACHE}
        return FileResponse(file, media_type="text/html; charset=utf-8", headers=headers)

    return answer


def _surface(work: Workspace) -> Answer:
    def made(name: str, quantity: str, level: float, frame: int) -> bytes:
        return stl_of(surface_triangles(source_of(work.project.path(name)).volume(quantity, frame), level))

    async def answer(request: Request) -> Response:
        query = request.query_params
        try:
            level, frame = float(query.get("level", "0")), int(query.get("frame", "0"))
            stl = await work.in_thread(made, query.get("of", ""), query.get("quantity", ""), level, frame)
        except (InputError, ValueError) as error:
            return PlainTextResponse(str(error), 404)
        return Response(stl, media_type="model/stl", headers={"cache-control": CACHE})

    return answer


def _live(work: Workspace) -> Answer:
    def made(name: str) -> bytes:
        look = read_look(work.project.path(name))
        if look is None:
            raise InputError("There is no preview of the field yet.")
        volume = look.volume
        return stl_of(surface_triangles(volume, default_level(volume)))

    async def answer(request: Request) -> Response:
        try:
            stl = await work.in_thread(made, request.query_params.get("of", ""))
        except InputError as error:
            return PlainTextResponse(str(error), 404)
        return Response(stl, media_type="model/stl", headers={"cache-control": CACHE})

    return answer


ROUTES: dict[str, Callable[[Workspace], Answer]] = {"/report": _report, "/surface": _surface, "/live-surface": _live}
