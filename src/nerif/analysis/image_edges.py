"""Flow cut by the edge of an image: the signal does not fall to zero at an edge beyond which the box continues.

What lies beyond an edge of one view deflects the rays of the others, but is not in its image: the views then determine
neither the field nor whether they agree. An edge that cuts all views in the same plane, as above a jet, does no harm.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.arrays import Points
from nerif.common.blocks import blocks
from nerif.common.conventions import FACES
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import Observation
from nerif.geometry import Camera, Grid

__all__ = ["CutEdge", "cut_edges", "cut_sentence"]

MIN_SIGNAL = 0.3  # rms in a strip along an edge over that of the image, noise removed
MIN_REPEATED = 0.3  # of the mean square of neighbours, in their product: less is mostly noise
MIN_BEYOND = 0.05  # of the points of the box that other views show, beyond an edge
STRIP = 12  # strips across an image
GROWTH = 0.2  # of the longest edge of the box, by which the flow may continue beyond it
PIXELS = 256  # along an edge of an image, from which it is binned
POINTS = 16  # along the longest edge of the box
REMEDY = (
    "record images that contain the whole flow; if it also leaves the box, give --open-faces with the faces that it "
    "crosses and --known X Y Z N with points of known index"
)


@dataclass(frozen=True)
class CutEdge:
    """An edge of an image at which the flow is cut off."""

    view: int  #: index
    side: str  #: left, right, top, bottom
    signal: float  #: rms along it over that of the image


def _share_of_box(measurement: Measurement) -> float:
    """Return the share of the box in the median image."""
    points = Grid.of_resolution(measurement.box, POINTS).points(torch.float64).reshape(-1, 3)
    return float(torch.stack([_inside(camera, points) for camera in measurement.cameras]).double().mean(dim=1).median())


def cut_edges(measurement: Measurement, observation: Observation) -> list[CutEdge]:
    """Return the edges at which the flow is cut off.

    Those towards an ambient face and, of several views, past which others show the flow.
    """
    edges, ambient = [], measurement.ambient_faces if observation.technique.gauge else FACES
    box = measurement.box.grown(FACES, GROWTH * max(measurement.box.edges))
    points = Grid.of_resolution(box, POINTS).points(torch.float64).reshape(-1, 3)
    visible = [_inside(camera, points) for camera in measurement.cameras]
    for i, camera in enumerate(measurement.cameras):
        height, width = camera.image_size
        usable = measurement.usable[i, :height, :width]
        d = observation.values[i, :height, :width].where(usable[..., None], torch.nan)
        edge = max(1, max(height, width) // PIXELS)
        d = blocks(d, edge, edge).nanmean(dim=(1, 3))
        centres = blocks(camera.pixel_grid(), edge, edge).mean(dim=(1, 3))
        crosses = camera.rays(centres.reshape(-1, 2), sensitivity=False).clip(box).crosses.reshape(d.shape[:2])
        height, width = d.shape[:2]
        rows, columns = max(1, height // STRIP), max(1, width // STRIP)
        strips = {
            "left": (slice(None), slice(0, columns)), "right": (slice(None), slice(width - columns, None)),
            "top": (slice(0, rows), slice(None)), "bottom": (slice(height - rows, None), slice(None)),
        }  # fmt: skip
        border = torch.cat([d[strip].reshape(-1, d.shape[-1]) for strip in strips.values()])
        d = d - border.nanmedian(dim=0).values  # of a camera that moved
        whole, beyond = _mean_square(d, 1), _beyond(camera, points)
        for side, strip in strips.items():
            others = [float(beyond[side][s].double().mean()) for j, s in enumerate(visible) if j != i and s.any()]
            wide = _face(camera, side) in ambient and (not others or statistics.fmean(others) > MIN_BEYOND)
            square = _mean_square(d[strip], 0 if side in ("left", "right") else 1)
            if wide and square > MIN_SIGNAL**2 * whole > 0 and float(crosses[strip].double().mean()) > 0.5:
                edges.append(CutEdge(i, side, math.sqrt(square / whole)))
    return edges


def cut_sentence(measurement: Measurement, observation: Observation, edges: Sequence[CutEdge]) -> str:
    """Return a sentence on the edges at which the flow is cut off, with the remedy."""
    worst, measured = max(edges, key=lambda edge: edge.signal), observation.technique.measured
    views = len({edge.view for edge in edges})
    return (
        f"the images show only {_share_of_box(measurement):.0%} of the box, and the {measured} does not fall to zero "
        f"at the edges of {views} of {len(measurement.names)} views ({measurement.names[worst.view]}, {worst.side}: "
        f"{worst.signal:.0%} of the rms of the image): the flow is wider than the images; {REMEDY}"
    )


def _mean_square(d: Float[Tensor, "row column c"], axis: int) -> float:
    """The mean square but for white noise: the mean product of neighbours along an axis; 0 of little but noise."""
    if d.shape[axis] < 2:
        return 0.0
    products = (d.narrow(axis, 0, d.shape[axis] - 1) * d.narrow(axis, 1, d.shape[axis] - 1)).sum(dim=-1)
    square = float(products.nanmean().nan_to_num(0.0))
    return square if square > MIN_REPEATED * float(d.square().sum(dim=-1).nanmean().nan_to_num(0.0)) else 0.0


def _beyond(camera: Camera, points: Points) -> dict[str, Bool[Tensor, " n"]]:
    """Which points are beyond each side of an image."""
    u, v = camera.project(points.to(camera.rotation)).unbind(-1)
    height, width = camera.image_size
    return {"left": u < -0.5, "right": u > width - 0.5, "top": v < -0.5, "bottom": v > height - 0.5}


def _inside(camera: Camera, points: Points) -> Bool[Tensor, " n"]:
    return ~torch.stack(list(_beyond(camera, points).values())).any(dim=0)


def _face(camera: Camera, side: str) -> str:
    """The face of the box that a side of an image is closest to."""
    outward = camera.rotation[0 if side in ("left", "right") else 1] * (1 if side in ("right", "bottom") else -1)
    axis = int(outward.abs().argmax())
    return f"{'xyz'[axis]}{'+' if outward[axis] > 0 else '-'}"
