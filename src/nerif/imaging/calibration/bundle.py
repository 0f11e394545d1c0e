"""Bundle adjustment: intrinsics, camera poses and target poses from all detected points.

    minimise  sum rho(|pixel - project_i(R_i (R_j X + t_j) + t_i)|^2),      rho Huber's loss

over cameras i and target poses j; one pose is fixed and defines the world. Windows between a camera and the targets
refract (geometry/interfaces.py); their planes are fixed in the world. Weak priors hold the parameters that a
narrow lens does not separate from a rotation: the principal point near the middle of the image, distortion near 0.
Without distortion, a tilt of the sensor is exactly a rotation of the camera, a shift of the principal point and a
shorter focal length; then the prior of that point determines it.

Each step of the Levenberg-Marquardt method solves the normal equations exactly, so nearly degenerate parameters
converge too. Parameters that no image constrains, such as the depth of a telecentric camera, stay at their initial
value, with standard deviation 0.

Source: Triggs et al., Bundle adjustment - a modern synthesis, 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from nerif.geometry import PERSPECTIVE, Camera, Projection
from nerif.geometry.distortion import POWERS, distort, tilt, tilt_slopes
from nerif.geometry.interfaces import Interface
from nerif.imaging.calibration.targets import Detection

__all__ = ["INTRINSIC", "CameraBundle", "Pose", "TargetObservation", "adjust", "crossing"]

HUBER = 5  # residual over noise beyond which the loss is linear
PRINCIPAL_SIGMA = 0.03  # of the principal point from the middle of the image, over the image width
DISTORTION_SIGMA = (0.5, 5.0, 0.005, 0.005, 5.0)  # of COEFFICIENTS; of a telecentric camera with (x, y) over
HALF_WIDTHS = 5  # times half the image width in mm: as for a perspective image that is 23 degrees wide
MIN_EIGENVALUE = 1e-13  # of the curvature, over its largest: directions below it change no image
MAX_ITERATIONS = 100
INTRINSIC, POSE = 11, 6  # parameters: fx, fy, cx, cy, five of distortion, two of tilt; rotation vector, translation


@dataclass(frozen=True)
class Pose:
    """A rigid motion x -> R x + t."""

    rotation: Float[np.ndarray, "3 3"]  #: (3, 3)
    translation: Float[np.ndarray, 3]  #: (3,) mm

    def __matmul__(self, first: Pose) -> Pose:
        """Return the motion `first` followed by this one."""
        return Pose(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)

    @property
    def inverse(self) -> Pose:
        """Inverse motion."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return R x + t of points x, mm."""
        return points @ self.rotation.T + self.translation

    @property
    def vector(self) -> Float[np.ndarray, 6]:
        """Rotation vector and translation."""
        import cv2

        return np.concatenate([cv2.Rodrigues(self.rotation)[0].ravel(), self.translation])

    @property
    def rotation_jacobian(self) -> Float[np.ndarray, "3 3"]:
        """Jacobian T of the rotation by the rotation vector v, R(v + dv) = exp([T dv]x) R(v).

        T = sin a / a + (1 - sin a / a) v v^T / a^2 + (1 - cos a) / a^2 [v]x,     a = |v|
        """
        v = self.vector[:3]
        a = max(float(np.linalg.norm(v)), 1e-9)
        share = np.sin(a) / a
        return share * np.eye(3) + (1 - share) * np.outer(v, v) / a**2 + (1 - np.cos(a)) / a**2 * crossing(v)

    @classmethod
    def of_vector(cls, vector: np.ndarray) -> Pose:
        """Return the pose with this rotation vector and translation."""
        import cv2

        return cls(cv2.Rodrigues(np.asarray(vector[:3], dtype=np.float64))[0], np.array(vector[3:], dtype=np.float64))


@dataclass(frozen=True)
class TargetObservation:
    """The target of one image."""

    camera: int  #: its index in the bundle
    pose: int  #: its index in the bundle
    detection: Detection
    image: str = ""  #: name of the image
    on_background: bool = False  #: whether the target lay on the camera's background


@dataclass(frozen=True)
class CameraBundle:
    """All cameras and target poses."""

    intrinsics: Float[np.ndarray, "camera 11"]
    """(camera, 11) fx, fy, cx, cy (px; fx, fy of telecentric cameras px/mm), k1, k2, p1, p2, k3, and of the sensor
    tau_x, tau_y (rad)."""
    cameras: tuple[Pose, ...]  #: world to camera
    poses: tuple[Pose, ...]  #: target to world
    fixed: int  #: index of the pose that defines the world
    free: tuple[bool, ...]  #: (11,) which intrinsics are adjusted
    sizes: tuple[tuple[int, int], ...]  #: (height, width) of each camera's images, px
    projection: Projection = PERSPECTIVE
    interfaces: tuple[tuple[Interface, ...], ...] = ()  #: of each camera, in the bundle's world; () without any

    def project(self, o: TargetObservation) -> Float[np.ndarray, "n 2"]:
        """Return the points of an observation by the model, px."""
        k, points = self.intrinsics[o.camera], self.poses[o.pose].apply(o.detection.points)
        if planes := self._planes(o.camera):
            image = self._behind(o.camera, planes).image_point(torch.from_numpy(points)).numpy()
        else:
            image = self.projection.image(self.cameras[o.camera].apply(points))
        x, y, _ = tilt(*distort(image[:, 0], image[:, 1], k[4:9])[:2], k[9:])
        return np.stack([k[0] * x + k[2], k[1] * y + k[3]], axis=1)

    def derivatives(self, o: TargetObservation) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the points (n, 2), px, and derivatives (2 n, p) of u, v by intrinsics, camera pose and target pose."""
        k, pose = self.intrinsics[o.camera], self.poses[o.pose]
        turned = o.detection.points @ pose.rotation.T
        image, slope, by_camera = self._image_slopes(o.camera, turned + pose.translation)
        x, y = image.T
        xd, yd, (xx, cross, yy) = distort(x, y, k[4:9])
        xt, yt, slopes = tilt(xd, yd, k[9:])
        by_distorted = k[:2, None] * _rows(*slopes)
        by_image = by_distorted @ _rows(xx, cross, cross, yy)
        by_place = by_image @ slope
        by_pose = np.concatenate([by_place @ _turning(turned, pose), by_place], axis=-1).reshape(-1, POSE)
        r2, zero, one = x * x + y * y, np.zeros_like(x), np.ones_like(x)
        coefficients = _rows(
            x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3,
            y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3,
        )  # fmt: skip
        by_intrinsics = np.concatenate([
            _rows(xt, zero, one, zero, zero, yt, zero, one),
            by_distorted @ coefficients,
            k[:2, None] * _rows(*tilt_slopes(xd, yd, k[9:])),
        ], axis=-1).reshape(-1, INTRINSIC)  # fmt: skip
        pixels = np.stack([k[0] * xt + k[2], k[1] * yt + k[3]], axis=1)
        return pixels, by_intrinsics, (by_image @ by_camera).reshape(-1, POSE), by_pose

    def _image_slopes(self, i: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (x, y) of points (n, 3) of the world, and its slopes (n, 2, 3) by the point, (n, 2, 6) by the pose."""
        camera = self.cameras[i]
        if planes := self._planes(i):
            behind, place = self._behind(i, planes), torch.from_numpy(points)
            image = behind.image_point(place)
            line = behind.line(image, motions=True)
            by_turn, by_shift = line.motion_slope(place).numpy().reshape(-1, 2, 2, 3).transpose(2, 0, 1, 3)
            back = -camera.rotation.T  # of a camera x -> R x + t: its motion in the world is -R^T (T dv), -R^T dt
            by_camera = np.concatenate([by_turn @ back @ camera.rotation_jacobian, by_shift @ back], axis=-1)
            return image.numpy(), line.image_slope(place).numpy(), by_camera
        turned = points @ camera.rotation.T
        local = turned + camera.translation
        image, unit = self.projection.image(local), np.eye(2)[..., None].repeat(len(local), axis=-1)
        rows = [np.stack(self.projection.slope(u, v, image, local), axis=-1) for u, v in unit]
        by_local = np.stack(rows, axis=1)
        by_camera = np.concatenate([by_local @ _turning(turned, camera), by_local], axis=-1)
        return image, by_local @ camera.rotation, by_camera

    def _planes(self, i: int) -> tuple[Interface, ...]:
        return self.interfaces[i] if self.interfaces else ()

    def _behind(self, i: int, planes: tuple[Interface, ...]) -> Camera:
        """The camera with its windows, for (x, y)."""
        rotation, shift = (torch.from_numpy(a.copy()) for a in (self.cameras[i].rotation, self.cameras[i].translation))
        unit = torch.eye(3, dtype=torch.float64)
        return Camera(
            unit, rotation, shift, self.sizes[i], None, torch.zeros(5, dtype=torch.float64), projection=self.projection,
            interfaces=planes,
        )  # fmt: skip

    def crosses_windows(self, o: TargetObservation) -> bool:
        """Return whether the rays to all points of an observation cross the windows of its camera, in their order."""
        if not (planes := self._planes(o.camera)):
            return True
        behind, points = self._behind(o.camera, planes), torch.from_numpy(self.poses[o.pose].apply(o.detection.points))
        line = behind.line(behind.image_point(points))
        return bool((((points - line.origin) * line.direction).sum(-1) >= 0).all())  # NaN: no ray

    def residual(self, o: TargetObservation) -> Float[np.ndarray, "n 2"]:
        """Return detected minus projected points, px."""
        return o.detection.pixels - self.project(o)

    def rms(self, o: TargetObservation) -> float:
        """Return the rms reprojection error of an observation, px."""
        return float(np.sqrt((self.residual(o) ** 2).sum(axis=1).mean()))


def adjust(
    bundle: CameraBundle, observations: Sequence[TargetObservation], noise: float
) -> tuple[CameraBundle, Float[np.ndarray, "camera 17 17"]]:
    """Return the adjusted bundle, and the covariance of each camera's parameters.

    The covariances (11 intrinsics, rotation about the camera's own axes in rad, translation in mm) follow from the
    curvature of the sum and the residuals; they include detection noise, not a target that is not flat. `noise`, the
    standard deviation of a point's coordinates in px, scales the priors and Huber's loss.
    """
    from scipy.linalg import cho_factor, cho_solve

    layout = _ParameterOrder(bundle, observations, noise)
    x, damping, stalls = layout.pack(bundle), 1e-3, 0
    cost, curvature, slope = layout.normal_equations(x)
    for _ in range(MAX_ITERATIONS):
        scale = _scale(curvature)
        matrix = curvature / scale[:, None] / scale + damping * np.eye(len(x))
        trial = x - cho_solve(cho_factor(matrix), slope / scale) / scale
        new = layout.cost(trial)
        if new < cost:
            stalls = stalls + 1 if cost - new < 1e-9 * cost else 0
            x, damping = trial, max(damping / 10, 1e-12)
            cost, curvature, slope = layout.normal_equations(x)
        else:
            damping *= 10
        if stalls == 3 or damping > 1e8:
            break
    count = sum(2 * len(o.detection.points) for o in observations)
    residual = sum(float((layout.unpack(x).residual(o) ** 2).sum()) for o in observations)
    scale = _scale(curvature)
    inverse = np.linalg.pinv(curvature / scale[:, None] / scale, rcond=MIN_EIGENVALUE, hermitian=True)
    covariance = inverse / scale[:, None] / scale
    variance = residual / max(count - len(x), 1)
    result, blocks = layout.unpack(x), layout.per_camera(covariance * variance)
    for camera, block in zip(result.cameras, blocks, strict=True):
        turn = np.eye(INTRINSIC + POSE)
        turn[INTRINSIC : INTRINSIC + 3, INTRINSIC : INTRINSIC + 3] = camera.rotation_jacobian
        block[:] = turn @ block @ turn.T
    return result, blocks


def crossing(vector: Float[np.ndarray, 3]) -> Float[np.ndarray, "3 3"]:
    """Return [v]x, by which v x a = [v]x a."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _turning(turned: Float[np.ndarray, "n 3"], pose: Pose) -> Float[np.ndarray, "n 3 3"]:
    """Return the derivatives of R x (n, 3) by the rotation vector of a pose: d(R x) = (T dv) x (R x)."""
    x, y, z = turned.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=-1).reshape(-1, 3, 3)
    return cross @ pose.rotation_jacobian


def _rows(*columns: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2 m"]:
    """Matrices of two rows, from their entries row by row."""
    return np.stack(columns, axis=-1).reshape(len(columns[0]), 2, -1)


def _scale(curvature: np.ndarray) -> np.ndarray:
    """Scales that make parameters of different units comparable."""
    diagonal = np.diag(curvature)
    return np.sqrt(np.where(diagonal > 0, diagonal, 1.0))


class _ParameterOrder:
    """The order of all parameters in one vector: of each camera its free intrinsics and pose, then the target poses."""

    def __init__(self, bundle: CameraBundle, observations: Sequence[TargetObservation], noise: float) -> None:
        self.bundle, self.observations, self.noise = bundle, observations, noise
        self.free = np.flatnonzero(bundle.free)
        self.block = len(self.free) + POSE
        others = [j for j in range(len(bundle.poses)) if j != bundle.fixed]
        self.pose_at = {j: len(bundle.cameras) * self.block + POSE * i for i, j in enumerate(others)}
        self.size = len(bundle.cameras) * self.block + POSE * len(others)

    def pack(self, bundle: CameraBundle) -> np.ndarray:
        x = np.empty(self.size)
        for i, camera in enumerate(bundle.cameras):
            x[i * self.block : (i + 1) * self.block] = np.concatenate([bundle.intrinsics[i, self.free], camera.vector])
        for j, at in self.pose_at.items():
            x[at : at + POSE] = bundle.poses[j].vector
        return x

    def unpack(self, x: np.ndarray) -> CameraBundle:
        intrinsics, cameras = self.bundle.intrinsics.copy(), []
        for i in range(len(self.bundle.cameras)):
            block = x[i * self.block : (i + 1) * self.block]
            intrinsics[i, self.free] = block[: len(self.free)]
            cameras.append(Pose.of_vector(block[len(self.free) :]))
        poses = list(self.bundle.poses)
        for j, at in self.pose_at.items():
            poses[j] = Pose.of_vector(x[at : at + POSE])
        return replace(self.bundle, intrinsics=intrinsics, cameras=tuple(cameras), poses=tuple(poses))

    def cost(self, x: np.ndarray) -> float:
        """Return the sum to minimise, px^2."""
        bundle = self.unpack(x)
        loss = sum(self._loss(np.linalg.norm(bundle.residual(o), axis=1)) for o in self.observations)
        return loss + float((self._prior(bundle) ** 2).sum())

    def _loss(self, length: np.ndarray) -> float:
        """Huber's loss of residuals, px^2."""
        knee = HUBER * self.noise
        return float(np.where(length < knee, length**2, 2 * knee * length - knee**2).sum())

    def normal_equations(self, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the cost, J^T W J and J^T W r: Huber's weights W, derivatives J of r = projected - detected."""
        bundle = self.unpack(x)
        curvature, slope, cost = np.zeros((self.size, self.size)), np.zeros(self.size), 0.0
        for o in self.observations:
            pixels, by_intrinsics, by_camera, by_pose = bundle.derivatives(o)
            residual = pixels - o.detection.pixels
            length = np.linalg.norm(residual, axis=1)
            cost += self._loss(length)
            weight = np.repeat(np.sqrt(np.minimum(1, HUBER * self.noise / np.maximum(length, 1e-12))), 2)
            blocks = [by_intrinsics[:, self.free], by_camera]
            at = np.arange(o.camera * self.block, (o.camera + 1) * self.block)
            if o.pose in self.pose_at:
                blocks.append(by_pose)
                at = np.concatenate([at, self.pose_at[o.pose] + np.arange(POSE)])
            jacobian = np.concatenate(blocks, axis=1) * weight[:, None]
            curvature[np.ix_(at, at)] += jacobian.T @ jacobian
            slope[at] += jacobian.T @ (weight * residual.ravel())
        prior, slopes = self._prior(bundle), self._prior_slopes()
        for i in range(len(bundle.cameras)):
            whole = np.zeros((7, INTRINSIC))
            whole[np.arange(7), np.arange(7) + 2] = slopes[i]
            jacobian, at = whole[:, self.free], i * self.block + np.arange(len(self.free))
            curvature[np.ix_(at, at)] += jacobian.T @ jacobian
            slope[at] += jacobian.T @ prior[i]
        return cost + float((prior**2).sum()), curvature, slope

    def _prior(self, bundle: CameraBundle) -> np.ndarray:
        """Principal point from the middle of the image, and distortion, over their sigma, times the noise."""
        middle = np.array([((w - 1) / 2, (h - 1) / 2) for h, w in bundle.sizes])
        off = np.concatenate([bundle.intrinsics[:, 2:4] - middle, bundle.intrinsics[:, 4:9]], axis=1)
        return off * self._prior_slopes()

    def _prior_slopes(self) -> np.ndarray:
        widths = np.array([w for _, w in self.bundle.sizes], dtype=np.float64)[:, None]
        unit = np.ones_like(widths)
        if not self.bundle.projection.shows_depth:
            unit = HALF_WIDTHS * widths / 2 / self.bundle.intrinsics[:, :1]
        distortion = DISTORTION_SIGMA / unit ** np.array(POWERS)
        return np.asarray(self.noise / np.concatenate([PRINCIPAL_SIGMA * widths.repeat(2, axis=1), distortion], axis=1))

    def per_camera(self, matrix: np.ndarray) -> np.ndarray:
        """Return the blocks of the cameras in a matrix, with 0 for intrinsics that are not adjusted."""
        at = np.concatenate([self.free, INTRINSIC + np.arange(POSE)])
        result = np.zeros((len(self.bundle.cameras), INTRINSIC + POSE, INTRINSIC + POSE))
        for i in range(len(result)):
            block = slice(i * self.block, (i + 1) * self.block)
            result[i][np.ix_(at, at)] = matrix[block, block]
        return result
