"""nerif pattern: backgrounds and calibration targets to print."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from nerif.cli.arguments import check_output
from nerif.cli.output import say
from nerif.cli.settings import Settings, read_settings, setting_of
from nerif.common.conventions import InputError
from nerif.common.settings import MISSING, Flat
from nerif.imaging import patterns as background
from nerif.imaging.calibration import targets
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.patterns import Background, paper_for, print_pattern

__all__ = ["PrintBackground", "PrintTarget", "main", "run"]


KINDS = (*background.KINDS, *targets.KINDS)


@dataclass(frozen=True)
class Pattern(Settings):
    """Settings of every kind of pattern."""

    out: Path
    """File to write, in true size: .pdf (with a scale bar) or .png."""
    dpi: float = 600.0
    """Resolution in dots per inch; reduced where a dot has 12 pixels already."""
    force: bool = False
    """Overwrite an existing file."""


@dataclass(frozen=True)
class PrintBackground(Pattern):
    """Write a background to print (--kind dots, wavelet, multiscale).

    --kind chessboard, charuco or circles writes a calibration target; --kind charuco --help lists its options.
    """

    pattern: Annotated[Background, Flat] = field(default_factory=Background)


@dataclass(frozen=True)
class PrintTarget(Pattern):
    """Write a calibration target to print (--kind chessboard, charuco, circles)."""

    pattern: Annotated[CalibrationTarget, Flat] = field(default_factory=CalibrationTarget)


def run(settings: PrintBackground | PrintTarget) -> None:
    """Write the pattern."""
    check_output(settings.out, settings.force)
    pattern = settings.pattern
    print_pattern(settings.out, pattern, settings.dpi)
    width, height = pattern.size
    say(f"{settings.out}: {pattern.label}; {width:.1f} x {height:.1f} mm, fits on {paper_for(settings.out, pattern)}")
    say("print at 100 % (not scaled to the page), and verify the size with a ruler")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    kind = setting_of("kind", arguments, Background.kind)
    if kind not in KINDS:
        raise InputError(f"expected one of {', '.join(KINDS)}, got '{kind}'", field="kind")
    if kind in targets.KINDS:
        run(read_settings(PrintTarget(MISSING, pattern=CalibrationTarget(kind)), arguments, "pattern"))
    else:
        run(read_settings(PrintBackground(MISSING, pattern=Background(kind)), arguments, "pattern"))
