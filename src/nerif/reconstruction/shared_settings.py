"""Settings that networks and voxels share: aperture, refined poses, symmetry, bounds, faces of the box, device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from nerif.common.conventions import ambient_index, parse_faces
from nerif.common.settings import NonNegative, OptionName, check_settings
from nerif.geometry.region import Region, check_region
from nerif.geometry.symmetry_names import NO_SYMMETRY, parse_symmetry
from nerif.reconstruction.bounds import check_bounds
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.rig_groups import check_refined

__all__ = ["SHORT_RUN", "Aperture", "SharedSettings", "Source"]

Aperture = Literal["auto", "on", "off"]
Source = Annotated[Literal["auto", "images", "displacements", "both"], OptionName("from")]

SHORT_RUN: Final = 0.2
"""Share of the limits of a run that its cross-validation run gets."""


@dataclass(frozen=True)
class SharedSettings(Reconstructor):
    """Settings of every method."""

    aperture: Aperture = "auto"
    """Finite aperture: several rays per pixel and displacements averaged over their windows, where the measurement
    states them (auto; on: required) or thin rays (off)."""
    refine: tuple[str, ...] = ()
    """Camera parameters to refine together with the field: cameras (pose), shift (of whole images, as by vibration),
    focal (length), background (distance)."""
    pose_sigma_mm: float | None = None
    """Standard deviation of camera positions, mm (default: pose_sigma of the measurement, else 0.2)."""
    pose_sigma_deg: float | None = None
    """Standard deviation of camera orientations, degrees (default: pose_sigma of the measurement, else 0.02)."""
    shift_sigma_px: float = 0.05
    """Standard deviation of image shifts, px; rotation and zoom move the image edge by a fifth of it."""
    symmetry: str = NO_SYMMETRY
    """Symmetry of the flow: none, axis (axisymmetric; one view suffices), axis+N (N azimuthal harmonics, for several
    views), or planar (constant along a line)."""
    axis_point: tuple[float, float, float] | None = None
    """Point x y z on the axis of symmetry, mm (default: centre of the box)."""
    axis_direction: tuple[float, float, float] | None = None
    """Direction x y z of the axis (default: z), or of the line of a planar flow (default: along the box edge nearest to
    the viewing direction)."""
    axis_sigma_mm: NonNegative | None = None
    """Standard deviation of the position of the axis, mm (0: fixed; default: 3 % of the box)."""
    axis_sigma_deg: NonNegative = 2.0
    """Standard deviation of the tilt of the axis, degrees (0: fixed)."""
    time_limit: NonNegative = 0.0
    """Time limit in seconds (0: none); of nerif reconstruct it counts everything from the start to the report."""
    lower: float | None = None
    """Lower bound of the field, such as -2.7e-4 for the index excess of hot gas (default: that of the technique)."""
    upper: float | None = None
    """Upper bound of the field, such as 0 for the index excess of hot gas in air (default: that of the technique)."""
    ambient_faces: tuple[str, ...] = ()
    """Faces of the box with ambient index, out of x- x+ y- y+ z- z+ (default: those of the measurement)."""
    ambient_region: Region | None = None
    """Region with ambient index, x0 x1 y0 y1 z0 z1 in mm, such as the stream ahead of a shock; in place of the faces
    of the measurement, unless --ambient-faces names some."""
    probes: Annotated[tuple[tuple[float, float, float, float], ...], OptionName("known")] = ()
    """Points x y z in mm with the refractive index there, as 5 0 -20 1.000271; in place of the faces of
    the measurement, too."""
    open_faces: tuple[str, ...] = ()
    """Faces through which the flow leaves the box; rays that cross them are excluded."""
    device: str = "auto"
    """Device: auto (cuda or xpu if present, else cpu), cpu, cuda (NVIDIA, AMD), cuda:1, xpu (Intel), mps (Apple)."""

    def __post_init__(self) -> None:
        check_settings(self)
        check_refined(self.refine, self.pose_sigma_mm, self.pose_sigma_deg, self.shift_sigma_px)
        parse_symmetry(self.symmetry)
        check_bounds(self.lower, self.upper)
        parse_faces(self.ambient_faces)
        if self.ambient_region is not None:
            check_region(self.ambient_region)
        for *_, index in self.probes:
            ambient_index(index, "known")
        parse_faces(self.open_faces, "open_faces")
