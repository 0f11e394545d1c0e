"""nerif check: do the views of a measurement agree with one another?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nerif.analysis.consistency import Consistency, check_consistency, corrected
from nerif.analysis.rig_check import RigCheck, check_rig
from nerif.cli.commands.output import MONITOR, check_file, counting_bar, say
from nerif.cli.commands.settings import Settings, read_settings
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.reconstruction.shared_settings import Aperture

__all__ = ["Check", "main", "run"]


@dataclass(frozen=True)
class Check(Settings):
    """Predict every view by a quick reconstruction from the others, and name the ones that do not fit, and why.

    Found are: u and v swapped, a flipped sign, a mirrored, reversed or turned image, of one view or all; two views
    exchanged; values of a wrong size; flow that leaves the box through a face. What fits equally well either way is
    not: a flipped sign of everything (so it says whether a flow comes out lighter or denser), a mirrored image of a
    symmetric flow. Each technique of a measurement is checked by itself.
    """

    measurement: tyro.conf.Positional[Path]
    """Measurement file."""
    voxels: int = 24
    """Of the quick reconstructions, along the longest edge of the box."""
    aperture: Aperture = "auto"
    """Views see through the whole of their lens where its aperture is known (auto, or on to insist), or by thin rays
    (off)."""
    refine: tuple[str, ...] = ()
    """Look at the rig instead: refine cameras, shift, focal or background with a quick field, and say which view's
    calibration is off by how much."""
    pose_sigma_mm: float | None = None
    """With --refine: how far cameras may be off, mm (standard deviation); else what the measurement says, or 0.2."""
    pose_sigma_deg: float | None = None
    """With --refine: by how much cameras may be turned, degrees; else what the measurement says, or 0.02."""
    time_limit: float = 30.0
    """With --refine: seconds in which the field is found."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Measurement to write, NAME.nc, with the mistakes undone that were found; without its images of the pattern."""
    force: bool = False
    """Overwrite an existing file."""
    strict: bool = False
    """Exit with code 1 if something is found."""


def run(settings: Check) -> Consistency | RigCheck:
    """Compare the views, or refine their cameras, and say what was found."""
    if settings.out is not None:
        if settings.refine or settings.out.suffix != ".nc":
            wrong = "--refine, which corrects nothing" if settings.refine else f"'{settings.out.name}'"
            raise InputError(f"expected a name ending in .nc, of what is compared, got {wrong}", field="out")
        check_file(settings.out, settings.force)
    return _rig(settings) if settings.refine else _views(settings)


def _rig(settings: Check) -> RigCheck:
    if not settings.time_limit > 0:
        raise InputError(f"expected seconds above 0, got {settings.time_limit}", field="time_limit")
    sigma = (settings.pose_sigma_mm, settings.pose_sigma_deg)
    measurement = Measurement.read(settings.measurement)
    found = check_rig(measurement, settings.refine, settings.time_limit, *sigma, MONITOR, settings.aperture)
    heads = ("moved [sigma]", "aside [px]", "+- [px]", "told", "residual [sigma]")
    say(f"{'view':<14}" + "".join(f"{head:>18}" for head in heads))
    for row in found.table:
        left = f"{row['rms_before']:.2f} -> {row['rms_after']:.2f}" if "rms_after" in row else "unknown"
        aside = (f"{row['aside_px']:.3f}", f"{row['aside_sigma_px']:.3f}")
        figures = (f"{row['moved']:.1f}", *aside, f"{row['told']:.0%}", left)
        say(f"{row['name']:<14}" + "".join(f"{figure:>18}" for figure in figures))
    for remark in found.remarks:
        say(f"note: {remark}")
    for finding in found.findings:
        say(f"FOUND: {finding}")
    if not found.findings:
        say("no view is further off than its sigmas allow")
    return found


def _views(settings: Check) -> Consistency:
    if settings.voxels < 8:
        raise InputError(f"expected at least 8, got {settings.voxels}", field="voxels")
    measurement = Measurement.read(settings.measurement)
    with counting_bar("comparing views") as bar:
        result = check_consistency(measurement, settings.voxels, bar, settings.aperture)
    of = "measured      " if len({view.measured for view in result.views}) > 1 else ""
    if result.views:
        say(f"{'view':<14}{of}{'valid':>8}{'agreement':>11}{'gain':>7}")
    for view in result.views:
        name = f"{view.name:<14}{view.measured if of else '':<{len(of)}}"
        say(f"{name}{view.valid:>8.1%}{view.agreement:>11.2f}{view.gain:>7.2f}  {view.verdict}")
    for remark in result.remarks:
        say(f"note: {remark}")
    for finding in result.findings:
        say(f"FOUND: {finding}")
    if result.views and not result.findings:
        say("nothing odd found")
    if settings.out is not None:
        corrected(measurement, result).write(settings.out)
        say(f"{settings.out}: the measurement with what was found undone; check it again")
    return result


def main(arguments: list[str]) -> None:
    """Parse and run."""
    settings = read_settings(Check(measurement=tyro.MISSING), arguments, "check")
    if run(settings).findings and settings.strict:
        raise SystemExit(1)
