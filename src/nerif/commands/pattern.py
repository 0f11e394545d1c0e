"""nerif pattern: backgrounds and calibration targets to print."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nerif.commands.output import check_file, say
from nerif.commands.settings import Settings, read_settings
from nerif.conventions import InputError
from nerif.imaging import background, targets
from nerif.imaging.background import MARGIN, Background, write_pattern
from nerif.imaging.targets import Target

__all__ = ["Pattern", "main", "run"]

PAGES = {"A4": (297, 210), "A3": (420, 297), "A2": (594, 420), "A1": (841, 594), "A0": (1189, 841)}  # mm
LARGEST = 400e6  # pixels of a raster: more would not fit into the memory of a laptop


@dataclass(frozen=True)
class Pattern(Settings):
    """Write a background (dots, wavelet, multiscale) or calibration target (chessboard, charuco, circles) to print."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """File to write: .pdf (true size, with a scale bar) or .png (true size by its resolution)."""
    kind: str = "dots"
    """dots, wavelet, multiscale; chessboard, charuco, circles."""
    width: float = 200.0
    """Of a background, mm."""
    height: float = 200.0
    """Of a background, mm."""
    dot: float = 1.0
    """Diameter of a dot, or the smallest feature of a noise, mm: 2 to 5 px in the picture (nerif design)."""
    fill: float = 0.35
    """Share of the paper that dots cover."""
    seed: int = 0
    """Of a background: give each camera another one."""
    columns: int = 12
    """Of a target: squares (dots of circles) along a row."""
    rows: int = 9
    """Of a target: squares along a column."""
    pitch: float = 10.0
    """Of a target: edge of a square, mm."""
    dpi: float = 600.0
    """Of the printer; coarser where a dot has 12 pixels already."""
    force: bool = False
    """Overwrite an existing file."""


def run(settings: Pattern) -> None:
    """Write the pattern."""
    if settings.kind not in (*background.KINDS, *targets.KINDS):
        raise InputError(
            f"kind: expected one of {', '.join((*background.KINDS, *targets.KINDS))}, got '{settings.kind}'"
        )
    if settings.out.suffix not in (".pdf", ".png"):
        raise InputError(f"out: expected a name ending in .pdf or .png, got '{settings.out.name}'")
    if not settings.dpi > 0:
        raise InputError(f"dpi: expected a positive number, got {settings.dpi}")
    check_file(settings.out, settings.force)
    if settings.kind in background.KINDS:
        printed = Background(settings.kind, settings.width, settings.height, settings.dot, settings.fill, settings.seed)
        width, height, pixel = settings.width, settings.height, max(25.4 / settings.dpi, settings.dot / 12)
        label = f"{settings.kind}, {settings.dot:g} mm, seed {settings.seed}"
        _check_size(width, height, pixel)
        raster = printed.raster(pixel)
    else:
        target = Target(settings.kind, settings.columns, settings.rows, settings.pitch)
        width, height = target.size
        pixel = target.raster_pixel(25.4 / settings.dpi)
        label = f"{settings.kind} {settings.columns} x {settings.rows}, pitch {settings.pitch:g} mm"
        _check_size(width, height, pixel)
        raster = target.raster(pixel)
    write_pattern(settings.out, raster, pixel, label)
    margin = 2 * MARGIN if settings.out.suffix == ".pdf" else 0
    long, short = sorted((width + margin, height + margin), reverse=True)
    page = next((name for name, (a, b) in PAGES.items() if long <= a and short <= b), "a plotter")
    say(f"{settings.out}: {label}; {width:.1f} x {height:.1f} mm, fits on {page}")
    say("print at 100 % (no fitting to the page), and measure it with a ruler before use")


def _check_size(width: float, height: float, pixel: float) -> None:
    pixels = width * height / pixel**2
    if pixels > LARGEST:
        raise InputError(f"width, height: expected at most {LARGEST:.0e} pixels, got {pixels:.1e}; give fewer --dpi")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Pattern(out=tyro.MISSING), arguments, "pattern"))
