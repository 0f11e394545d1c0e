"""nerif figures: the figures of a result for print."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Le

from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError
from nerif.common.settings import Positional
from nerif.report.journals import JOURNALS

__all__ = ["Figures", "main", "run"]


@dataclass(frozen=True)
class Figures(Settings):
    """Write every figure of a result as vector PDF and PNG at journal column widths."""

    result: Annotated[Path, Positional]
    """Result directory of nerif reconstruct."""
    out: Path | None = None
    """Folder to write (default: RESULT/figures)."""
    journal: Literal[*JOURNALS] = "elsevier"  # type: ignore[valid-type]
    """Journal whose column widths are used."""
    dpi: Annotated[int, Ge(20), Le(2400)] = 300
    """Resolution of the PNG files in dots per inch."""


def run(settings: Figures) -> None:
    """Write the figures, and print what could not be drawn."""
    from nerif.report.journal_figures import save_figures
    from nerif.results.directory import FIGURES, ResultDirectory

    result = ResultDirectory(settings.result).read()
    out = settings.out or settings.result / FIGURES
    if out.is_file():
        raise InputError("expected a folder for --out, got a file", field=out)
    out.mkdir(parents=True, exist_ok=True)
    with counting_bar("drawing figures"):
        paths = save_figures(result, out, settings.journal, settings.dpi)
    for gap in result.missing:
        say(f"not drawn: {gap.sentence}")
    if not paths:
        raise InputError(f"nothing to draw; {' '.join(gap.sentence for gap in result.missing)}", field=settings.result)
    say(f"{out}: {len(paths) // 2} figures, each as .pdf and .png")


main = command("figures", Figures, run)
