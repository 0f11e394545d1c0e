"""nerif report: the HTML report of a result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from nerif.cli.arguments import check_output
from nerif.cli.output import MONITOR
from nerif.cli.settings import Settings, command
from nerif.common.files import ending
from nerif.common.settings import Positional

__all__ = ["Report", "main", "run"]


@dataclass(frozen=True)
class Report(Settings):
    """Write the report of a result as one HTML file, which needs no network."""

    result: Annotated[Path, Positional]
    """Result directory of nerif reconstruct, or store of nerif sequence (.zarr), complete or not."""
    out: Path | None = None
    """File to write (default: RESULT/report.html, or RESULT.html of a store; always overwritten)."""
    force: bool = False
    """Overwrite the file given by --out."""


def run(settings: Report) -> Path:
    """Write the report, and print what it lacks."""
    from nerif.workflow.reports import write_report, write_sequence_report

    if settings.out is not None:
        check_output(settings.out, settings.force, endings=(".html", ".htm"))
    write = write_sequence_report if ending(settings.result) == ".zarr" else write_report
    return write(settings.result, settings.out, MONITOR)


main = command("report", Report, run)
