"""Settings of a calibration: from target images, from lengths at one camera, and of imported files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from annotated_types import Ge, Le, Lt
from jaxtyping import Float

from nerif.common.conventions import FACES, InputError
from nerif.common.settings import Length, Positive, check_settings
from nerif.geometry.projection import PROJECTIONS, Projection, projection_named

if TYPE_CHECKING:
    from nerif.geometry.lens import Lens

__all__ = ["COEFFICIENTS", "TILT", "CalibrationSettings", "ImportSettings", "Pixel", "SimpleRig"]

COEFFICIENTS, TILT = ("k1", "k2", "p1", "p2", "k3"), ("tau_x", "tau_y")
Pixel = tuple[float, float]


@dataclass(frozen=True)
class CalibrationSettings:
    """Settings of a calibration from target images."""

    projection: Literal[*PROJECTIONS] = "perspective"  # type: ignore[valid-type]
    """Projection of all cameras: perspective or telecentric."""
    distortion: tuple[str, ...] = ("k1", "k2", "p1", "p2")
    """Distortion coefficients to determine, from k1 k2 p1 p2 k3; the others are 0."""
    scheimpflug: bool = False
    """Determine the two tilt angles of each sensor, of lenses on Scheimpflug adapters; perspective only."""
    world: str = ""
    """Name of the target pose that defines the world frame; default: the one that most cameras see."""
    axes: tuple[str, str, str] = ("x+", "z+", "y-")
    """World x, y, z along axes of the target in that pose (x right, y down, z into the page); default: z is up."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the target in that pose, in world coordinates, mm."""
    max_error: Positive = 1.0
    """Largest rms reprojection error to accept, px."""
    side: tuple[str, str] | None = None
    """For telecentric cameras: one view and the side of the world on which it stands, such as cam1 x+; images of flat
    targets do not distinguish a telecentric rig from its mirror image."""

    def __post_init__(self) -> None:
        for name in self.distortion:
            if name not in COEFFICIENTS:
                raise InputError(
                    f"expected coefficients from {' '.join(COEFFICIENTS)}, got '{name}'", field="distortion"
                )
        check_settings(self)
        if self.scheimpflug and not self.kind.shows_depth:
            raise InputError(
                f"expected perspective, got {self.projection}; leave it out, since fx and fy of parallel rays describe "
                "a sensor tilted about its rows or columns",
                field="scheimpflug",
            )
        if not self.kind.shows_depth and (self.side is None or self.side[1] not in FACES):
            raise InputError(
                f"expected a view and the side of the world on which it stands ({' '.join(FACES)}), such as cam1 x+, "
                "since images of flat targets do not distinguish a telecentric rig from its mirror image; got "
                f"{self.side}",
                field="side",
            )
        if not np.isclose(np.linalg.det(self.rotation), 1):
            raise InputError(
                f"expected three different axes of the target that make a right-handed world, such as x+ z+ y-, "
                f"got {' '.join(self.axes)}",
                field="axes",
            )

    def check_names(self, names: Sequence[str]) -> None:
        """Refuse a side of a view that is not among these."""
        if self.side is not None and self.side[0] not in names:
            raise InputError(f"expected one of {', '.join(names)}, got '{self.side[0]}'", field="side")

    @property
    def kind(self) -> Projection:
        """Projection of the cameras."""
        return projection_named(self.projection)

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Coefficients of distortion and tilt to determine."""
        return (*self.distortion, *(TILT if self.scheimpflug else ()))

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from the target's axes to the world's."""
        unit = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
        rows = [np.array(unit.get(a.rstrip("+-"), (0, 0, 0))) * (-1 if a.endswith("-") else 1) for a in self.axes]
        return np.array(rows, dtype=np.float64)


@dataclass(frozen=True)
class SimpleRig:
    """Measures of one camera that looks across the axis of a flow."""

    distance: Length | None = None
    """With --simple: distance along the optical axis from the camera (entrance pupil) to the axis of the flow, mm."""
    mm_per_px: Length | None = None
    """With --simple: mm per pixel at the axis: length of a ruler held there over its length in the image."""
    focal_length: Length | None = None
    """With --simple, without mm_per_px: focal length of the lens, mm; some per cent off for close-ups."""
    pixel_pitch_um: Length | None = None
    """With --focal-length: pixel pitch of the sensor, micrometres."""
    f_number: Length | None = None
    """With --focal-length: f-number of the lens, which is then focused on the background; without it, thin rays."""
    axis_from: Pixel | None = None
    """With --simple: column and row of a point of the axis; default: the middle of the image's lower edge."""
    axis_to: Pixel | None = None
    """With --simple: column and row of a point further along z+ (downstream); default: the middle of the upper edge."""
    principal_point: Pixel | None = None
    """With --simple: column and row of the optical axis, if it is not in the middle of the image (of a crop)."""

    def __post_init__(self) -> None:
        check_settings(self)
        for name in ("axis_from", "axis_to", "principal_point"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(math.fsum(value)):
                raise InputError(f"expected column and row of a pixel, got {value}", field=name)
        first, last = self.axis_from, self.axis_to
        if (first is None) != (last is None) or (first and last and not math.dist(first, last) >= 1):
            got = f"{first} and {last}"
            raise InputError(
                f"expected two pixels at least 1 px apart or neither, got {got}", field="axis_from, axis_to"
            )
        if self.mm_per_px is not None and self.pixel_pitch_um is not None:
            raise InputError("expected one of the two scales, got both", field="mm_per_px, pixel_pitch_um")
        if self.f_number is not None and self.focal_length is None:
            raise InputError(
                "expected together with focal_length, got it alone; or give --aperture-diameter, their quotient in mm",
                field="f_number",
            )

    @property
    def entries(self) -> dict[str, float | Pixel]:
        """The measures that are not None."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def scale(self) -> float:
        """Width of a pixel at the axis, mm."""
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
        """The distance, mm."""
        if self.distance is None:
            raise InputError("expected mm from the camera to the axis of the flow, got none", field="distance")
        return self.distance


@dataclass(frozen=True)
class ImportSettings:
    """Properties of the cameras that the file of another program may lack."""

    scale_mm: Positive | None = None
    """Unit of length of the imported file, mm (default: 1; 1000 for files of ROS and kalibr, which are in metres)."""
    pose: int = 1
    """Number of the target image that defines the world frame, for MATLAB files with one pose per image."""
    background_distance: float | None = None
    """Distance from the origin to backgrounds whose planes are not in the file, across the optical axis, mm; also for
    target images, and for --simple, where the origin is on the axis of the flow."""
    image_size: tuple[int, int] | None = None
    """Height and width of the images where the file lacks them, px."""
    first_pixel: Annotated[float, Ge(0), Le(1)] | None = None
    """Coordinate of the centre of the first pixel in a .csv of DLT coefficients, which need it, or of points (default:
    0): 1 in files of MATLAB (DLTdv, easyWand), 0.5 where the image begins at 0."""
    rows_upward: bool = False
    """In such a .csv, rows count from the lower edge of the image, as in Argus and before version 8 in DLTdv; needs the
    image size."""
    aperture_diameter: float | None = None
    """Diameter of the entrance pupils (focal length / f-number), mm; overrides the file; 0: thin rays. Of telecentric
    lenses: of the cone of rays at z_cam = 0, which calibration places at the origin. Also for target images."""
    focus_distance: float | None = None
    """Distance of the plane in focus along the optical axis, mm; default: that of the file, or the background."""
    pose_sigma_mm: Annotated[float, Ge(0), Lt(math.inf)] | None = None
    """Standard deviation of the camera positions, mm, the prior of reconstruct --refine; default with target images:
    0.05 in addition to their noise; with --simple: 1."""
    pose_sigma_deg: Annotated[float, Ge(0), Lt(math.inf)] | None = None
    """Standard deviation of the camera rotations, degrees; default with target images: 0.005 in addition to their
    noise; with --simple: 0.5."""
    interfaces: Path | None = None
    """File .toml of windows between cameras and flow, through which the target images were taken, or which were not
    there when the calibration file was made: tables [[interface]] with normal, offset (mm), index and, if not of all
    cameras, views."""

    def __post_init__(self) -> None:
        if self.focus_distance is not None and self.aperture_diameter is None:
            raise InputError("expected together with aperture_diameter, got it alone", field="focus_distance")
        if self.aperture_diameter is not None:
            _ = self.lens  # validates its numbers
        check_settings(self)
        if (self.pose_sigma_mm is None) != (self.pose_sigma_deg is None):
            raise InputError("expected both or neither", field="pose_sigma_mm, pose_sigma_deg")

    @property
    def pose_sigma(self) -> tuple[float, float] | None:
        """Standard deviations of the position (mm) and rotation (degrees) of cameras."""
        if self.pose_sigma_mm is None or self.pose_sigma_deg is None:
            return None
        return self.pose_sigma_mm, self.pose_sigma_deg

    @property
    def lens(self) -> Lens | None:
        """Lens of every camera, or None for thin rays or that of the file."""
        from nerif.geometry.lens import Lens

        lens = Lens(self.aperture_diameter or 0.0, self.focus_distance)
        return lens if lens.diameter else None
