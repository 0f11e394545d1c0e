"""Settings that networks and voxels share: what a pixel sees through, what is refined, bounds, faces, where to run."""

from __future__ import annotations

from dataclasses import dataclass

from nerif.common.conventions import InputError, parse_faces
from nerif.geometry.symmetry import NO_SYMMETRY, parse_symmetry
from nerif.reconstruction.aperture import check_aperture
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.bounds import check_bounds
from nerif.reconstruction.rig.parameters import check_refined

__all__ = ["SharedSettings"]


@dataclass(frozen=True)
class SharedSettings(Reconstructor):
    """Settings of every method."""

    aperture: str = "auto"
    """Pixels see through the whole of their lens where its aperture is known (auto, or on to insist), and displacements
    are means over their window where that is; or all are thin rays (off)."""
    refine: tuple[str, ...] = ()
    """Refined together with the field, held by their standard deviations: cameras (where they stand and look), shift
    (of whole images, as of a shaken camera), focal, background (its distance)."""
    pose_sigma_mm: float | None = None
    """Standard deviation of where a camera stands, mm; else the pose_sigma of the measurement, or 0.2."""
    pose_sigma_deg: float | None = None
    """Standard deviation of how a camera is turned, degrees; else the pose_sigma of the measurement, or 0.02."""
    shift_sigma_px: float = 0.05
    """Standard deviation of the shift of an image; of turn and zoom of it, at its edge, a fifth."""
    symmetry: str = NO_SYMMETRY
    """Of the flow: none, axis (alike all around it, so that one view is enough), axis+N (with N harmonics of the angle
    around it, for several views), or planar (alike along a line, as between windows)."""
    axis_point: tuple[float, float, float] | None = None
    """A point (x y z) of the axis, mm; else the middle of the box."""
    axis_direction: tuple[float, float, float] | None = None
    """Direction (x y z) of the axis, else z; or of the line of a planar flow, else the way the cameras look, along the
    box."""
    axis_sigma_mm: float | None = None
    """Standard deviation of where the axis is, mm, by which it is found; 0 for certain; else 3 % of the box."""
    axis_sigma_deg: float = 2.0
    """Standard deviation of how the axis leans, degrees; 0 for certain."""
    time_limit: float = 0.0
    """Stop after so many seconds; 0 for no limit."""
    lower: float | None = None
    """Lowest value that the field can have (of the index excess of hot gas: -2.7e-4); else that of the technique."""
    upper: float | None = None
    """Highest value that the field can have (of the index excess of hot gas in air: 0)."""
    ambient_faces: tuple[str, ...] = ()
    """Faces on which the index is ambient; empty: those of the measurement."""
    open_faces: tuple[str, ...] = ()
    """Faces through which flow leaves the box; rays that cross them are dropped."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, ..."""

    def __post_init__(self) -> None:
        if not self.time_limit >= 0:
            raise InputError(f"expected 0 or more, got {self.time_limit}", field="time_limit")
        check_aperture(self.aperture)
        check_refined(self.refine, self.pose_sigma_mm, self.pose_sigma_deg, self.shift_sigma_px)
        parse_symmetry(self.symmetry)
        for name in ("axis_sigma_mm", "axis_sigma_deg"):
            if not (getattr(self, name) or 0) >= 0:
                raise InputError(f"expected 0 or more, got {getattr(self, name)}", field=name)
        check_bounds(self.lower, self.upper)
        parse_faces(self.ambient_faces)
        parse_faces(self.open_faces, "open_faces")
