"""Write the report of a result or of a sequence."""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path

from nerif.data.velocity_sequence import VelocitySequence, open_volumes
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.report import html
from nerif.report.sequence_page import render_sequence
from nerif.report.velocity_page import render_velocity
from nerif.results.directory import REPORT, Result, ResultDirectory

__all__ = ["write_report", "write_sequence_report"]


def write_report(
    directory: str | os.PathLike[str], path: Path | None = None, monitor: Monitor = QUIET, result: Result | None = None
) -> Path:
    """Write the report of a result directory, and return its path; `result`: its content, if it has been read."""
    out = ResultDirectory(directory, monitor.say)
    path = path or out / REPORT
    with monitor.counting("writing the report"):
        result = result or out.read()
        page = html.render(result)
    with out.writing(REPORT) if path == out / REPORT else nullcontext():
        html.write(page, path)
    for gap in result.missing:
        monitor.say(f"missing: {gap.sentence}")
    _say_size(path, monitor)
    return path


def write_sequence_report(store: str | os.PathLike[str], path: Path | None = None, monitor: Monitor = QUIET) -> Path:
    """Write the report of a store of nerif sequence, complete or not, or of a velocity, and return its path."""
    path = path or Path(store).with_suffix(".html")
    volumes = open_volumes(store)
    html.write(render_velocity(volumes) if isinstance(volumes, VelocitySequence) else render_sequence(volumes), path)
    _say_size(path, monitor)
    return path


def _say_size(path: Path, monitor: Monitor) -> None:
    size = path.stat().st_size
    monitor.say(f"{path}: {f'{size / 1e6:.1f} MB' if size > 1e6 else f'{size / 1e3:.0f} kB'}; open it in a browser")
