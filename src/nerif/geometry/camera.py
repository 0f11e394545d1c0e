"""The camera: an OpenCV pinhole with five distortion coefficients, looking at a background plane.

x_cam = R x_world + t,   (x, y) = (X/Z, Y/Z) distorted by (k1, k2, p1, p2, k3),   pixel = K (x, y, 1)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import LARGEST_LENGTH, InputError, Matrix3, Pixels, Points
from nerif.geometry.rays import BackgroundPoints, Rays

__all__ = ["Camera", "Plane"]

LEAST_FOCAL = 1.0  # px
LARGEST_IMAGE = 100_000  # px


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
    intrinsics : (3, 3) K, px
    rotation : (3, 3) world to camera
    translation : (3,) world to camera, mm
    image_size : (height, width), px
    background : Plane of any orientation, world frame, mm; None for a technique that needs none
    distortion : (5,) OpenCV's k1, k2, p1, p2, k3
    name : what the view is called

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
        if not (float(k[0, 0]) >= LEAST_FOCAL and float(k[1, 1]) >= LEAST_FOCAL):
            raise InputError(
                f"intrinsics of view '{self.name}': expected positive focal lengths in px, "
                f"got fx = {float(k[0, 0]):.6g}, fy = {float(k[1, 1]):.6g}"
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

    @property
    def centre(self) -> Float[Tensor, 3]:
        """Optical centre, mm, world frame."""
        return -self.rotation.T @ self.translation

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

    def project(self, points: Points) -> Pixels:
        """Project world points (mm) to pixels (px)."""
        return self._project_jacobian(points)[0]

    def rays(self, pixels: Float[Tensor, "n 2"], sensitivity: bool = True, view: int = 0) -> Rays:
        """Back-trace the rays seen by `pixels` (px), to the background where there is one; not yet clipped to a box.

        Parameters
        ----------
        sensitivity : whether S = -d project / d X at the background point X0 is wanted (S . direction = 0), else 0
        view : number of the view, kept with the rays
        """
        k = self.intrinsics
        y = (pixels[..., 1] - k[1, 2]) / k[1, 1]
        x = (pixels[..., 0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
        ideal = self._undistort(torch.stack([x, y], dim=-1))
        direction = torch.cat([ideal, torch.ones_like(ideal[..., :1])], dim=-1) @ self.rotation
        direction = direction / direction.norm(dim=-1, keepdim=True)
        origin = self.centre.expand_as(direction)
        zero = torch.zeros_like(pixels[..., 0])
        number = torch.full(zero.shape, view, dtype=torch.int16)
        ends = self._background_points(origin, direction, sensitivity)
        return Rays(origin, direction, zero, zero, pixels, number, ends)

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
        local = points @ self.rotation.T + self.translation
        depth = local[..., 2:]
        ideal = local[..., :2] / depth
        distorted, inner = self._distort(ideal)
        k = self.intrinsics[:2, :2]
        pixels = distorted @ k.T + self.intrinsics[:2, 2]
        # k inner (R[:2] - ideal R[2]) / depth, one row of it after the other: small matrix products are slow in a batch
        (xx, xy), (yx, yy) = (row.unbind(-1) for row in inner.unbind(-2))
        rows = []
        u, v = (k[0, 0] * xx + k[0, 1] * yx, k[0, 0] * xy + k[0, 1] * yy), (k[1, 1] * yx, k[1, 1] * yy)
        for along_x, along_y in (u, v):
            rows += [along_x, along_y, -(along_x * ideal[..., 0] + along_y * ideal[..., 1])]
        jacobian = (torch.stack(rows, dim=-1) / depth).unflatten(-1, (2, 3)) @ self.rotation
        return pixels, jacobian

    def _distort(self, ideal: Pixels) -> tuple[Pixels, Float[Tensor, "*batch 2 2"]]:
        """OpenCV's distortion of ideal image coordinates, and its Jacobian."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = ideal.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / d r2, times 2
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
        xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        jacobian = torch.stack([torch.stack([xx, cross], -1), torch.stack([cross, yy], -1)], -2)
        return torch.stack([xd, yd], -1), jacobian

    def _undistort(self, distorted: Pixels) -> Pixels:
        """Invert the distortion by Newton's method (at most 20 steps)."""
        if not (distorted.numel() and bool(self.distortion.any())):
            return distorted
        ideal = distorted
        for _ in range(20):
            value, jacobian = self._distort(ideal)
            residual = distorted - value
            if float(residual.abs().amax()) < 1e-14:
                break
            (a, b), (c, d) = (row.unbind(-1) for row in jacobian.unbind(-2))
            x, y = residual.unbind(-1)
            ideal = ideal + torch.stack([d * x - b * y, a * y - c * x], dim=-1) / (a * d - b * c)[..., None]
        if not float((distorted - self._distort(ideal)[0]).abs().amax()) < 1e-9:
            raise InputError(
                f"distortion of view '{self.name}': expected coefficients that can be inverted over the image, "
                f"got {self.distortion.tolist()}; check their order (k1, k2, p1, p2, k3)"
            )
        return ideal
