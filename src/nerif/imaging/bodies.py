"""Bodies in a measurement or a film: the pixels that they hide, and whether the data agree with their position."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from nerif.common.conventions import InputError, within
from nerif.common.files import reading
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.geometry.body import Body, check_place, hidden_pixels, orientations
from nerif.geometry.pose import rotation_matrix
from nerif.imaging.silhouettes import refine_pose

__all__ = ["check_size", "film_with_bodies", "read_poses", "with_bodies", "without_bodies"]

POSE_COLUMNS = ("rx", "ry", "rz", "tx", "ty", "tz")

FITS, FITS_NOT = 0.7, 0.4  # overlap of hidden pixels and those without data, of which one place is taken for another
COMPARED = 48  # pixels along an image that are compared
SMALL = 0.01  # of the pixels of an image, below which a body is likely larger
FEW = 0.002  # of the pixels, below which those without data show no body


def with_bodies(
    measurement: Measurement, bodies: Sequence[Body], margin: int = 0, unit_stated: bool = False,
    on_view: Callable[[int, int], object] = lambda done, count: None,
) -> Measurement:  # fmt: skip
    """Return a measurement with bodies in place of those it had; pixels that see one have no data.

    Parameters
    ----------
    margin : pixels around those that see a body, without data either, for what a correlation window mixes there
    unit_stated : whether the unit of the models was stated, so that a small one is meant
    on_view : called with the numbers of views done and of all

    Raises InputError if a body is not in the box, its size is not meant, it hides no pixel, or the pixels without data
    show it mirrored or with other axes.
    """
    for body in bodies:
        check_size(measurement, body, unit_stated or body in measurement.bodies)
        _check_silhouette(measurement, body)
    each = _hidden(measurement, bodies, margin, on_view)
    for body, hidden in zip(bodies, each, strict=True):
        if not bool(hidden.any()):
            raise InputError("no pixel sees it; check its place, and that the views show it", field=body.name)
    return _hide(measurement, bodies, each)


def check_size(measurement: Measurement, body: Body, unit_stated: bool = False) -> None:
    """Raise an InputError for a body that is not in the box, or is small since its unit, if not stated, is another."""
    check_place(body, measurement.box, unit_stated)
    step = _step(measurement)
    largest = max(float(hidden_pixels(c, [body], step=step).double().mean()) for c in measurement.cameras)
    if 0 < largest < SMALL and not unit_stated:
        size = " x ".join(f"{e:.3g}" for e in (body.extent[1] - body.extent[0]).tolist())
        raise InputError(
            f"expected a body that hides {SMALL:.0%} of an image or more, got {largest:.2%} by one of {size} mm; are "
            "its lengths in cm, in or m (--unit)? If it is that small, state --unit mm",
            field=body.name,
        )


def _hidden(
    measurement: Measurement, bodies: Sequence[Body], margin: int,
    on_view: Callable[[int, int], object] = lambda done, count: None,
) -> Bool[Tensor, "body view row column"]:  # fmt: skip
    """The pixels that each body hides."""
    hidden = torch.zeros(len(bodies), *measurement.shape, dtype=torch.bool)
    for i, camera in enumerate(measurement.cameras):
        height, width = camera.image_size
        for of_body, body in zip(hidden, bodies, strict=True):
            of_body[i, :height, :width] = hidden_pixels(camera, [body], margin)
        on_view(i + 1, len(measurement.cameras))
    return hidden


def _hide(measurement: Measurement, bodies: Sequence[Body], each: Bool[Tensor, "body view row column"]) -> Measurement:
    """Return a measurement without data at the pixels that bodies hide."""
    hidden = each.any(dim=0)
    for i in hidden.flatten(1).all(dim=1).nonzero().flatten().tolist():
        raise InputError("every pixel sees a body; leave the view out", field=f"view '{measurement.names[i]}'")
    values = {o.technique.name: o.values.masked_fill(hidden[..., None], torch.nan) for o in measurement.observations}
    sigmas = {o.technique.name: o.sigma for o in measurement.observations}
    return replace(measurement.observed(values, sigmas), bodies=tuple(bodies), hidden=hidden)


Pose = tuple[Tensor, Tensor]
"""R (3, 3) and t (3,) in mm of x_world = R x_model + t."""


def read_poses(path: Path, bodies: int, frames: int) -> list[list[Pose]]:
    """Read the poses of bodies in each frame of a film from a table (.csv).

    Its columns are rx, ry, rz (axis of the rotation times its angle, degrees) and tx, ty, tz (mm), one row for
    each frame; with several bodies one row for each body of each frame in turn.
    """
    expected = f"expected a table with the columns {', '.join(POSE_COLUMNS)} and numbers in them"
    with reading(expected, path), path.open(encoding="utf-8-sig", newline="") as file:
        rows = [[float(row[name]) for name in POSE_COLUMNS] for row in csv.DictReader(file)]
    if len(rows) != bodies * frames:
        raise InputError(f"expected {bodies * frames} rows for {frames} frames, got {len(rows)}", field=path)
    table = torch.tensor(rows, dtype=torch.float64).reshape(frames, bodies, 6)
    if not bool(table.isfinite().all()):
        row = int((~table.isfinite()).flatten(0, 1).any(dim=-1).nonzero()[0])
        raise InputError(f"expected numbers, got NaN or infinity in row {row + 1}", field=path)
    rotations = rotation_matrix(table[..., :3].deg2rad())
    return [[(r, t) for r, t in zip(*frame, strict=True)] for frame in zip(rotations, table[..., 3:], strict=True)]


def film_with_bodies(
    film: MeasurementSequence, out: Path, bodies: Sequence[Body], poses: Sequence[Sequence[Pose]] | None = None,
    margin: int = 0, unit_stated: bool = False, refine: bool = False, force: bool = False,
    on_frame: Callable[[int, int], object] = lambda done, count: None,
) -> MeasurementSequence:  # fmt: skip
    """Write a film with bodies, at rest or moving; in each frame, pixels that see one have no data.

    Parameters
    ----------
    poses : of each frame and body
    refine : whether the pose in each frame is that of the outline of its pixels without data; it starts from the frame
        before
    on_frame : called with the numbers of frames done and of all
    """
    like = film.fullest()
    if like.bodies:
        names = ", ".join(body.name for body in like.bodies)
        raise InputError(
            f"expected a film without bodies, got one with {names}; start from that before", field=film.path
        )
    moving, last = poses is not None or refine, list(bodies)
    nothing = torch.zeros(like.shape, dtype=torch.bool)
    at_rest = replace(like, bodies=tuple(bodies), hidden=nothing)
    whole = MeasurementSequence.create(out, film.times, at_rest, force, moving)
    first = True
    for index in range(len(film)):
        try:
            frame = film.frame(index)
        except InputError:
            continue  # a frame that is missing stays so
        here = [b.moved(*pose) for b, pose in zip(bodies, poses[index], strict=True)] if poses is not None else last
        with within(f"{film.path}, frame {index}"):
            if refine:
                here = [refine_pose(frame, body, margin=margin).body for body in here]
            checked = with_bodies(frame, here, margin, unit_stated) if first else None
            frame = checked or _hide(frame, here, _hidden(frame, here, margin))
        last, first = here, False
        whole.write_frame(index, frame, [_pose(a, b) for a, b in zip(bodies, here, strict=True)] if moving else None)
        on_frame(index + 1, len(film))
    return whole


def _pose(rest: Body, moved: Body) -> Pose:
    """The pose that takes a body from rest to where it is (Kabsch)."""
    a, b = (body.vertices - body.vertices.mean(dim=0) for body in (rest, moved))
    u, _, v = torch.linalg.svd(a.T @ b)
    sign = torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ v).sign())], dtype=a.dtype)
    rotation = (v.T * sign) @ u.T
    return rotation, moved.vertices.mean(dim=0) - rotation @ rest.vertices.mean(dim=0)


def without_bodies(measurement: Measurement) -> Measurement:
    """Return a measurement without bodies; pixels that saw one stay without data."""
    valid = measurement.valid
    if measurement.hidden is not None:
        valid = ~measurement.hidden if valid is None else valid & ~measurement.hidden
    return replace(measurement, bodies=(), hidden=None, valid=valid)


def _step(measurement: Measurement) -> int:
    """Step in px at which images are compared."""
    return max(1, max(max(camera.image_size) for camera in measurement.cameras) // COMPARED)


def _check_silhouette(measurement: Measurement, body: Body) -> None:
    """Raise an error if pixels without data show the body elsewhere than it is."""
    step, usable = _step(measurement), measurement.usable
    empty = [
        ~usable[i, : camera.image_size[0] : step, : camera.image_size[1] : step]
        for i, camera in enumerate(measurement.cameras)
    ]
    share = sum(float(e.sum()) for e in empty) / sum(e.numel() for e in empty)
    if share < FEW:
        return

    def overlap(other: Body) -> float:
        hidden = [hidden_pixels(camera, [other], step=step) for camera in measurement.cameras]
        both = sum(int((h & e).sum()) for h, e in zip(hidden, empty, strict=True))
        either = sum(int((h | e).sum()) for h, e in zip(hidden, empty, strict=True))
        return both / max(either, 1)

    here = overlap(body)
    if here > FITS_NOT:
        return
    for name, matrix in orientations():
        other = overlap(replace(body, vertices=body.vertices @ matrix.T))
        if other > FITS:
            raise InputError(
                f"expected pixels without data where the views see it, got {here:.0%} overlap, but {other:.0%} with "
                f"its axes as {name}; export it with these axes, or check the world frame of the calibration",
                field=body.name,
            )
