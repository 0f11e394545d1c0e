"""The camera: a projection, the distortion of its lens and the tilt of its sensor, looking at a background plane.

    x_cam = R x_world + t,   (x, y) = projection(x_cam),   pixel = K (x_t, y_t, 1)

    perspective    (x, y) = (X/Z, Y/Z)    rays through the optical centre; K holds focal lengths, px
    telecentric    (x, y) = (X, Y)        rays parallel to the optical axis; K holds px per mm

with (x_t, y_t) of (x, y) by distortion and tilt (distortion.py). Conventions of OpenCV. Windows between the camera and
the flow bend the rays (interfaces.py); a ray then is its part behind the last of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Matrix3, Pixels, Points, Values, make_tensors
from nerif.common.conventions import LARGEST_LENGTH, InputError, check_name
from nerif.geometry.distortion import UPRIGHT, from_sensor, to_sensor
from nerif.geometry.interfaces import MAX_INTERFACES, Interface, Line, image_of
from nerif.geometry.lens import Lens, LensDiscs
from nerif.geometry.projection import MAX_TILT, PERSPECTIVE, Projection
from nerif.geometry.rays import BackgroundPoints, Rays

__all__ = ["Camera", "Plane"]

MAX_IMAGE_EDGE = 100_000  # px
LATTICE = 33  # pixels along either edge that represent an image


@dataclass(frozen=True)
class Plane:
    """The plane normal . x = offset (mm), its normal (3,) a unit vector in the world frame."""

    normal: Float[Tensor, 3]
    offset: float

    def __post_init__(self) -> None:
        make_tensors(self, torch.float64, "normal")


@dataclass(frozen=True)
class Camera:
    """A calibrated camera and the background it looks at."""

    intrinsics: Matrix3  #: K, px; fx and fy of a telecentric camera in px/mm
    rotation: Matrix3  #: world to camera
    translation: Float[Tensor, 3]  #: world to camera, mm
    image_size: tuple[int, int]  #: (height, width), px
    background: Plane | None  #: of any orientation, world frame, mm; None for a technique without one
    distortion: Float[Tensor, 5]  #: OpenCV's k1, k2, p1, p2, k3; of a telecentric camera for (x, y) in mm
    name: str = "camera"  #: of the view
    projection: Projection = PERSPECTIVE
    lens: Lens | None = None  #: the aperture through which a pixel sees; None for one thin ray per pixel
    pose_sigma: Float[Tensor, 6] | None = None
    """Standard deviations of the rotation about its own axes (rad) and of the shift of its centre along them
    (mm), or None."""
    tilt: Float[Tensor, 2] = UPRIGHT
    """OpenCV's tau_x, tau_y of the sensor behind a Scheimpflug lens, rad; of a perspective camera only, since
    for parallel rays fx, fy and skew describe it."""
    interfaces: tuple[Interface, ...] = ()
    """Planes at which rays are refracted between the camera and the flow, in order from the camera."""

    def __post_init__(self) -> None:
        def check(name: str, valid: bool, expected: str, got: object, remedy: str = "") -> None:
            if not valid:
                raise InputError(f"expected {expected}, got {got}{remedy}", field=f"{name} of view '{self.name}'")

        check_name(self.name, "view")
        arrays = ("intrinsics", "rotation", "translation", "distortion", "pose_sigma", "tilt")
        make_tensors(self, torch.float64, *arrays)
        plane, lens, kind, k, r = self.background, self.lens, self.projection, self.intrinsics, self.rotation
        for name, value, limit, unit in (
            ("intrinsics", k, 1e7, " px"),
            ("translation", self.translation, LARGEST_LENGTH, " mm"),
            ("distortion", self.distortion, 1e6, ""),
            ("background_offset", torch.tensor(0.0 if plane is None else plane.offset), LARGEST_LENGTH, " mm"),
        ):
            check(name, bool((value.abs() <= limit).all()), f"numbers up to {limit:g}{unit}", value.tolist())
        if plane is not None:
            unit_length = abs(float(plane.normal.norm()) - 1) < 1e-2
            check("background_normal", unit_length, "a unit vector", plane.normal.tolist())
        error, determinant = float((r @ r.T - torch.eye(3, dtype=r.dtype)).abs().max()), float(torch.linalg.det(r))
        check(
            "rotation", error < 1e-4 and determinant > 0, "a rotation matrix (R R^T = 1, det = +1)",
            f"|R R^T - 1| = {error:.2g}, det = {determinant:.3g}", "; check for a swapped or mirrored axis",
        )  # fmt: skip
        fx, fy = float(k[0, 0]), float(k[1, 1])
        positive = min(fx, fy) >= kind.least_scale
        check("intrinsics", positive, f"positive {kind.scale}s in {kind.unit}", f"fx = {fx:.6g}, fy = {fy:.6g}")
        upper = abs(float(k[2, 2]) - 1) <= 1e-9 and not float(k[2, :2].abs().max()) and not float(k[1, 0])
        remedy = "; a transposed K (MATLAB) has to be transposed back"
        check("intrinsics", upper, "K = [[fx, s, cx], [0, fy, cy], [0, 0, 1]]", k.tolist(), remedy)
        remedy = "; give degrees times pi / 180"
        valid = bool((torch.rad2deg(self.tilt).abs() < MAX_TILT).all())
        check("tilt", valid, f"angles below {MAX_TILT:g} degrees, in rad", self.tilt.tolist(), remedy)
        remedy = "; remove it, since fx, fy and skew describe a tilted sensor where rays are parallel"
        valid = kind.shows_depth or not bool(self.tilt.any())
        check("tilt", valid, f"none for a {kind.name} camera", self.tilt.tolist(), remedy)
        valid = len(self.interfaces) <= MAX_INTERFACES
        check("interfaces", valid, f"at most {MAX_INTERFACES} planes", len(self.interfaces))
        remedy = "; nerif does not refract the cone of rays of a lens: leave the aperture out"
        valid = not (self.interfaces and lens is not None and lens.diameter > 0)
        got = "" if lens is None else f"{lens.diameter:g} mm"
        check("aperture_diameter", valid, "thin rays (0) through interfaces", got, remedy)
        valid = min(self.image_size) > 0 and max(self.image_size) <= MAX_IMAGE_EDGE
        check("image_size", valid, f"(height, width) between 1 and {MAX_IMAGE_EDGE} px", self.image_size)
        if (sigma := self.pose_sigma) is not None:
            valid = bool(((sigma >= 0) & (sigma < torch.inf)).all())
            check("pose_sigma", valid, "standard deviations of 0 or more", sigma.tolist())
        if lens is not None and lens.diameter > 0:
            named = lens.focus is not None or plane is not None
            check("focus_distance", named, f"mm for a lens of {lens.diameter:g} mm without a background", "none")
            depth = self.depth(self.plane) if lens.focus is None else lens.focus
            valid = depth > 0 or (depth < 0 and not kind.shows_depth)
            remedy = "; check background_offset, or give the distance"
            check(
                "focus_distance", valid, "a plane in focus in front of the camera", f"a depth of {depth:g} mm", remedy
            )

    @property
    def centre(self) -> Float[Tensor, 3]:
        """Origin of the camera's frame, mm, world frame; of a perspective camera its optical centre."""
        return -self.rotation.T @ self.translation

    def local(self, points: Points) -> Points:
        """Return world points (mm) in the camera's frame, mm."""
        return points @ self.rotation.T + self.translation

    def sight(self, points: Points) -> Points:
        """Return the unit directions of the lines of sight through world points (mm), away from the camera."""
        if self.interfaces:
            return self.line(self.image_point(points)).direction
        return self.projection.sight(self.local(points)) @ self.rotation

    def distance(self, points: Points) -> Values:
        """Return the distances of world points (mm) from the camera, mm; infinity for a telecentric camera."""
        return self.projection.distance(self.local(points))

    def pixel_size(self, points: Points) -> Values:
        """Return the width of a pixel at world points (mm), across the axis, mm; without distortion and tilt."""
        if self.interfaces:
            slope = self.line(self.image_point(points)).image_slope(points)[..., 0, :]
            return 1 / (self.intrinsics[0, 0] * (slope @ self.rotation[0]))
        return 1 / (self.intrinsics[0, 0] * self.projection.magnification(self.local(points)))

    @property
    def plane(self) -> Plane:
        """The background, which has to be there."""
        if self.background is None:
            name = f"background of view '{self.name}'"
            raise InputError("expected a plane, normal . x = offset, got none", field=name)
        return self.background

    def pixel_grid(self) -> Float[Tensor, "row column 2"]:
        """Return all pixel centres, px."""
        height, width = self.image_size
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        return torch.stack([u, v], dim=-1).to(self.intrinsics.dtype)

    @property
    def unseen(self) -> float:
        """Fraction of the image without rays, from LATTICE x LATTICE of its pixels.

        There the distortion cannot be inverted, or interfaces reflect the rays totally.
        """
        height, width = self.image_size
        u, v = (torch.linspace(0, n - 1, min(n, LATTICE), dtype=torch.float64) for n in (width, height))
        rays = self.rays(torch.cartesian_prod(u, v).reshape(-1, 2), sensitivity=False)
        return 1 - float((rays.origin + rays.direction).isfinite().all(dim=-1).double().mean())

    def check_distortion(self) -> None:
        """Refuse a distortion that cannot be inverted, or interfaces that block the rays, over most of the image."""
        unseen = self.unseen
        if unseen > 0.5 and self.interfaces and replace(self, interfaces=()).unseen <= 0.5:
            axis = self.rotation[2]
            at = [float((p.offset - p.normal @ self.centre) / (p.normal @ axis)) for p in self.interfaces]
            raise InputError(
                "expected planes in front of the camera in the order in which its rays cross them, got planes that its "
                f"axis meets {', '.join(f'{distance:.4g}' for distance in at)} mm from it (negative: behind it), or "
                f"total reflection, over {unseen:.0%} of the image",
                field=f"interfaces of view '{self.name}'",
            )
        if unseen > 0.5:
            raise InputError(
                f"expected coefficients that can be inverted over the image, "
                f"got {self.distortion.tolist()}; check their order (k1, k2, p1, p2, k3)",
                field=f"distortion of view '{self.name}'",
            )

    def project(self, points: Points) -> Pixels:
        """Return the pixels (px) of world points (mm); NaN beyond the fold of the distortion, and at total reflection.

        Through interfaces the ray is found by Newton's method.
        """
        return self._project_jacobian(points)[0]

    def rays(self, pixels: Float[Tensor, "n 2"], sensitivity: bool = True, view: int = 0) -> Rays:
        """Return the rays of `pixels` (px), back-traced to the background; not yet clipped to a box.

        A pixel at which the distortion cannot be inverted, or interfaces reflect the ray totally, has a ray of NaN,
        which crosses no box. Through interfaces, origin and direction are those of the part behind the last of them,
        which begins there (`begin`); the origin is the apparent optical centre, where rays of neighbouring pixels are
        closest.

        Parameters
        ----------
        sensitivity : whether to compute S = -d project / d X at the background point X0 (S . direction = 0), else 0
        view : index of the view, stored with the rays
        """
        k = self.intrinsics
        y = (pixels[..., 1] - k[1, 2]) / k[1, 1]
        x = (pixels[..., 0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
        ideal = from_sensor(torch.stack([x, y], dim=-1), self.distortion, self.tilt)
        zero = torch.zeros_like(pixels[..., 0])
        if self.interfaces:
            line = self.line(ideal)
            origin, direction, begin = line.origin + line.begin[..., None] * line.direction, line.direction, -line.begin
        else:
            start, heading = self.projection.lines(ideal)
            direction = heading @ self.rotation
            direction = direction / direction.norm(dim=-1, keepdim=True)
            origin = (self.centre + start @ self.rotation).expand_as(direction)
            begin = torch.full_like(zero, self.projection.begin)
        number = torch.full(zero.shape, view, dtype=torch.int16)
        ends = self._background_points(origin, direction, sensitivity, ideal)
        lens = self._lens_discs(direction, ends)
        return Rays(origin, direction, zero, zero, pixels, number, begin, ends, lens)

    def depth(self, plane: Plane) -> float:
        """Return the depth at which the optical axis meets a plane, mm from z_cam = 0."""
        normal = plane.normal.to(self.rotation)
        return float(plane.offset - self.centre @ normal) / float(self.rotation[2] @ normal)

    def with_f_number(self, pixel_pitch: float, f_number: float) -> Camera:
        """Return the camera with a lens of this f-number that is focused on its background; 0 for thin rays.

        Parameters
        ----------
        pixel_pitch : of its sensor, mm
        f_number : focal length over aperture; of a telecentric lens on the side of the sensor
        """
        if not f_number >= 0:
            raise InputError(f"expected above 0, or 0 for thin rays, got {f_number}", field="f_number")
        if f_number == 0:
            return replace(self, lens=None)
        depth = self.depth(self.plane)
        on_axis = self.centre + depth * self.rotation[2]
        return replace(self, lens=Lens(depth * pixel_pitch / float(self.pixel_size(on_axis)) / f_number))

    @property
    def without_background(self) -> Camera:
        """The camera without its background, with the same plane in focus."""
        lens = self.lens
        if lens is not None and lens.diameter > 0 and lens.focus is None:
            lens = replace(lens, focus=self.depth(self.plane))
        return replace(self, background=None, lens=lens)

    @property
    def without_window(self) -> Camera:
        """The camera whose pixels measure at a point, not the mean over a window."""
        return self if self.lens is None else replace(self, lens=replace(self.lens, window=0.0))

    def _lens_discs(self, direction: Points, ends: BackgroundPoints | None) -> LensDiscs | None:
        if self.lens is None:
            return None
        axis = self.rotation[2].to(direction)
        if self.lens.focus is not None:
            focus = self.lens.focus / (direction @ axis)
        elif ends is not None:
            focus = ends.distance
        else:  # a thin ray among others that are not
            focus = torch.full_like(direction[..., 0], torch.inf)
        normal = axis if self.background is None else self.background.normal.to(direction)
        radius = torch.full_like(focus, self.lens.diameter / 2)
        window = torch.full_like(focus, self.lens.window / 2)
        parallel = torch.full_like(focus, not self.projection.shows_depth, dtype=torch.bool)
        return LensDiscs(axis.expand_as(direction), normal.expand_as(direction), radius, focus, window, parallel)

    def _background_points(
        self, origin: Points, direction: Points, sensitivity: bool, image: Pixels
    ) -> BackgroundPoints | None:
        if self.background is None:
            return None
        normal = self.background.normal.to(direction)
        distance = (self.background.offset - origin @ normal) / (direction @ normal)
        if not sensitivity:
            return BackgroundPoints(torch.zeros_like(distance)[:, None, None].expand(-1, 2, 3), distance)
        end = origin + distance[..., None] * direction
        return BackgroundPoints(-self._project_jacobian(end, image if self.interfaces else None)[1], distance)

    def view(self, row: int, column: int, height: int, width: int) -> Camera:
        """Return the camera of a crop of its image from (row, column), px."""
        shift = torch.zeros_like(self.intrinsics)
        shift[0, 2], shift[1, 2] = column, row
        return replace(self, intrinsics=self.intrinsics - shift, image_size=(height, width))

    def line(self, image: Pixels, motions: bool = False) -> Line:
        """Return the lines of sight at the image (x, y) behind the interfaces.

        Parameters
        ----------
        motions : with derivatives by rotations (rad) of the camera about the axes of the world, and shifts (mm)
        """
        start, heading = self.projection.lines(image)
        zero, unit = (self.projection.lines(x) for x in (image.new_zeros(1, 2), torch.eye(2, dtype=image.dtype)))
        slopes = [(there - here) @ self.rotation for there, here in zip(unit, zero, strict=True)]
        origin = self.centre + (start @ self.rotation).expand_as(heading)
        heading, by_image = heading @ self.rotation, [slopes[0].expand(2, 3), slopes[1]]
        if motions:
            axes, shape = torch.eye(3, dtype=image.dtype), (*heading.shape[:-1], -1, -1)
            turned = [torch.linalg.cross(axes.expand(shape), v[..., None, :]) for v in (origin, heading)]
            shifted = (axes, torch.zeros_like(axes))
            by_image = [
                torch.cat([slope.expand(shape), turn, shift.expand(shape)], dim=-2)
                for slope, turn, shift in zip(by_image, turned, shifted, strict=True)
            ]
        line = Line.of(origin, heading, *by_image)
        return line.behind(self.interfaces, self.projection.shows_depth)

    def image_point(self, points: Points) -> Pixels:
        """Return the image (x, y) of world points through the interfaces, before distortion; NaN if there is none."""
        return image_of(points, self.line, self.projection.image(self.local(points)))

    def _project_jacobian(
        self, points: Points, image: Pixels | None = None
    ) -> tuple[Pixels, Float[Tensor, "*batch 2 3"]]:
        """Pixels and d pixel / d X (px/mm); with `image` where (x, y) is available."""
        local = self.local(points)
        if image is None:
            image = self.image_point(points) if self.interfaces else self.projection.image(local)
        x, y, (xx, xy, yx, yy) = to_sensor(image, self.distortion, self.tilt)
        k = self.intrinsics
        pixels = torch.stack([k[0, 0] * x + k[0, 1] * y + k[0, 2], k[1, 1] * y + k[1, 2]], dim=-1)
        u, v = (k[0, 0] * xx + k[0, 1] * yx, k[0, 0] * xy + k[0, 1] * yy), (k[1, 1] * yx, k[1, 1] * yy)
        if self.interfaces:
            by_x, by_y = self.line(image).image_slope(points).unbind(-2)
            return pixels, torch.stack([w[0][..., None] * by_x + w[1][..., None] * by_y for w in (u, v)], dim=-2)
        # row by row: small matrix products are slow in a batch
        rows = [*self.projection.slope(*u, image, local), *self.projection.slope(*v, image, local)]
        return pixels, torch.stack(rows, dim=-1).unflatten(-1, (2, 3)) @ self.rotation
