"""The result of a calibration: cameras, reprojection errors, and checks."""

from __future__ import annotations

import datetime
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.common.files import read_toml
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.geometry import PERSPECTIVE, Box, Lens, Plane, Projection
from nerif.geometry.interfaces import Interface
from nerif.imaging.calibration.bundle import INTRINSIC, CameraBundle, Pose, TargetObservation, crossing

__all__ = ["MOUNT", "Calibration", "FittedPlane", "ImageError", "read_errors", "rms_of"]

MOUNT = 0.05, 0.005
"""Default standard deviations of the position (mm) and rotation (degrees) of a camera since its calibration."""
MIN_COVERAGE = 0.4  # of the image: with less, distortion is not constrained at its edges
MAX_FOCAL_SIGMA = 0.01  # of the focal length
MAX_PLANE_RMS = 0.005  # of a background, over the distance of the camera


@dataclass(frozen=True)
class ImageError:
    """Rms reprojection error of one image over its points, px, and whether the adjustment used the image."""

    camera: str
    image: str
    rms: float
    points: int
    used: bool
    background: bool

    @property
    def name(self) -> str:
        """Name of the image, such as cam1/target/7."""
        return f"{self.camera}/{'background' if self.background else 'target'}/{self.image}"


def rms_of(errors: Sequence[ImageError]) -> float:
    """Return the rms reprojection error over the points of the images in use, px."""
    used = [e for e in errors if e.used]
    return float(np.sqrt(np.average([e.rms**2 for e in used], weights=[e.points for e in used])))


def read_errors(path: str | os.PathLike[str]) -> tuple[ImageError, ...]:
    """Read the errors of the images behind a calibration file, from its [[about.image]]; none if it has none."""
    table = read_toml(path, "file; expected a calibration")
    about = table.get("about")
    errors = []
    for entry in (about.get("image") or []) if isinstance(about, dict) else []:
        try:
            camera, source, image = str(entry["name"]).rsplit("/", 2)
            rms, points, used = float(entry["rms_px"]), int(entry["points"]), bool(entry["used"])
        except (KeyError, TypeError, ValueError):
            raise InputError(
                f"expected about.image with name, rms_px, points and used, got {entry!r}; calibrate again", field=path
            ) from None
        errors.append(ImageError(camera, image, rms, points, used, source == "background"))
    return tuple(errors)


@dataclass(frozen=True)
class FittedPlane:
    """A background plane normal . x = offset (mm), and the rms distance (mm) of the target points from it."""

    normal: tuple[float, float, float]
    offset: float
    rms: float

    @classmethod
    def through(cls, points: Float[np.ndarray, "n 3"], towards: Float[np.ndarray, 3]) -> FittedPlane:
        """Return the least-squares plane of points (mm), its normal towards a point (mm)."""
        middle = points.mean(axis=0)
        normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
        normal = normal if normal @ (towards - middle) > 0 else -normal
        rms = float(np.sqrt((((points - middle) @ normal) ** 2).mean()))
        return cls((float(normal[0]), float(normal[1]), float(normal[2])), float(normal @ middle), rms)

    @classmethod
    def across(cls, camera: Pose, distance: float) -> FittedPlane:
        """Return the plane across the optical axis of a camera (world to camera), `distance` mm behind the origin."""
        x, y, z = (-camera.rotation[2]).tolist()
        return cls((x, y, z), -distance, 0.0)


@dataclass(frozen=True)
class Calibration:
    """Calibrated cameras and their errors."""

    names: tuple[str, ...]  #: of the cameras
    sizes: tuple[tuple[int, int], ...]  #: of their images (height, width), px
    intrinsics: Float[np.ndarray, "camera 11"]  #: (camera, 11) as those of a CameraBundle
    poses: tuple[Pose, ...]  #: world to camera, mm
    backgrounds: tuple[FittedPlane | None, ...]
    errors: tuple[ImageError, ...]  #: one per image
    sigma_rotation: Float[np.ndarray, " camera"]
    """(camera,) standard deviation from noise alone, degrees."""
    sigma_translation: Float[np.ndarray, " camera"]
    """(camera,) standard deviation from noise alone, mm; of telecentric cameras across the optical axis."""
    sigma_focal: Float[np.ndarray, " camera"]  #: (camera,) relative standard deviation of the focal length or scale
    sigma_tilt: Float[np.ndarray, "camera 2"]
    """(camera, 2) standard deviations of the tilt, degrees; 0 where it was not determined."""
    residuals: tuple[np.ndarray, ...]  #: per camera (n, 4) u, v and the residuals in u, v, px
    projection: Projection = PERSPECTIVE
    lens: Lens | None = None
    interfaces: tuple[tuple[Interface, ...], ...] = ()  #: windows of each camera, world frame
    pose_sigma: Float[np.ndarray, "camera 6"] | None = None
    """(camera, 6) of a Camera, from noise alone and for the tilt as it is, or None."""
    mount: tuple[float, float] = MOUNT
    """Standard deviations of position (mm) and rotation (degrees) to add to those of noise."""

    @classmethod
    def of(
        cls, names: Sequence[str], bundle: CameraBundle, covariance: Float[np.ndarray, "camera 17 17"],
        observations: Sequence[TargetObservation], used: Sequence[bool], background_distance: float | None = None,
    ) -> Calibration:  # fmt: skip
        """Return the result of an adjusted bundle in the world frame.

        Parameters
        ----------
        covariance : of each camera's parameters (bundle.adjust)
        used : which observations the adjustment used
        background_distance : as in `calibrate`
        """
        errors = [
            ImageError(names[o.camera], o.image, bundle.rms(o), len(o.detection.points), u, o.on_background)
            for o, u in zip(observations, used, strict=True)
        ]
        residuals, backgrounds = [], []
        for i in range(len(names)):
            images = [o for o, u in zip(observations, used, strict=True) if u and o.camera == i]
            residuals.append(np.concatenate([np.hstack([o.detection.pixels, bundle.residual(o)]) for o in images]))
            points = [bundle.poses[o.pose].apply(o.detection.points) for o in images if o.on_background]
            backgrounds.append(_background(bundle.cameras[i], points, background_distance))
        poses = _at_fixed_tilt(covariance)
        sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0))
        return cls(
            names=tuple(names),
            sizes=bundle.sizes,
            intrinsics=bundle.intrinsics,
            poses=bundle.cameras,
            backgrounds=tuple(backgrounds),
            errors=tuple(errors),
            sigma_rotation=np.degrees(np.linalg.norm(sigma[:, INTRINSIC : INTRINSIC + 3], axis=1)),
            sigma_translation=np.linalg.norm(sigma[:, INTRINSIC + 3 :], axis=1),
            sigma_focal=sigma[:, 0] / bundle.intrinsics[:, 0],
            sigma_tilt=np.degrees(sigma[:, 9:INTRINSIC]),
            residuals=tuple(residuals),
            projection=bundle.projection,
            interfaces=bundle.interfaces,
            pose_sigma=np.stack([_pose_sigma(*one) for one in zip(bundle.cameras, poses, strict=True)]),
        )

    def rms(self, camera: str | None = None) -> float:
        """Return the rms reprojection error over the images in use, of one camera or all, px."""
        return rms_of([e for e in self.errors if camera in (None, e.camera)])

    @property
    def tilt(self) -> Float[np.ndarray, "camera 2"]:
        """Tilt of the sensors, degrees."""
        return np.degrees(self.intrinsics[:, 9:])

    @property
    def cameras(self) -> tuple[CalibratedCamera, ...]:
        """The cameras."""
        return tuple(self._camera(i) for i in range(len(self.names)))

    def _camera(self, i: int) -> CalibratedCamera:
        fx, fy, cx, cy = (float(v) for v in self.intrinsics[i, :4])
        plane, mount = self.backgrounds[i], np.repeat([np.radians(self.mount[1]), self.mount[0]], 3)
        return CalibratedCamera(
            name=self.names[i],
            intrinsics=torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64),
            rotation=torch.from_numpy(self.poses[i].rotation.copy()),
            translation=torch.from_numpy(self.poses[i].translation.copy()),
            distortion=torch.from_numpy(self.intrinsics[i, 4:9].copy()),
            image_size=self.sizes[i],
            background=None if plane is None else Plane(torch.tensor(plane.normal, dtype=torch.float64), plane.offset),
            projection=self.projection,
            lens=self.lens,
            pose_sigma=None if self.pose_sigma is None else torch.from_numpy(np.hypot(self.pose_sigma[i], mount)),
            tilt=torch.from_numpy(self.intrinsics[i, 9:].copy()),
            interfaces=self.interfaces[i] if self.interfaces else (),
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Images that were left out, and weak points of the cameras."""
        notes = [
            f"{e.camera}/{e.image}: left out, its reprojection error of {e.rms:.2f} px does not fit"
            for e in self.errors
            if not e.used
        ]
        for i, name in enumerate(self.names):
            u, v = self.residuals[i][:, :2].T
            coverage = np.ptp(u) * np.ptp(v) / (self.sizes[i][0] * self.sizes[i][1])
            sigma, scale = self.sigma_focal[i], self.projection.scale
            if coverage < MIN_COVERAGE:
                notes.append(f"{name}: the targets cover {coverage:.0%} of the image; distortion is uncertain beyond")
            if sigma > MAX_FOCAL_SIGMA:
                notes.append(f"{name}: the standard deviation of the {scale} is {sigma:.1%}; tilt the target more")
            if self.backgrounds[i] is None:
                why = "no target on the background" if self.projection.shows_depth else "depth does not show"
                notes.append(f"{name}: {why}, so its background plane is unknown; give --background-distance")
        if not self.projection.shows_depth:
            notes.append(
                "positions of telecentric cameras along their optical axes do not show in images and have no effect: "
                "z_cam = 0 was placed at the origin"
            )
        return tuple(notes)

    def check(self, max_error: float) -> None:
        """Refuse a camera with a larger rms reprojection error (px), impossible intrinsics or a background not flat."""
        for i, name in enumerate(self.names):
            rms, (height, width) = self.rms(name), self.sizes[i]
            if not rms <= max_error:
                worst = max((e for e in self.errors if e.camera == name and e.used), key=lambda e: e.rms)
                raise InputError(
                    f"expected a reprojection error of {max_error:g} px or less, got {rms:.2f} px; the largest is of "
                    f"image {worst.image} ({worst.rms:.2f} px). Check pitch and number of squares, and that "
                    "images under one name show one pose; or raise --max-error",
                    field=f"view '{name}'",
                )
            fx, fy, cx, cy = self.intrinsics[i, :4]
            if not (0.8 < fx / fy < 1.25 and -0.5 * width < cx < 1.5 * width and -0.5 * height < cy < 1.5 * height):
                raise InputError(
                    f"expected square pixels and a principal point near the image, got fx = {fx:.5g}, fy = {fy:.5g} "
                    f"{self.projection.unit}, cx = {cx:.5g}, cy = {cy:.5g} px; take more target images, tilted in "
                    "different ways and filling the image; if the sensor is tilted (Scheimpflug), add --scheimpflug",
                    field=f"view '{name}'",
                )
            plane = self.backgrounds[i]
            if plane is not None and plane.rms > MAX_PLANE_RMS * np.linalg.norm(self.poses[i].translation):
                raise InputError(
                    f"expected targets in one plane on its background, got {plane.rms:.2f} mm rms from it; did the "
                    "background move, or does an image show the target off it?",
                    field=f"view '{name}'",
                )

    def write(self, path: str | os.PathLike[str], box: Box | None = None) -> None:
        """Write a calibration file, with the errors under [about]."""
        tilt = dict(zip(self.names, self.sigma_tilt.tolist(), strict=True))
        about = {
            "date": datetime.date.today().isoformat(),
            "rms_px": self.rms(),
            "camera_rms_px": {name: self.rms(name) for name in self.names},
            "sigma_rotation_deg": dict(zip(self.names, self.sigma_rotation.tolist(), strict=True)),
            "sigma_translation_mm": dict(zip(self.names, self.sigma_translation.tolist(), strict=True)),
            **({"sigma_tilt_deg": tilt} if self.sigma_tilt.any() else {}),
            "notes": list(self.notes),
            "image": [{"name": e.name, "rms_px": e.rms, "points": e.points, "used": e.used} for e in self.errors],
        }
        write_cameras(path, self.cameras, about, box)


def _at_fixed_tilt(covariance: Float[np.ndarray, "camera 17 17"]) -> Float[np.ndarray, "camera 6 6"]:
    """Covariance of the poses for the tilts as they are: an error of a tilt and of its pose together move no ray."""
    tilt, pose = slice(9, INTRINSIC), slice(INTRINSIC, None)
    along = covariance[:, pose, tilt] @ np.linalg.pinv(covariance[:, tilt, tilt], hermitian=True)
    return np.asarray(covariance[:, pose, pose] - along @ covariance[:, tilt, pose])


def _pose_sigma(camera: Pose, covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, 6]:
    """Standard deviations of the rotation w and of the centre c along the camera's axes, c = w x t - dt."""
    jacobian = np.eye(6)
    jacobian[3:, :3], jacobian[3:, 3:] = -crossing(camera.translation), -np.eye(3)
    return np.sqrt(np.maximum(np.diag(jacobian @ covariance @ jacobian.T), 0))


def _background(camera: Pose, points: Sequence[np.ndarray], distance: float | None) -> FittedPlane | None:
    if points:
        return FittedPlane.through(np.concatenate(points), camera.inverse.translation)
    return None if distance is None else FittedPlane.across(camera, distance)
