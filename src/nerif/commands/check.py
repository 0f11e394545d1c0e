"""nerif check: do the views of a measurement agree with one another?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from nerif.commands.output import counting_bar, say
from nerif.commands.settings import Settings, read_settings
from nerif.consistency import Consistency, check_consistency
from nerif.conventions import InputError
from nerif.measurement import Measurement

__all__ = ["Check", "main", "run"]


@dataclass(frozen=True)
class Check(Settings):
    """Predict every view by a quick reconstruction from the others, and name the ones that do not fit, and why.

    Found are: u and v swapped, a flipped sign, a mirrored, reversed or turned picture, of one view or all; two views
    exchanged; values of a wrong size; flow that leaves the box through a face. What fits equally well either way is
    not: a flipped sign of everything (so it says whether a flow comes out lighter or denser), a mirrored picture of a
    symmetric flow. Each technique of a measurement is checked by itself.
    """

    measurement: tyro.conf.Positional[Path]
    """Measurement file."""
    voxels: int = 24
    """Of the quick reconstructions, along the longest edge of the box."""
    strict: bool = False
    """Exit with code 1 if something is found."""


def run(settings: Check) -> Consistency:
    """Compare the views, and say what was found."""
    if settings.voxels < 8:
        raise InputError(f"voxels: expected at least 8, got {settings.voxels}")
    measurement = Measurement.read(settings.measurement)
    with counting_bar("comparing views") as bar:
        result = check_consistency(measurement, settings.voxels, bar)
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
    return result


def main(arguments: list[str]) -> None:
    """Parse and run."""
    settings = read_settings(Check(measurement=tyro.MISSING), arguments, "check")
    if run(settings).findings and settings.strict:
        raise SystemExit(1)
