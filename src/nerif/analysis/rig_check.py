"""Which calibration is off, and by how much? A quick field, refined together with the rig, for the diagnosis alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nerif.common.findings import Finding
from nerif.data.measurement import Measurement
from nerif.geometry.plausibility import rig_findings
from nerif.reconstruction.aperture import seen_through
from nerif.reconstruction.device import on_free_cores
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.rig.parameters import MOVED, moved_lines
from nerif.reconstruction.rig.posterior import with_posterior
from nerif.reconstruction.shared_settings import Aperture
from nerif.reconstruction.sources import of_source

__all__ = ["RigCheck", "check_rig"]

ROUGH = 2.0  # sigma, above which a field is too far from the data for the rig to be judged by it


@dataclass(frozen=True)
class RigCheck:
    """What was found of a rig.

    Parameters
    ----------
    table : for each view the refined numbers, their standard deviations before and after, and what is left of it
    remarks : what a user should know
    findings : cameras that cannot be where they are, and views that are not where their calibration says
    """

    table: list[dict[str, Any]]
    remarks: tuple[str, ...]
    findings: tuple[Finding, ...]


@on_free_cores
def check_rig(
    measurement: Measurement, refine: Sequence[str], seconds: float = 30.0, pose_sigma_mm: float | None = None,
    pose_sigma_deg: float | None = None, monitor: Monitor = QUIET, aperture: Aperture = "auto",
) -> RigCheck:  # fmt: skip
    """Refine a rig with a field that is trained for some seconds, and say which views moved.

    Parameters
    ----------
    measurement : of views that see the same flow
    refine : what of the rig (settings.refine of NeRIF)
    seconds : of training; the field of longer ones is better, and with it what it says of the rig
    pose_sigma_mm, pose_sigma_deg : how far cameras may be off; None for what the measurement says
    monitor : is shown how far it is
    aperture : whether views see through the whole of their lens (seen_through)

    Raises
    ------
    InputError
        If there is no such thing to refine, or the aperture is "on" and none is known.
    """
    data = of_source(measurement, "auto", preferred="displacements")  # images tell more, and take longer
    settings = NeRIF(
        time_limit=seconds, refine=tuple(refine), pose_sigma_mm=pose_sigma_mm, pose_sigma_deg=pose_sigma_deg,
        aperture=aperture,
    )  # fmt: skip
    with monitor.training("refining the rig") as told:
        result = settings(data, told)
    with monitor.counting("how well the rig is known") as bar:
        table = with_posterior(result.rig, seen_through(data, aperture), result.field, result.settings, bar)
    lines = moved_lines(table)
    moved = [row["name"] for row in table if row["moved"] > MOVED]
    remarks, told_apart = lines[: len(lines) - len(moved)], lines[len(lines) - len(moved) :]
    worst = max(table, key=lambda row: row.get("rms_after", 0.0))
    if worst.get("rms_after", 0.0) > ROUGH:
        remarks.append(
            f"the field still leaves {worst['rms_after']:.1f} sigma in view {worst['name']} after {seconds:g} s: views "
            "may be off without showing; take a larger time limit, or look for what else is wrong"
        )
    impossible = rig_findings(measurement.cameras, measurement.box)
    off = [Finding("moved", line, (name,)) for name, line in zip(moved, told_apart, strict=True)]
    return RigCheck(table, tuple(remarks), (*impossible, *off))
