"""nerif report: one page that shows a result, and says whether it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import MONITOR, check_file
from nerif.cli.commands.settings import Settings, read_settings
from nerif.common.conventions import InputError
from nerif.results.directory import REPORT
from nerif.workflow.pipeline import write_report, write_sequence_report

__all__ = ["Report", "main", "run"]


@dataclass(frozen=True)
class Report(Settings):
    """Write a page that shows a result: one HTML file, no network, opens from disk."""

    result: Annotated[Path, tyro.conf.Positional]
    """Result directory of nerif reconstruct, or store of nerif sequence (.zarr), finished or not."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """File to write; default: RESULT/report.html, or RESULT.html of a store, written anew each time."""
    force: bool = False
    """Overwrite the file that --out names."""


def run(settings: Report) -> Path:
    """Write the page, and say what could not be shown."""
    is_store = settings.result.suffix == ".zarr"
    out = settings.out or (settings.result.with_suffix(".html") if is_store else settings.result / REPORT)
    if out.suffix not in (".html", ".htm"):
        raise InputError(f"expected a name ending in .html, got '{out.name}'", field="out")
    if settings.out is not None:
        check_file(out, settings.force)
    elif not out.parent.is_dir():
        raise InputError("no such directory", field=settings.result)
    write = write_sequence_report if is_store else write_report
    return write(settings.result, out, MONITOR)


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Report(tyro.MISSING), arguments, "report"))
