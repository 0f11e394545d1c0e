"""nerif figures: every figure of a result, as PDF and PNG for print."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import counting_bar, say
from nerif.cli.commands.settings import Settings, read_settings
from nerif.common.conventions import InputError
from nerif.report.pages import JOURNALS, save_figures
from nerif.results.directory import FIGURES, ResultDirectory

__all__ = ["Figures", "main", "run"]


@dataclass(frozen=True)
class Figures(Settings):
    """Write every figure of a result as vector PDF and PNG at journal column widths."""

    result: Annotated[Path, tyro.conf.Positional]
    """Result directory of nerif reconstruct."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder to write to; default: RESULT/figures."""
    journal: str = "elsevier"
    """Whose column widths: elsevier, aip, aps, nature or springer."""
    dpi: int = 300
    """Dots per inch of the PNG files."""


def run(settings: Figures) -> None:
    """Write them, and say what could not be drawn."""
    if settings.journal not in JOURNALS:
        raise InputError(f"expected one of {', '.join(JOURNALS)}, got '{settings.journal}'", field="journal")
    if not 20 <= settings.dpi <= 2400:
        raise InputError(f"expected 20 to 2400 dots per inch, got {settings.dpi}", field="dpi")
    result = ResultDirectory(settings.result).read()
    out = settings.out or settings.result / FIGURES
    if out.is_file():
        raise InputError("expected a folder for --out, got a file", field=out)
    out.mkdir(parents=True, exist_ok=True)
    with counting_bar("drawing figures"):
        paths = save_figures(result, out, settings.journal, settings.dpi)
    for gap in result.missing:
        say(f"left out: {gap.sentence}")
    if not paths:
        raise InputError(f"nothing to draw; {' '.join(gap.sentence for gap in result.missing)}", field=settings.result)
    say(f"{out}: {len(paths) // 2} figures, each as .pdf and .png")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Figures(tyro.MISSING), arguments, "figures"))
