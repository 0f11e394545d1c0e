"""Rings of cameras around a flow, each with a background behind it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from nerif.common.conventions import InputError
from nerif.common.settings import Count, Length, check_settings
from nerif.geometry.projection import MAX_TILT, PROJECTIONS, Projection, projection_named

if TYPE_CHECKING:
    from nerif.geometry.camera import Camera
    from nerif.geometry.grid import Box

__all__ = ["Ring", "paper_rig"]


@dataclass(frozen=True)
class Ring:
    """A ring of identical cameras aimed at the origin, z up."""

    views: Count = 9
    """Number of cameras, equally spaced over the arc, both ends included."""
    arc: tuple[float, float] = (0.0, 170.0)
    """First and last azimuth, degrees."""
    extra_angles: tuple[float, ...] = ()
    """Azimuths of further cameras, such as withheld ones, degrees."""
    elevation: float = 0.0
    """Elevation of the optical axes above the horizontal, degrees."""
    projection: Literal[*PROJECTIONS] = "perspective"  # type: ignore[valid-type]
    """Projection: perspective, or telecentric (parallel rays)."""
    focal_length: Length = 50.0
    """Focal length, mm."""
    magnification: Length | None = None
    """Magnification of telecentric lenses; default: focal_length / distance."""
    pixel_pitch: Length = 0.02
    """Pixel pitch of the sensor, mm."""
    image_size: tuple[Count, Count] = (200, 200)
    """Image height and width, px."""
    sensor_tilt: tuple[float, float] = (0.0, 0.0)
    """Tilt of the sensors about their x and y, of Scheimpflug lenses, degrees below 45."""
    distance: Length = 700.0
    """Distance from the lens to the centre of the box, mm."""
    background_distance: Length = 500.0
    """Distance from the centre of the box to the background, mm."""

    def __post_init__(self) -> None:
        check_settings(self)
        for name in ("arc", "extra_angles", "elevation", "sensor_tilt"):
            angles = getattr(self, name)
            if not math.isfinite(math.fsum(angles if isinstance(angles, tuple) else (angles,))):
                raise InputError(f"expected degrees, got {angles}", field=name)
        if max(map(abs, self.sensor_tilt)) >= MAX_TILT:
            raise InputError(f"expected below {MAX_TILT:g} degrees, got {self.sensor_tilt}", field="sensor_tilt")
        if self.magnification is not None and self.kind.shows_depth:
            raise InputError(f"expected projection = telecentric, got {self.projection}", field="magnification")

    @property
    def kind(self) -> Projection:
        """Projection of the cameras."""
        return projection_named(self.projection)

    @property
    def scale(self) -> float:
        """Entries fx = fy of K: px, or px/mm of telecentric cameras."""
        magnification = self.magnification or self.focal_length / self.distance
        return (self.focal_length if self.kind.shows_depth else magnification) / self.pixel_pitch

    @property
    def angles(self) -> tuple[float, ...]:
        """Azimuths of all cameras, degrees."""
        first, last = self.arc
        step = (last - first) / max(self.views - 1, 1)
        return tuple(first + i * step for i in range(self.views)) + tuple(self.extra_angles)

    def cameras(self, f_number: float = 0.0) -> tuple[Camera, ...]:
        """Return the cameras, named by their azimuth; an f-number of 0 is for thin rays."""
        names = [f"{angle:g}deg" for angle in self.angles]
        if len(set(names)) < len(names):
            raise InputError(f"expected cameras at different angles, got {', '.join(names)}", field="views")
        cameras = (self._camera(angle, name) for angle, name in zip(self.angles, names, strict=True))
        return tuple(camera.with_f_number(self.pixel_pitch, f_number) for camera in cameras)

    def _camera(self, azimuth: float, name: str) -> Camera:
        import torch

        from nerif.geometry.camera import Camera, Plane

        a, e = math.radians(azimuth), math.radians(self.elevation)
        outward = torch.tensor([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)], dtype=torch.float64)
        forward = -outward
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        right = torch.linalg.cross(forward, up)
        right = right / right.norm()
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        height, width = self.image_size
        f, cx, cy = self.scale, (width - 1) / 2, (height - 1) / 2
        intrinsics = torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]], dtype=torch.float64)
        return Camera(
            intrinsics=intrinsics,
            rotation=rotation,
            translation=-rotation @ (self.distance * outward),
            image_size=self.image_size,
            background=Plane(outward, -self.background_distance),
            distortion=torch.zeros(5, dtype=torch.float64),
            name=name,
            projection=self.kind,
            tilt=torch.deg2rad(torch.tensor(self.sensor_tilt, dtype=torch.float64)),
        )


def paper_rig(pixels: int = 200, extra_angles: tuple[float, ...] = ()) -> tuple[tuple[Camera, ...], Box]:
    """Return the cameras and the box of the paper's numerical study (paper, Tab. I).

    Nine views at 0-170 degrees, 200 x 200 pixels of 20 um, a 50 mm lens, a 50 mm cube entirely in the image. The paper
    does not state the distances; here they are 700 mm to the centre and another 500 mm to the background. With other
    `pixels` the size of the sensor stays the same.
    """
    from nerif.geometry.grid import Box

    ring = Ring(pixel_pitch=0.02 * 200 / pixels, image_size=(pixels, pixels), extra_angles=extra_angles)
    return ring.cameras(), Box.cube(50.0)
