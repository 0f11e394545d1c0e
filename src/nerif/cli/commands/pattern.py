"""nerif pattern: backgrounds and calibration targets to print."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import check_file, say
from nerif.cli.commands.settings import Flat, Settings, read_settings, value_given
from nerif.common.conventions import InputError
from nerif.imaging import patterns as background
from nerif.imaging.calibration import targets
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.patterns import Background, paper_for, print_pattern

__all__ = ["PrintBackground", "PrintTarget", "main", "run"]


@dataclass(frozen=True)
class Pattern(Settings):
    """What the settings of every kind of pattern hold."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """File to write: .pdf (true size, with a scale bar) or .png (true size by its resolution)."""
    dpi: float = 600.0
    """Of the printer; coarser where a dot has 12 pixels already."""
    force: bool = False
    """Overwrite an existing file."""


@dataclass(frozen=True)
class PrintBackground(Pattern):
    """Write a background to print (--kind dots, wavelet, multiscale).

    --kind chessboard, charuco or circles writes a calibration target; --kind charuco --help tells its options.
    """

    pattern: Annotated[Background, Flat] = field(default_factory=Background)


@dataclass(frozen=True)
class PrintTarget(Pattern):
    """Write a calibration target to print (--kind chessboard, charuco, circles)."""

    pattern: Annotated[CalibrationTarget, Flat] = field(default_factory=CalibrationTarget)


def run(settings: PrintBackground | PrintTarget) -> None:
    """Write the pattern."""
    check_file(settings.out, settings.force)
    pattern = settings.pattern
    print_pattern(settings.out, pattern, settings.dpi)
    width, height = pattern.size
    paper = paper_for(settings.out, pattern)
    say(f"{settings.out}: {pattern.label}; {width:.1f} x {height:.1f} mm, fits on {paper}")
    say("print at 100 % (no fitting to the page), and measure it with a ruler before use")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    kind = value_given("kind", arguments, Background.kind)
    if kind in targets.KINDS:
        run(read_settings(PrintTarget(tyro.MISSING, pattern=CalibrationTarget(kind)), arguments, "pattern"))
    elif kind in background.KINDS:
        run(read_settings(PrintBackground(tyro.MISSING, pattern=Background(kind)), arguments, "pattern"))
    else:
        kinds = ", ".join((*background.KINDS, *targets.KINDS))
        raise InputError(f"expected one of {kinds}, got '{kind}'", field="kind")
