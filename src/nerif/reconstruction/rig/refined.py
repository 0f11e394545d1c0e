"""What a refinement found, as metrics.json and checkpoints keep it: a rig to go by, and what to say of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Camera
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.reconstruction.rig.numbers import NAMES, UNITS, displaced

if TYPE_CHECKING:
    from nerif.reconstruction.rig.refinement import Refinement

__all__ = ["MOVED", "UNTOLD", "check_table", "kept_of", "moved_lines", "take_up", "with_corrections"]

MOVED = 3.0  # sigma, by which a view counts as moved
STILL = 1e-6  # sigma: rounding
FEW = 3  # views, of which a field can be found that fits them wherever they stand, but for their heights
UNTOLD = 0.3  # of what data tell of a view (posterior.py): below it, next to nothing


def with_corrections(measurement: Measurement, table: Sequence[dict[str, Any]]) -> Measurement:
    """Return a measurement with the cameras that a refinement found, and without the shifts of its images.

    Views that the table does not name stay as they are.

    Parameters
    ----------
    table : of a Refinement, as metrics.json keeps it
    """
    if not table:
        return measurement
    check_table(table)
    known = {row["name"]: row["values"] for row in table}
    values = torch.tensor(
        [[known.get(name, {}).get(number, 0.0) for number in NAMES] for name in measurement.names], dtype=torch.float64
    )
    cameras = Corrections(measurement.cameras, values[:, : len(GEOMETRY)]).corrected
    afterwards = {row["name"]: row.get("sigma_after", {}) for row in table}
    cameras = tuple(_known(camera, afterwards.get(camera.name, {})) for camera in cameras)
    d = measurement.displacement
    if d is not None and bool(values[:, len(GEOMETRY) :].any()):
        d = d.clone()
        for i, camera in enumerate(cameras):
            height, width = camera.image_size
            pixel = camera.pixel_grid().reshape(-1, 2).double()
            middle = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64)
            own = values[i, len(GEOMETRY) :].expand(len(pixel), -1)
            shift = displaced(own, (pixel - middle) / (max(height, width) / 2)).reshape(height, width, 2)
            d[i, :height, :width] -= shift.to(d)
    return replace(measurement, cameras=cameras, displacement=d)


def check_table(table: Any) -> None:
    """Refuse what is no table of refined numbers.

    Raises
    ------
    InputError
        Naming what was expected.
    """
    for row in table if isinstance(table, Sequence) else [None]:
        given = row if isinstance(row, dict) else {}
        values = given.get("values")
        good = isinstance(values, dict) and isinstance(given.get("name"), str)
        numbers = values.items() if isinstance(values, dict) else ()
        if not good or not all(n in NAMES and isinstance(v, int | float) and math.isfinite(v) for n, v in numbers):
            raise InputError(
                f"expected for each view a name and finite values of {', '.join(NAMES)}, got {row!r}", field="rig"
            )


def _known(camera: Camera, sigma: dict[str, float]) -> Camera:
    """The camera with the standard deviations of its pose that are known afterwards."""
    if not all(name in sigma for name in NAMES[:6]):
        return camera
    return replace(camera, pose_sigma=torch.tensor([sigma[name] for name in NAMES[:6]], dtype=torch.float64))


def moved_lines(table: Sequence[dict[str, Any]]) -> list[str]:
    """Return what to say of a refinement: how far views moved, and each that moved further than its sigmas allow."""
    far = [row for row in table if row["moved"] > MOVED]
    most = max(table, key=lambda row: row["moved"])
    lines = [f"refined {len(table)} views; furthest is {most['name']}, by {most['moved']:.1f} of its sigmas"]
    if most["moved"] < STILL:
        lines = [f"refined {len(table)} views: the data show no sign that one is off, so none was moved"]
    if len(table) <= FEW:
        lines.append(f"of {len(table)} views the field can follow nearly any movement; take what was moved for a guess")
    dark = [row["name"] for row in table if row.get("told", 1.0) < UNTOLD]
    if dark:
        which = "any view" if len(dark) == len(table) else ", ".join(dark)
        lines.append(
            f"the data tell next to nothing of how {which} stands: the field could follow, or noise hides it; "
            "it stays as calibrated"
        )
    for row in far:
        number, value = max(row["values"].items(), key=lambda n: abs(n[1]) / max(row["sigma"][n[0]], 1e-30))
        unit = UNITS[NAMES.index(number)]
        lines.append(
            f"view {row['name']} is not where its calibration says: {number} {value:.3g} {unit}, {row['moved']:.1f} "
            f"sigma; it looks {row.get('aside_px', 0.0):.2g} px aside; calibrate it again, or state a larger pose_sigma"
        )
    return lines


def kept_of(refinement: Refinement | None) -> dict[str, Tensor]:
    """Return what a checkpoint keeps of a rig that is refined, if it is."""
    return {} if refinement is None else {f"rig.{name}": value for name, value in refinement.kept().items()}


def take_up(refinement: Refinement | None, kept: Mapping[str, Tensor]) -> None:
    """Go on from what a checkpoint kept of a refined rig (kept_of).

    Raises
    ------
    InputError
        If that run refined a rig and this one does not, or the other way round.
    """
    rig = {name.removeprefix("rig."): value for name, value in kept.items() if name.startswith("rig.")}
    if bool(rig) != (refinement is not None):
        was = "with" if rig else "without"
        raise InputError(
            f"the checkpoint is of a run {was} --refine; give the same settings to resume it", field="refine"
        )
    if refinement is not None:
        refinement.restore(rig)
