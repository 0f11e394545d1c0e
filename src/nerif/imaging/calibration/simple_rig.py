"""One camera from two lengths: its distance from the axis of a flow, and the scale there; the axis marked in its image.

    x_cam = (X, Y, D)      points of the axis, which lies in a plane across the optical axis, D mm from the camera
    z = axis of the flow, y = optical axis, x = y x z     world, about the point of the axis nearest the principal point

With the axis upright in the image, x is to its right, y away from the camera, z up.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera, check_camera
from nerif.geometry import Box, Lens, Plane
from nerif.imaging.calibration.calibration_settings import ImportSettings, SimpleRig
from nerif.imaging.readers.open import open_frames
from nerif.imaging.readers.views import find_views

__all__ = ["RULER", "box_about_axis", "find_image", "simple_camera"]

RULER = 1.0, 0.5
"""Default standard deviations of the position (mm) and rotation (degrees) of a camera placed with a ruler."""
WIDTHS = 1000  # half widths of the box to try
ROUNDING = 100  # corners of the box are rounded to a power of ten below the edges over this
ROUNDING_TOLERANCE = 1e-6  # in steps of the rounding
EDGE_TOLERANCE = 1e-9  # of the image


def find_image(
    source: Path, only: Sequence[str] = (), image_size: tuple[int, int] | None = None
) -> tuple[str, tuple[int, int]]:
    """Return the name of the one view of an experiment, and the height and width of its images as stored, px.

    Parameters
    ----------
    source : folder of the experiment, or an image; its view is named "camera", unless `only` has a name
    only : name of the view, if there are several
    image_size : height and width, px; None: read from an image
    """
    if len(only) > 1:
        raise InputError(f"expected one view for a simple rig, got {', '.join(only)}", field="views")
    if not source.is_dir():
        return only[0] if only else "camera", image_size or open_frames(source).shape
    views = find_views(source, only)
    if len(views) > 1:
        names = ", ".join(view.name for view in views)
        raise InputError(f"expected one view for a simple rig, found {names}; choose with --views NAME", field="views")
    (view,) = views
    if image_size is None:
        frames = view.open("reference")
        image_size = frames.layout.shape  # in which the axis and the scale are measured, even if they are binned
        if view.crop and frames.binning is not None:
            raise InputError(
                "its images are a raw Bayer mosaic, binned and cropped; give --image-size HEIGHT WIDTH of the images "
                f"in which the axis and the scale were measured, {image_size[0]} {image_size[1]} if they are the files",
                field=f"view '{view.name}'",
            )
        if view.crop:
            image_size = view.crop.shape_of(image_size, frames.name(0))
    return view.name, image_size


def simple_camera(
    rig: SimpleRig, image_size: tuple[int, int], settings: ImportSettings, name: str = "camera"
) -> CalibratedCamera:
    """Return the camera, in whose image the axis of the flow is exactly where it was marked.

    Parameters
    ----------
    image_size : height and width, px
    settings : its background_distance (from the axis of the flow, mm), lens and pose_sigma
    """
    depth, scale, behind = rig.depth, rig.scale, settings.background_distance
    if behind is None or not 0 < behind < math.inf:
        raise InputError(
            f"expected a positive number of mm from the axis of the flow to the background, got {behind}",
            field="background_distance",
        )
    lens = settings.lens
    if rig.f_number is not None and rig.focal_length is not None:
        if lens is not None:
            raise InputError("expected one of the two, got both", field="f_number, aperture_diameter")
        lens = Lens(rig.focal_length / rig.f_number)
    height, width = image_size
    middle = np.array(rig.principal_point or ((width - 1) / 2, (height - 1) / 2))
    first = np.array(rig.axis_from or ((width - 1) / 2, height - 0.5))
    last = np.array(rig.axis_to or ((width - 1) / 2, -0.5))
    along = (last - first) / np.linalg.norm(last - first)
    origin = first + ((middle - first) @ along) * along
    focal, shift = depth / scale, scale * (origin - middle)
    down, right = along[1], along[0]
    shift_sigma, turn_sigma = settings.pose_sigma or RULER
    f64 = torch.float64
    camera = CalibratedCamera(
        name=name,
        intrinsics=torch.tensor([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]], dtype=f64),
        rotation=torch.tensor([[0 - down, 0, right], [right, 0, down], [0, 1, 0]], dtype=f64),
        translation=torch.tensor([*shift, depth], dtype=f64),
        distortion=torch.zeros(5, dtype=f64),
        image_size=image_size,
        background=Plane(torch.tensor([0, -1, 0], dtype=f64), -behind),
        lens=lens,
        pose_sigma=torch.tensor([math.radians(turn_sigma)] * 3 + [shift_sigma] * 3, dtype=f64),
    )
    return check_camera(camera, "simple rig")


def box_about_axis(camera: CalibratedCamera) -> Box:
    """Return the largest box about the axis, square across it, whose section with the axis's plane is in the image.

    Along x it reaches as far as the nearer side of the image allows, along y as far as that, but not to the
    background; the corners are rounded inwards.
    """
    whole = camera.camera()
    steps = whole.project(torch.tensor([[0, 0, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)).numpy()
    origin, across, along = steps[0], steps[1] - steps[0], steps[2] - steps[0]  # px, px/mm: all at one depth
    height, width = whole.image_size
    far = np.array([width - 0.5, height - 0.5])
    # the corners (+-half, z) are in the image: upward z <= room - sideways half, for each of its four edges
    upward = np.concatenate([along, -along])
    sideways = np.abs(np.concatenate([across, across]))
    room = np.concatenate([far - origin, origin + 0.5])
    half, bottom, top = _largest(upward, sideways, room)
    behind = whole.depth(whole.plane) - float(camera.translation[2])  # the axis to the background, mm
    half = min(half, behind)
    if not min(half, top - bottom) * np.linalg.norm(across) > 1:
        raise InputError(
            f"expected an axis inside the image of {width} x {height} px (width x height), got "
            "one beside it or at its edge; check the order, COLUMN ROW, or give the box by --lower and --upper",
            field="axis_from, axis_to",
        )
    unit = 10.0 ** -math.floor(math.log10(min(half, top - bottom) / ROUNDING))
    before = math.ceil(behind * unit - ROUNDING_TOLERANCE) - 1  # the background has to be behind the box, not on it
    half = min(math.floor(half * unit + ROUNDING_TOLERANCE), before) / unit
    top = math.floor(top * unit + ROUNDING_TOLERANCE) / unit
    bottom = math.ceil(bottom * unit - ROUNDING_TOLERANCE) / unit
    return Box((-half, -half, bottom), (half, half, top))


def _largest(
    upward: Float[np.ndarray, 4], sideways: Float[np.ndarray, 4], room: Float[np.ndarray, 4]
) -> tuple[float, float, float]:
    """Half width, bottom and top of the largest rectangle with upward z + sideways half <= room; mm."""
    corners = [0.0]
    for i, j in itertools.combinations(range(4), 2):
        size = upward[i] * sideways[j] - upward[j] * sideways[i]
        if size != 0:
            corners.append((upward[i] * room[j] - upward[j] * room[i]) / size)
    widths = np.unique(np.clip(np.concatenate([corners, np.linspace(0, max(corners), WIDTHS)]), 0, None))
    margin = room - widths[:, None] * sideways
    level = np.abs(upward) < EDGE_TOLERANCE * np.abs(upward).max()
    with np.errstate(divide="ignore", invalid="ignore"):
        z = margin / upward
    bottom = np.where(~level & (upward < 0), z, -np.inf).max(axis=1)
    top = np.where(~level & (upward > 0), z, np.inf).min(axis=1)
    inside = (margin[:, level] >= -EDGE_TOLERANCE * np.abs(room).max()).all(axis=1) & (top > bottom)
    best = int(np.argmax(np.where(inside, widths * (top - bottom), 0.0)))
    return (float(widths[best]), float(bottom[best]), float(top[best])) if inside[best] else (0.0, 0.0, 0.0)
