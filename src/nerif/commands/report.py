"""nerif report: one page that shows a result, and says whether it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nerif.commands.output import check_file, say
from nerif.commands.settings import Settings, read_settings
from nerif.conventions import InputError
from nerif.report import html
from nerif.report.result import REPORT, read_result
from nerif.report.sequence_page import render_sequence
from nerif.volume_sequence import VolumeSequence

__all__ = ["Report", "main", "run", "write_report"]


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
        raise InputError(f"out: expected a name ending in .html, got '{out.name}'")
    if settings.out is not None:
        check_file(out, settings.force)
    elif not out.parent.is_dir():
        raise InputError(f"{settings.result}: no such directory")
    if is_store:
        html.write(render_sequence(VolumeSequence(settings.result)), out)
        _say_size(out)
        return out
    return write_report(settings.result, out)


def write_report(directory: Path, out: Path | None = None) -> Path:
    """Write the page of a result directory and return its path."""
    out = out or directory / REPORT
    result = read_result(directory)
    html.write(html.render(result), out)
    for gap in result.missing:
        say(f"missing: {gap.sentence}")
    _say_size(out)
    return out


def _say_size(out: Path) -> None:
    size = out.stat().st_size
    say(f"{out}: {f'{size / 1e6:.1f} MB' if size > 1e6 else f'{size / 1e3:.0f} kB'}; open it in a browser")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Report(tyro.MISSING), arguments, "report"))
