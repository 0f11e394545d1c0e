"""What a calibration found, how well it fits, and what looks wrong about it."""

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
from nerif.geometry import PERSPECTIVE, Box, Lens, Plane, Projection
from nerif.imaging.calibration.bundle import Bundle, Observation, Pose, crossing
from nerif.imaging.calibration.cameras_file import CalibratedCamera, write_cameras

__all__ = ["MOUNT", "Calibration", "FittedPlane", "ImageError", "read_errors", "rms_of"]

MOUNT = 0.05, 0.005
"""How far a camera may have been moved (mm) and turned (degrees) since it was calibrated, where nobody says."""
COVERED = 0.4  # of the image: with less, distortion is not known at its edges
FOCAL_KNOWN = 0.01  # of the focal length: a larger standard deviation is told
PLANE_FLAT = 0.005  # of the distance: a background that is less flat is none


@dataclass(frozen=True)
class ImageError:
    """Reprojection error of one image: rms over `points` points, px."""

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
    """Return the rms reprojection error over the points of the images that were used, px."""
    used = [e for e in errors if e.used]
    return float(np.sqrt(np.average([e.rms**2 for e in used], weights=[e.points for e in used])))


def read_errors(path: str | os.PathLike[str]) -> tuple[ImageError, ...]:
    """Read the errors of the images that a calibration file was made from; none where it does not tell them.

    Raises
    ------
    InputError
        If it is missing, no TOML, or its [[about.image]] are not as nerif calibrate writes them.
    """
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
        """Return the plane nearest to points (mm) in the sense of least squares, its normal towards a point (mm)."""
        middle = points.mean(axis=0)
        normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
        normal = normal if normal @ (towards - middle) > 0 else -normal
        rms = float(np.sqrt((((points - middle) @ normal) ** 2).mean()))
        return cls((float(normal[0]), float(normal[1]), float(normal[2])), float(normal @ middle), rms)

    @classmethod
    def across(cls, camera: Pose, distance: float) -> FittedPlane:
        """Return the plane across the optical axis of a camera (world to camera) so far (mm) behind the origin."""
        x, y, z = (-camera.rotation[2]).tolist()
        return cls((x, y, z), -distance, 0.0)


@dataclass(frozen=True)
class Calibration:
    """Calibrated cameras and how well they fit.

    Parameters
    ----------
    names, sizes : of the cameras and their images (height, width)
    intrinsics : (camera, 9) as those of a Bundle
    poses : world to camera, mm
    backgrounds : plane of each camera, or None
    errors : one an image
    sigma_rotation, sigma_translation : (camera,) standard deviations from noise alone, degrees and mm; the latter of
        telecentric cameras across the optical axis
    sigma_focal : (camera,) share of the focal length or scale
    residuals : (camera) arrays (n, 4) of u, v and the residual in u, v, px: to be drawn
    projection : of all cameras
    lens : of all cameras, or None for thin rays
    pose_sigma : (camera, 6) of a Camera, from noise alone, or None
    mount : how far cameras may have been moved or turned since, mm and degrees, beside the noise
    """

    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    intrinsics: Float[np.ndarray, "camera 9"]
    poses: tuple[Pose, ...]
    backgrounds: tuple[FittedPlane | None, ...]
    errors: tuple[ImageError, ...]
    sigma_rotation: Float[np.ndarray, " camera"]
    sigma_translation: Float[np.ndarray, " camera"]
    sigma_focal: Float[np.ndarray, " camera"]
    residuals: tuple[np.ndarray, ...]
    projection: Projection = PERSPECTIVE
    lens: Lens | None = None
    pose_sigma: Float[np.ndarray, "camera 6"] | None = None
    mount: tuple[float, float] = MOUNT

    @classmethod
    def of(
        cls, names: Sequence[str], bundle: Bundle, covariance: Float[np.ndarray, "camera 15 15"],
        observations: Sequence[Observation], used: Sequence[bool], background_distance: float | None = None,
    ) -> Calibration:  # fmt: skip
        """Sum up an adjusted bundle.

        Parameters
        ----------
        names : of the cameras
        bundle : adjusted, in the world frame
        covariance : of every camera's parameters (bundle.adjust)
        observations : all points found
        used : which observations the adjustment took
        background_distance : where no target was laid, of a plane across the optical axis, behind the origin, mm
        """
        errors = [
            ImageError(names[o.camera], o.image, bundle.rms(o), len(o.detection.points), u, o.on_background)
            for o, u in zip(observations, used, strict=True)
        ]
        residuals, backgrounds = [], []
        for i in range(len(names)):
            own = [o for o, u in zip(observations, used, strict=True) if u and o.camera == i]
            residuals.append(np.concatenate([np.hstack([o.detection.pixels, bundle.residual(o)]) for o in own]))
            laid = [bundle.poses[o.pose].moved(o.detection.points) for o in own if o.on_background]
            backgrounds.append(_background(bundle.cameras[i], laid, background_distance))
        sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0))
        return cls(
            names=tuple(names),
            sizes=bundle.sizes,
            intrinsics=bundle.intrinsics,
            poses=bundle.cameras,
            backgrounds=tuple(backgrounds),
            errors=tuple(errors),
            sigma_rotation=np.degrees(np.linalg.norm(sigma[:, 9:12], axis=1)),
            sigma_translation=np.linalg.norm(sigma[:, 12:], axis=1),
            sigma_focal=sigma[:, 0] / bundle.intrinsics[:, 0],
            residuals=tuple(residuals),
            projection=bundle.projection,
            pose_sigma=np.stack([_pose_sigma(*one) for one in zip(bundle.cameras, covariance[:, 9:, 9:], strict=True)]),
        )

    def rms(self, camera: str | None = None) -> float:
        """Rms reprojection error over the images used, of one camera or all, px."""
        return rms_of([e for e in self.errors if camera in (None, e.camera)])

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
            distortion=torch.from_numpy(self.intrinsics[i, 4:].copy()),
            image_size=self.sizes[i],
            background=None if plane is None else Plane(torch.tensor(plane.normal, dtype=torch.float64), plane.offset),
            projection=self.projection,
            lens=self.lens,
            pose_sigma=None if self.pose_sigma is None else torch.from_numpy(np.hypot(self.pose_sigma[i], mount)),
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know: images left out, and what may be wrong with a camera, short of refusing it."""
        notes = [
            f"{e.camera}/{e.image}: left out, its reprojection error of {e.rms:.2f} px does not fit"
            for e in self.errors
            if not e.used
        ]
        for i, name in enumerate(self.names):
            u, v = self.residuals[i][:, :2].T
            covered = np.ptp(u) * np.ptp(v) / (self.sizes[i][0] * self.sizes[i][1])
            if covered < COVERED:
                notes.append(f"{name}: the targets cover {covered:.0%} of the image; distortion is a guess beyond them")
            if self.sigma_focal[i] > FOCAL_KNOWN:
                notes.append(
                    f"{name}: the {self.projection.scale} is known to {self.sigma_focal[i]:.1%} only; tilt the target "
                    "more"
                )
            if self.backgrounds[i] is None:
                why = "no target on the background was found" if self.projection.shows_depth else "depth does not show"
                notes.append(f"{name}: {why}, so its plane is not known; --background-distance gives it")
        if not self.projection.shows_depth:
            notes.append(
                "where telecentric cameras are along their optical axes does not show in images, and does not "
                "matter: z_cam = 0 was laid through the origin"
            )
        return tuple(notes)

    def check(self, max_error: float) -> None:
        """Refuse what cannot be right; `max_error` is the largest rms reprojection error of a camera to accept, px.

        Raises
        ------
        InputError
            If a camera fits badly, has intrinsics that no camera has, or a background that is not flat.
        """
        for i, name in enumerate(self.names):
            rms, (height, width) = self.rms(name), self.sizes[i]
            if not rms <= max_error:
                worst = max((e for e in self.errors if e.camera == name and e.used), key=lambda e: e.rms)
                raise InputError(
                    f"reprojection error {rms:.2f} px, expected {max_error:g} px or less; the worst "
                    f"image is {worst.image} ({worst.rms:.2f} px). Check pitch and number of squares, and that "
                    "images under one name show one pose; or raise --max-error",
                    field=f"view '{name}'",
                )
            fx, fy, cx, cy = self.intrinsics[i, :4]
            if not (0.8 < fx / fy < 1.25 and -0.5 * width < cx < 1.5 * width and -0.5 * height < cy < 1.5 * height):
                raise InputError(
                    f"got fx = {fx:.5g}, fy = {fy:.5g} {self.projection.unit}, cx = {cx:.5g}, "
                    f"cy = {cy:.5g} px, which no camera has; take more target images, tilted in different ways and "
                    "filling the image",
                    field=f"view '{name}'",
                )
            plane = self.backgrounds[i]
            if plane is not None and plane.rms > PLANE_FLAT * np.linalg.norm(self.poses[i].translation):
                raise InputError(
                    f"the targets on its background lie {plane.rms:.2f} mm rms off one plane; did the "
                    "background move, or does an image show the target off it?",
                    field=f"view '{name}'",
                )

    def write(self, path: str | os.PathLike[str], box: Box | None = None) -> None:
        """Write the cameras as a calibration file, with the box and, under [about], how well they fit."""
        about = {
            "date": datetime.date.today().isoformat(),
            "rms_px": self.rms(),
            "camera_rms_px": {name: self.rms(name) for name in self.names},
            "sigma_rotation_deg": dict(zip(self.names, self.sigma_rotation.tolist(), strict=True)),
            "sigma_translation_mm": dict(zip(self.names, self.sigma_translation.tolist(), strict=True)),
            "notes": list(self.notes),
            "image": [{"name": e.name, "rms_px": e.rms, "points": e.points, "used": e.used} for e in self.errors],
        }
        write_cameras(path, self.cameras, about, box)


def _pose_sigma(camera: Pose, covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, 6]:
    """Standard deviations of the turn w and of the shift c of the centre along the camera's axes, c = w x t - dt."""
    to = np.eye(6)
    to[3:, :3], to[3:, 3:] = -crossing(camera.translation), -np.eye(3)
    return np.sqrt(np.maximum(np.diag(to @ covariance @ to.T), 0))


def _background(camera: Pose, laid: Sequence[np.ndarray], distance: float | None) -> FittedPlane | None:
    """The plane through targets laid on it, or as far behind the origin as is said, or None."""
    if laid:
        return FittedPlane.through(np.concatenate(laid), camera.inverse.translation)
    return None if distance is None else FittedPlane.across(camera, distance)
