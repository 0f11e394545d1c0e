"""The camera: OpenCV's, perspective or telecentric, with five distortion coefficients, looking at a background plane.

x_cam = R x_world + t,   (x, y) = projection(x_cam) distorted by (k1, k2, p1, p2, k3),   pixel = K (x, y, 1)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import LARGEST_LENGTH, InputError, Matrix3, Pixels, Points, Values
from nerif.geometry.distortion import distort, fold, undistort
from nerif.geometry.lens import Lens, LensDiscs
from nerif.geometry.projection import PERSPECTIVE, Projection
from nerif.geometry.rays import BackgroundPoints, Rays

__all__ = ["Camera", "Plane"]

LARGEST_IMAGE = 100_000  # px
EVENLY = 33  # pixels along either edge that stand for a picture


@dataclass(frozen=True)
class Plane:
    """The plane normal . x = offset.

    Parameters
    ----------
    normal : (3,) unit vector, world frame
    offset : mm
    """

    normal: Float[Tensor, 3]
    offset: float


@dataclass(frozen=True)
class Camera:
    """A calibrated camera, and the background it looks at if there is one.

    Parameters
    ----------
    intrinsics : (3, 3) K, px; fx and fy of a telecentric camera in px/mm
    rotation : (3, 3) world to camera
    translation : (3,) world to camera, mm
    image_size : (height, width), px
    background : Plane of any orientation, world frame, mm; None for a technique that needs none
    distortion : (5,) OpenCV's k1, k2, p1, p2, k3; of a telecentric camera of (x, y) in mm
    name : what the view is called
    projection : perspective or telecentric
    lens : Lens whose whole disc a pixel sees through; None for a thin ray a pixel
    pose_sigma : (6,) standard deviations of its turn about its own axes (rad) and of the shift of its centre along them
        (mm); None where they are not known

    Raises
    ------
    InputError
        If the rotation is not one, or another number cannot be that of a camera.
    """

    intrinsics: Matrix3
    rotation: Matrix3
    translation: Float[Tensor, 3]
    image_size: tuple[int, int]
    background: Plane | None
    distortion: Float[Tensor, 5]
    name: str = "camera"
    projection: Projection = PERSPECTIVE
    lens: Lens | None = None
    pose_sigma: Float[Tensor, 6] | None = None

    def __post_init__(self) -> None:
        plane = self.background
        offset = 0.0 if plane is None else plane.offset
        for what, value, most, unit in (
            ("intrinsics", self.intrinsics, 1e7, "px"),
            ("translation", self.translation, LARGEST_LENGTH, "mm"),
            ("distortion", self.distortion, 1e6, ""),
            ("background_offset", torch.tensor(offset), LARGEST_LENGTH, "mm"),
        ):
            if not bool((value.abs() <= most).all()):
                got = value.tolist()
                raise InputError(
                    f"{what} of view '{self.name}': expected numbers up to {most:g} {unit}".rstrip() + f", got {got}"
                )
        if plane is not None and not abs(float(plane.normal.norm()) - 1) < 1e-2:
            raise InputError(
                f"background_normal of view '{self.name}': expected a unit vector, got {plane.normal.tolist()}"
            )
        r = self.rotation
        error = float((r @ r.T - torch.eye(3, dtype=r.dtype)).abs().max())
        determinant = float(torch.linalg.det(r))
        if not (error < 1e-4 and determinant > 0):
            raise InputError(
                f"rotation of view '{self.name}': expected a rotation matrix (R R^T = 1, det = +1), "
                f"got |R R^T - 1| = {error:.2g}, det = {determinant:.3g}; check for a swapped or mirrored axis"
            )
        k = self.intrinsics
        if not min(float(k[0, 0]), float(k[1, 1])) >= self.projection.least_scale:
            raise InputError(
                f"intrinsics of view '{self.name}': expected positive {self.projection.scale}s in "
                f"{self.projection.unit}, got fx = {float(k[0, 0]):.6g}, fy = {float(k[1, 1]):.6g}"
            )
        if abs(float(k[2, 2]) - 1) > 1e-9 or float(k[2, :2].abs().max()) > 0 or float(k[1, 0]) != 0:
            raise InputError(
                f"intrinsics of view '{self.name}': expected K = [[fx, s, cx], [0, fy, cy], [0, 0, 1]]; "
                "a transposed K (MATLAB) has to be transposed back"
            )
        if not (min(self.image_size) > 0 and max(self.image_size) <= LARGEST_IMAGE):
            raise InputError(
                f"image_size of view '{self.name}': expected (height, width) between 1 and {LARGEST_IMAGE} px, "
                f"got {self.image_size}"
            )
        if self.pose_sigma is not None and not bool(((self.pose_sigma >= 0) & (self.pose_sigma < torch.inf)).all()):
            raise InputError(
                f"pose_sigma of view '{self.name}': expected standard deviations of 0 or more, got "
                f"{self.pose_sigma.tolist()}"
            )
        if self.lens is not None and self.lens.diameter > 0:
            self._check_focus(self.lens)

    def _check_focus(self, lens: Lens) -> None:
        """Refuse a lens of which it is not known where it is in focus, or that is in focus where it is."""
        if lens.focus is None and self.background is None:
            raise InputError(
                f"focus_distance of view '{self.name}': expected mm along the optical axis for a lens of "
                f"{lens.diameter:g} mm that looks at no background, got none"
            )
        depth = self.depth(self.plane) if lens.focus is None else lens.focus
        if not (depth > 0 or (depth < 0 and not self.projection.shows_depth)):
            raise InputError(
                f"focus_distance of view '{self.name}': expected a lens in focus before the camera, got a depth of "
                f"{depth:g} mm; check background_offset, or give the distance"
            )

    @property
    def centre(self) -> Float[Tensor, 3]:
        """Origin of the camera's frame, mm, world frame: the optical centre of a perspective camera."""
        return -self.rotation.T @ self.translation

    def local(self, points: Points) -> Points:
        """World points (mm) in the camera's frame, mm."""
        return points @ self.rotation.T + self.translation

    def sight(self, points: Points) -> Points:
        """Unit directions in which the camera sees world points (mm), away from it, world frame."""
        return self.projection.sight(self.local(points)) @ self.rotation

    def distance(self, points: Points) -> Values:
        """How far the camera is from world points (mm), mm: infinitely far where its lines of sight are parallel."""
        return self.projection.distance(self.local(points))

    def pixel_size(self, points: Points) -> Values:
        """Width of a pixel, mm, at world points (mm), across the optical axis."""
        return 1 / (self.intrinsics[0, 0] * self.projection.magnification(self.local(points)))

    @property
    def plane(self) -> Plane:
        """The background.

        Raises
        ------
        InputError
            If the camera has none.
        """
        if self.background is None:
            raise InputError(f"background of view '{self.name}': expected a plane, normal . x = offset, got none")
        return self.background

    def pixel_grid(self) -> Float[Tensor, "row column 2"]:
        """All pixel centres, px."""
        height, width = self.image_size
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        return torch.stack([u, v], dim=-1).to(self.intrinsics.dtype)

    @property
    def unseen(self) -> float:
        """Share of the picture for which the distortion cannot be inverted, by EVENLY x EVENLY of its pixels."""
        height, width = self.image_size
        u, v = (torch.linspace(0, n - 1, min(n, EVENLY), dtype=torch.float64) for n in (width, height))
        rays = self.rays(torch.cartesian_prod(u, v).reshape(-1, 2), sensitivity=False)
        return 1 - float((rays.origin + rays.direction).isfinite().all(dim=-1).double().mean())

    def check_distortion(self) -> None:
        """Refuse a distortion that cannot be inverted over most of the picture."""
        if self.unseen > 0.5:
            raise InputError(
                f"distortion of view '{self.name}': expected coefficients that can be inverted over the image, "
                f"got {self.distortion.tolist()}; check their order (k1, k2, p1, p2, k3)"
            )

    def project(self, points: Points) -> Pixels:
        """Project world points (mm) to pixels (px); NaN where the distortion folds the image back."""
        return self._project_jacobian(points)[0]

    def rays(self, pixels: Float[Tensor, "n 2"], sensitivity: bool = True, view: int = 0) -> Rays:
        """Back-trace the rays seen by `pixels` (px), to the background where there is one; not yet clipped to a box.

        A pixel for which the distortion cannot be inverted has a ray of NaN, which crosses no box.

        Parameters
        ----------
        sensitivity : whether S = -d project / d X at the background point X0 is wanted (S . direction = 0), else 0
        view : number of the view, kept with the rays
        """
        k = self.intrinsics
        y = (pixels[..., 1] - k[1, 2]) / k[1, 1]
        x = (pixels[..., 0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
        ideal = undistort(torch.stack([x, y], dim=-1), self.distortion)
        start, heading = self.projection.lines(ideal)
        direction = heading @ self.rotation
        direction = direction / direction.norm(dim=-1, keepdim=True)
        origin = (self.centre + start @ self.rotation).expand_as(direction)
        zero = torch.zeros_like(pixels[..., 0])
        number = torch.full(zero.shape, view, dtype=torch.int16)
        ends = self._background_points(origin, direction, sensitivity)
        lens = self._lens_discs(direction, ends)
        begin = torch.full_like(zero, self.projection.begin)
        return Rays(origin, direction, zero, zero, pixels, number, begin, ends, lens)

    def depth(self, plane: Plane) -> float:
        """Return where the optical axis meets a plane, mm from z_cam = 0."""
        normal = plane.normal.to(self.rotation)
        return float(plane.offset - self.centre @ normal) / float(self.rotation[2] @ normal)

    def stopped_down(self, pixel_pitch: float, f_number: float) -> Camera:
        """Return the camera with a lens that is focused on its background.

        Parameters
        ----------
        pixel_pitch : of its sensor, mm
        f_number : focal length over aperture; of a telecentric lens that on the sensor's side; 0 for thin rays
        """
        if not f_number >= 0:
            raise InputError(f"f_number: expected above 0, or 0 for thin rays, got {f_number}")
        if f_number == 0:
            return replace(self, lens=None)
        depth = self.depth(self.plane)
        on_axis = self.centre + depth * self.rotation[2]
        return replace(self, lens=Lens(depth * pixel_pitch / float(self.pixel_size(on_axis)) / f_number))

    @property
    def without_background(self) -> Camera:
        """The camera that looks at none, in focus where it was."""
        lens = self.lens
        if lens is not None and lens.diameter > 0 and lens.focus is None:
            lens = replace(lens, focus=self.depth(self.plane))
        return replace(self, background=None, lens=lens)

    @property
    def without_window(self) -> Camera:
        """The camera of which every pixel measures by itself."""
        return self if self.lens is None else replace(self, lens=replace(self.lens, window=0.0))

    def _lens_discs(self, direction: Points, ends: BackgroundPoints | None) -> LensDiscs | None:
        """The lens as rays see it."""
        if self.lens is None:
            return None
        axis = self.rotation[2].to(direction)
        if self.lens.focus is not None:
            focus = self.lens.focus / (direction @ axis)
        elif ends is not None:
            focus = ends.distance
        else:  # a thin ray beside others that are none
            focus = torch.full_like(direction[..., 0], torch.inf)
        normal = axis if self.background is None else self.background.normal.to(direction)
        radius = torch.full_like(focus, self.lens.diameter / 2)
        window = torch.full_like(focus, self.lens.window / 2)
        parallel = torch.full_like(focus, not self.projection.shows_depth, dtype=torch.bool)
        return LensDiscs(axis.expand_as(direction), normal.expand_as(direction), radius, focus, window, parallel)

    def _background_points(self, origin: Points, direction: Points, sensitivity: bool) -> BackgroundPoints | None:
        """Where rays meet the background, and S there."""
        if self.background is None:
            return None
        normal = self.background.normal.to(direction)
        distance = (self.background.offset - origin @ normal) / (direction @ normal)
        if not sensitivity:
            return BackgroundPoints(torch.zeros_like(distance)[:, None, None].expand(-1, 2, 3), distance)
        return BackgroundPoints(-self._project_jacobian(origin + distance[..., None] * direction)[1], distance)

    def view(self, row: int, column: int, height: int, width: int) -> Camera:
        """Return the camera of a crop of its image that starts at (row, column), px."""
        shift = torch.zeros_like(self.intrinsics)
        shift[0, 2], shift[1, 2] = column, row
        return replace(self, intrinsics=self.intrinsics - shift, image_size=(height, width))

    def _project_jacobian(self, points: Points) -> tuple[Pixels, Float[Tensor, "*batch 2 3"]]:
        """Pixels and d pixel / d X (px/mm)."""
        local = self.local(points)
        image, slope = self.projection.image(local), self.projection.slope
        folded = image.norm(dim=-1, keepdim=True) > fold(self.distortion)
        seen = image.masked_fill(folded, torch.nan)
        x, y, (xx, cross, yy) = distort(seen[..., 0], seen[..., 1], self.distortion)
        k = self.intrinsics
        pixels = torch.stack([k[0, 0] * x + k[0, 1] * y + k[0, 2], k[1, 1] * y + k[1, 2]], dim=-1)
        # row by row: small matrix products are slow in a batch
        u = slope(k[0, 0] * xx + k[0, 1] * cross, k[0, 0] * cross + k[0, 1] * yy, image, local)
        v = slope(k[1, 1] * cross, k[1, 1] * yy, image, local)
        return pixels, torch.stack([*u, *v], dim=-1).unflatten(-1, (2, 3)) @ self.rotation
