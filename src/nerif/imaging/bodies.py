"""Bodies in a measurement: the pixels that they hide, and whether the data agree with their place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry.body import Body, check_place, hidden_pixels, orientations

__all__ = ["with_bodies", "without_bodies"]

FITS, FITS_NOT = 0.7, 0.4  # overlap of hidden pixels and those without data, of which one place is taken for another
COMPARED = 48  # pixels along an image that are compared
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

    Raises
    ------
    InputError
        If a body is not in the box, its size is not meant, it hides no pixel, or the pixels without data show it
        mirrored or with other axes.
    """
    for body in bodies:
        check_place(body, measurement.box, unit_stated)
        _check_silhouette(measurement, body)
    hidden = torch.zeros(measurement.shape, dtype=torch.bool)
    for i, camera in enumerate(measurement.cameras):
        height, width = camera.image_size
        hidden[i, :height, :width] = hidden_pixels(camera, bodies, margin)
        on_view(i + 1, len(measurement.cameras))
    if not bool(hidden.any()):
        raise InputError(
            "no pixel sees it; check its place, and that the views show it", field=" and ".join(b.name for b in bodies)
        )
    for i in hidden.flatten(1).all(dim=1).nonzero().flatten().tolist():
        raise InputError("every pixel sees a body; leave the view out", field=f"view '{measurement.names[i]}'")
    values = {o.technique.name: o.values.masked_fill(hidden[..., None], torch.nan) for o in measurement.observations}
    sigmas = {o.technique.name: o.sigma for o in measurement.observations}
    return replace(measurement.observed(values, sigmas), bodies=tuple(bodies), hidden=hidden)


def without_bodies(measurement: Measurement) -> Measurement:
    """Return a measurement without bodies; pixels that saw one stay without data."""
    valid = measurement.valid
    if measurement.hidden is not None:
        valid = ~measurement.hidden if valid is None else valid & ~measurement.hidden
    return replace(measurement, bodies=(), hidden=None, valid=valid)


def _check_silhouette(measurement: Measurement, body: Body) -> None:
    """Raise an error if pixels without data show the body elsewhere than it is."""
    step = max(1, max(max(camera.image_size) for camera in measurement.cameras) // COMPARED)
    usable = measurement.usable
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
