"""Diagnosis of a calibration: a quick field, refined together with the rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nerif.common.findings import Finding
from nerif.data.measurement import Measurement
from nerif.geometry.plausibility import rig_findings
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.device import on_free_cores
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.rig_parameters import MOVED, RefinedView, refinement_lines
from nerif.reconstruction.shared_settings import Aperture
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.uncertainty.rig_posterior import RigPosterior

__all__ = ["RigCheck", "check_rig"]

MAX_RESIDUAL = 2.0  # sigma, above which the field is too inaccurate to judge the rig


@dataclass(frozen=True)
class RigCheck:
    """The refined rig, and what it shows of the calibration."""

    table: list[RefinedView]
    """For each view its corrections, their standard deviations before and after, and its residual."""
    remarks: tuple[str, ...]  #: further notes
    findings: tuple[Finding, ...]  #: impossible camera poses, and significant pose errors


@on_free_cores
def check_rig(
    measurement: Measurement, refine: Sequence[str], seconds: float = 30.0, pose_sigma_mm: float | None = None,
    pose_sigma_deg: float | None = None, monitor: Monitor = QUIET, aperture: Aperture = "auto",
) -> RigCheck:  # fmt: skip
    """Refine a rig together with a briefly trained field, and report which views moved.

    Parameters
    ----------
    measurement : of views of the same flow
    refine : parts of the rig (settings.refine of NeRIF)
    seconds : of training; longer ones resolve smaller errors of the rig
    pose_sigma_mm, pose_sigma_deg : prior standard deviations of the poses; None for those of the measurement
    monitor : for the progress
    aperture : depth of field, as in NeRIF
    """
    data = of_source(measurement, "auto", preferred="displacements")  # images are more accurate but take longer
    settings = NeRIF(
        time_limit=seconds, refine=tuple(refine), pose_sigma_mm=pose_sigma_mm, pose_sigma_deg=pose_sigma_deg,
        aperture=aperture,
    )  # fmt: skip
    with monitor.training("refining the rig") as on_step:
        result = settings(data, on_step)
    with monitor.counting("accuracy of the rig") as bar:
        data = apply_aperture(data, aperture)
        table = RigPosterior.of(result.rig, data, result.field, result.settings, bar).table
    lines = refinement_lines(table)
    moved = [row["name"] for row in table if row["correction_over_sigma"] > MOVED]
    first = len(lines) - len(moved)
    remarks = lines[:first]
    worst = max(table, key=lambda row: row.get("rms_after", 0.0))
    if worst.get("rms_after", 0.0) > MAX_RESIDUAL:
        remarks.append(
            f"view {worst['name']}: residual {worst['rms_after']:.1f} sigma after {seconds:g} s, too large to detect "
            "all pose errors; take a larger time limit, or look for other errors"
        )
    impossible = rig_findings(measurement.cameras, measurement.box)
    off = [Finding("moved", line, (name,)) for name, line in zip(moved, lines[first:], strict=True)]
    return RigCheck(table, tuple(remarks), (*impossible, *off))
