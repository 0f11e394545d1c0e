"""One camera from what a ruler tells: how far it is from the axis of a flow, and where that axis is in its image.

    x_cam = (X, Y, D)      points of the axis, which lies in a plane across the optical axis, D mm from the camera
    z = drawn axis, y = optical axis, x = y x z         world, about the point of the axis nearest the principal point

With the axis upright in the image, x is to its right, y away from the camera, z up.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.geometry import Box, Lens, Plane
from nerif.imaging.calibration.cameras_file import CalibratedCamera, checked
from nerif.imaging.calibration.importers.importers import ImportSettings
from nerif.imaging.readers.open import open_frames
from nerif.imaging.readers.views import find_views

__all__ = ["RULER", "SimpleRig", "box_about_axis", "find_image", "simple_camera"]

RULER = 1.0, 0.5
"""How far the camera may stand (mm) and be turned (degrees) from where a ruler has it, where nobody says."""
STEPS = 1000  # of the half width at which a box is tried
PARTS = 100  # a corner of the box is rounded to a power of ten below this part of its edges
SLACK = 1e-6  # of a step of the rounding: what a number may lack of being one
TOGETHER = 1e-9  # of the image: what lies this close to its edge is on it

Pixel = tuple[float, float]


@dataclass(frozen=True)
class SimpleRig:
    """One camera that looks across the axis of a flow.

    Raises
    ------
    InputError
        If a length is not positive, or the axis is no line.
    """

    distance: float | None = None
    """With --simple: camera (entrance pupil of its lens) to the axis of the flow, along the optical axis, mm."""
    mm_per_px: float | None = None
    """With --simple: mm that a pixel shows at the axis: length of a ruler held there over its length in the image."""
    focal_length: float | None = None
    """With --simple, where mm_per_px is not known: focal length of the lens, mm; some per cent off for close-ups."""
    pixel_pitch_um: float | None = None
    """With --focal-length: distance between the sensor's pixels, micrometres."""
    f_number: float | None = None
    """With --focal-length: f-number of the lens, focused on the background, through all of which a pixel then sees."""
    axis_from: Pixel | None = None
    """With --simple: column and row of a point of the axis; default: the middle of the image's lower edge."""
    axis_to: Pixel | None = None
    """With --simple: column and row of another one, along z+ (downstream); default: the middle of the upper edge."""
    principal_point: Pixel | None = None
    """With --simple: column and row of the optical axis, where that is not in the middle of the image (of a crop)."""

    def __post_init__(self) -> None:
        for name in ("distance", "mm_per_px", "focal_length", "pixel_pitch_um", "f_number"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"expected a positive number, got {value}", field=name)
        for name in ("axis_from", "axis_to", "principal_point"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(math.fsum(value)):
                raise InputError(f"expected column and row of a pixel, got {value}", field=name)
        if (self.axis_from is None) != (self.axis_to is None):
            raise InputError("expected two points of the axis or neither", field="axis_from, axis_to")
        if self.axis_from and self.axis_to and not math.dist(self.axis_from, self.axis_to) >= 1:
            raise InputError(
                f"expected two pixels of the axis, far from one another, got {self.axis_from} and {self.axis_to}",
                field="axis_from, axis_to",
            )
        if self.mm_per_px is not None and self.pixel_pitch_um is not None:
            raise InputError(
                "expected one of the two, since either tells the scale; leave out the pitch",
                field="mm_per_px, pixel_pitch_um",
            )
        if self.f_number is not None and self.focal_length is None:
            raise InputError(
                "expected together with focal_length, got it alone; or give --aperture-diameter, their quotient in mm",
                field="f_number",
            )

    @property
    def given(self) -> dict[str, float | Pixel]:
        """What is said, by its name."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def scale(self) -> float:
        """Width of a pixel at the axis, mm.

        Raises
        ------
        InputError
            If it is not known.
        """
        if self.mm_per_px is not None:
            return self.mm_per_px
        if self.focal_length is None or self.pixel_pitch_um is None:
            raise InputError(
                "expected the scale at the axis, or focal_length and pixel_pitch_um; hold a ruler at the "
                "axis, and divide its length by that in the image",
                field="mm_per_px",
            )
        return self.depth * self.pixel_pitch_um / 1000 / self.focal_length

    @property
    def depth(self) -> float:
        """The distance, mm; InputError if it is not known."""
        if self.distance is None:
            raise InputError(
                "expected mm from the camera to the axis of the flow, got none; measure it", field="distance"
            )
        return self.distance


def find_image(
    source: Path, only: Sequence[str] = (), image_size: tuple[int, int] | None = None
) -> tuple[str, tuple[int, int]]:
    """Return the name of the one view of an experiment, and the height and width of its images, px.

    Parameters
    ----------
    source : folder of the experiment, or an image; its view is called "camera", unless `only` has a name
    only : name of the view, needed where there are several
    image_size : height and width, px, where no image is to be looked at

    Raises
    ------
    InputError
        If there is none or more than one, or an image cannot be read.
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
        shape = view.open("reference").shape
        image_size = view.crop.shape_of(shape, view.open("reference").name(0)) if view.crop else shape
    return view.name, image_size


def simple_camera(
    rig: SimpleRig, image_size: tuple[int, int], given: ImportSettings, name: str = "camera"
) -> CalibratedCamera:
    """Return the camera, which sees the axis of the flow exactly where it was drawn.

    Parameters
    ----------
    rig : what was measured
    image_size : height and width, px
    given : background_distance, from the axis on, mm; lens and pose_sigma, if they are known
    name : of the view

    Raises
    ------
    InputError
        If a length is missing.
    """
    depth, scale, behind = rig.depth, rig.scale, given.background_distance
    if behind is None or not 0 < behind < math.inf:
        raise InputError(
            f"expected a positive number of mm from the axis of the flow to the background, got {behind}; measure it",
            field="background_distance",
        )
    lens = given.lens
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
    moved, turned = given.pose_sigma or RULER
    numbers = torch.float64
    camera = CalibratedCamera(
        name=name,
        intrinsics=torch.tensor([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]], dtype=numbers),
        rotation=torch.tensor([[0 - down, 0, right], [right, 0, down], [0, 1, 0]], dtype=numbers),
        translation=torch.tensor([*shift, depth], dtype=numbers),
        distortion=torch.zeros(5, dtype=numbers),
        image_size=image_size,
        background=Plane(torch.tensor([0, -1, 0], dtype=numbers), -behind),
        lens=lens,
        pose_sigma=torch.tensor([math.radians(turned)] * 3 + [moved] * 3, dtype=numbers),
    )
    return checked(camera, "simple rig")


def box_about_axis(camera: CalibratedCamera) -> Box:
    """Return the largest box about the axis, square across it, that the image shows whole in the axis's plane.

    Along x it reaches as far as the nearer side of the image allows, along y as far as that, but ends before the
    background; the corners are rounded inwards.

    Parameters
    ----------
    camera : of a simple rig

    Raises
    ------
    InputError
        If the axis is not in the image, or at its edge.
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
    unit = 10.0 ** -math.floor(math.log10(min(half, top - bottom) / PARTS))
    before = math.ceil(behind * unit - SLACK) - 1  # a box that touches the background is none before it
    half, top = min(math.floor(half * unit + SLACK), before) / unit, math.floor(top * unit + SLACK) / unit
    bottom = math.ceil(bottom * unit - SLACK) / unit
    return Box((-half, -half, bottom), (half, half, top))


def _largest(
    upward: Float[np.ndarray, 4], sideways: Float[np.ndarray, 4], room: Float[np.ndarray, 4]
) -> tuple[float, float, float]:
    """Half width, bottom and top of the largest rectangle of which upward z + sideways half <= room; mm."""
    corners = [0.0]
    for i, j in itertools.combinations(range(4), 2):
        size = upward[i] * sideways[j] - upward[j] * sideways[i]
        if size != 0:
            corners.append((upward[i] * room[j] - upward[j] * room[i]) / size)
    tried = np.unique(np.clip(np.concatenate([corners, np.linspace(0, max(corners), STEPS)]), 0, None))
    left = room - tried[:, None] * sideways
    level = np.abs(upward) < TOGETHER * np.abs(upward).max()
    with np.errstate(divide="ignore", invalid="ignore"):
        at = left / upward
    bottom = np.where(~level & (upward < 0), at, -np.inf).max(axis=1)
    top = np.where(~level & (upward > 0), at, np.inf).min(axis=1)
    inside = (left[:, level] >= -TOGETHER * np.abs(room).max()).all(axis=1) & (top > bottom)
    best = int(np.argmax(np.where(inside, tried * (top - bottom), 0.0)))
    return (float(tried[best]), float(bottom[best]), float(top[best])) if inside[best] else (0.0, 0.0, 0.0)
