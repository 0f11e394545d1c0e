"""nerif check: consistency of the views of a measurement."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Ge

from nerif.cli.arguments import check_output
from nerif.cli.output import MONITOR, counting_bar, say
from nerif.cli.settings import Settings, compute
from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.settings import Positional, Positive
from nerif.reconstruction.shared_settings import Aperture

if TYPE_CHECKING:
    from nerif.analysis.consistency import Consistency
    from nerif.analysis.rig_check import RigCheck
    from nerif.data.measurement import Measurement
    from nerif.data.measurement_sequence import MeasurementSequence

__all__ = ["Check", "main", "run"]


@dataclass(frozen=True)
class Check(Settings):
    """Predict each view from the others by a quick reconstruction, and report inconsistent views with their cause.

    Detected: swapped u and v, flipped sign, mirrored, reversed or rotated images, of one view or all; two exchanged
    views; wrong scale; flow that leaves the box through a face. Not detectable: a flipped sign of all views (the sign
    of the flow is reported) and mirrored images of a symmetric flow. Techniques are checked separately.

    Of a measurement over time, views whose films are some frames late or early are named, with the remedy; the views
    are then compared at one instant.
    """

    measurement: Annotated[Path, Positional]
    """Measurement file (.nc), or measurement over time (.zarr)."""
    voxels: Annotated[int, Ge(8)] = 24
    """Voxels of the quick reconstructions along the longest edge of the box."""
    aperture: Aperture = "auto"
    """Finite aperture where the measurement states it (auto; on: required), or thin rays (off)."""
    refine: tuple[str, ...] = ()
    """Check the calibration instead: refine cameras, shift, focal or background with a quick field, and report errors
    of each view."""
    pose_sigma_mm: float | None = None
    """With --refine: standard deviation of camera positions, mm (default: that of the measurement, else 0.2)."""
    pose_sigma_deg: float | None = None
    """With --refine: standard deviation of orientations, degrees (default: that of the measurement, else 0.02)."""
    time_limit: Positive = 30.0
    """With --refine: time limit in seconds."""
    out: Path | None = None
    """Corrected measurement to write, NAME.nc, without its images of the pattern."""
    findings: Path | None = None
    """File NAME.json to write: agreement of each view, faults, notes. Earlier findings of the same measurement are
    replaced."""
    force: bool = False
    """Overwrite an existing file."""
    strict: bool = False
    """Exit with code 1 if a fault is found."""


def run(settings: Check) -> Consistency | RigCheck:
    """Compare the views, or refine their cameras, and print the result."""
    from nerif.analysis.consistency import Consistency, corrected
    from nerif.analysis.consistency_file import CheckFindings, write_findings
    from nerif.analysis.rig_check import RigCheck
    from nerif.data.measurement import Measurement
    from nerif.data.measurement_sequence import MeasurementSequence

    if settings.out is not None:
        if settings.refine:
            raise InputError("expected none with --refine, which corrects nothing; leave one out", field="out")
        check_output(settings.out, settings.force, endings=(".nc",))
    if settings.findings is not None:
        _check_findings_file(settings.findings, settings)
    film = MeasurementSequence.read(settings.measurement) if ending(settings.measurement) == ".zarr" else None
    if film is not None and settings.out is not None:
        raise InputError("expected none for a measurement over time, which is not corrected; leave it out", field="out")
    measurement = film.fullest() if film is not None else Measurement.read(settings.measurement)
    result = _rig(settings, measurement) if settings.refine else _views(settings, film or measurement)
    for remark in result.remarks:
        say(f"note: {remark}")
    for finding in result.findings:
        say(f"FOUND: {finding}")
    if isinstance(result, RigCheck) and not result.findings:
        say("All pose errors are within their uncertainty")
    elif isinstance(result, Consistency) and result.views and not result.findings:
        say("No problems found")
    if settings.out is not None and isinstance(result, Consistency):
        corrected(measurement, result).write(settings.out)
        say(f"{settings.out}: corrected measurement; check it again")
    if settings.findings is not None and isinstance(result, Consistency):
        write_findings(settings.findings, CheckFindings.of(str(settings.measurement), result))
        say(f"{settings.findings}: findings")
    return result


def _check_findings_file(path: Path, settings: Check) -> None:
    """Check --findings before the work: its name, and that only earlier findings of this measurement are replaced."""
    if settings.refine:
        raise InputError("expected none with --refine, which prints its table; leave one out", field="findings")
    if ending(path) != ".json":
        raise InputError(f"expected a name ending in .json, got '{path.name}'", field="findings")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist; create it", field="findings")
    if path.exists() and not settings.force and not _is_earlier(path, settings.measurement):
        raise InputError(
            f"{path} exists already and was left as it is; give another --findings, or --force", field="findings"
        )


def _is_earlier(path: Path, measurement: Path) -> bool:
    """Whether a file holds earlier findings of this measurement."""
    from nerif.analysis.consistency_file import read_findings

    try:
        return read_findings(path).measurement == str(measurement)
    except (InputError, OSError):
        return False


def _rig(settings: Check, measurement: Measurement) -> RigCheck:
    from nerif.analysis.rig_check import check_rig

    sigma = (settings.pose_sigma_mm, settings.pose_sigma_deg)
    result = check_rig(measurement, settings.refine, settings.time_limit, *sigma, MONITOR, settings.aperture)
    heads = ("change / prior", "shift [px]", "+- [px]", "less uncertain", "residual [sigma]")
    say(f"{'view':<14}" + "".join(f"{head:>18}" for head in heads))
    for row in result.table:
        residual = f"{row['rms_before']:.2f} -> {row['rms_after']:.2f}" if "rms_after" in row else "unknown"
        shift = (f"{row['image_shift_px']:.3f}", f"{row['image_shift_sigma_px']:.3f}")
        cells = (f"{row['correction_over_sigma']:.1f}", *shift, f"{row['uncertainty_reduction']:.0%}", residual)
        say(f"{row['name']:<14}" + "".join(f"{cell:>18}" for cell in cells))
    return result


def _views(settings: Check, measurement: Measurement | MeasurementSequence) -> Consistency:
    from nerif.analysis.consistency import check_consistency
    from nerif.analysis.film_check import check_film
    from nerif.data.measurement_sequence import MeasurementSequence

    with counting_bar("comparing views") as bar:
        if isinstance(measurement, MeasurementSequence):
            result = check_film(measurement, settings.voxels, bar, settings.aperture)
        else:
            result = check_consistency(measurement, settings.voxels, bar, settings.aperture)
    head = "map           " if len({view.measured for view in result.views}) > 1 else ""
    if result.views:
        say(f"{'view':<14}{head}{'valid':>8}{'agreement':>11}{'gain':>7}")
    for view in result.views:
        name = f"{view.name:<14}{view.measured if head else '':<{len(head)}}"
        say(f"{name}{view.valid:>8.1%}{view.agreement:>11.2f}{view.gain:>7.2f}  {view.verdict}")
    return result


def main(arguments: list[str]) -> None:
    """Parse and run."""
    settings = Check.read(arguments, "check")
    if compute(run, settings).findings and settings.strict:
        raise SystemExit(1)
