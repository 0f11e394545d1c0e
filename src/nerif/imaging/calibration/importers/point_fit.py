"""A camera fitted to points of known position in the world and in its image.

    minimise  sum rho(|pixel - project(R X + t)|^2),      rho Huber's loss, by bundle adjustment of one pose

from several focal lengths, each with the pose that fits best without distortion. Few points determine no distortion,
some k1 only, and many k1 k2 p1 p2. Skew and k3 are 0.

Source of the initial pose: Terzakis & Lourakis, A consistently fast and globally optimal solution to the
perspective-n-point problem, ECCV 2020.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera
from nerif.imaging.calibration.bundle import INTRINSIC, CameraBundle, Pose, TargetObservation, adjust
from nerif.imaging.calibration.importers.dlt import MIRRORED
from nerif.imaging.calibration.targets import Detection

__all__ = ["PointFit", "fit_camera"]

MIN_POINTS, MIN_FOR_K1, MIN_FOR_ALL = 6, 12, 30
MIN_DEPTH = 1e-3  # of the points across their best plane, over their extent along it
FOCAL_LENGTHS = (1.0, 4.0, 16.0)  # over the image width, to start from
INITIAL_NOISE = (100.0, 0.1)  # px, of a coordinate, before it is estimated: almost least squares first, then robust
MIN_NOISE = 1e-4  # px, lower bound of the estimate
RMS_OF_MEDIAN = 1.2  # of distances whose two components are normally distributed
MAX_TYPICAL = 5.0  # px
MIRROR_GAIN = 0.8  # mean error with rows reversed over that without, below which the axes are mirror images


class PointFit(NamedTuple):
    """A camera, and how far the points are from their projections."""

    camera: CalibratedCamera
    errors: Float[np.ndarray, " n"]  #: (n,) px

    @property
    def rms(self) -> float:
        """Root mean square of the errors, px."""
        return float(np.sqrt((self.errors**2).mean()))

    @property
    def typical(self) -> float:
        """The rms without outliers, px: 1.2 times the median."""
        return RMS_OF_MEDIAN * float(np.median(self.errors))

    @property
    def words(self) -> str:
        """The errors in one line."""
        return f"{len(self.errors)} points, rms {self.rms:.2g} px, largest difference {self.errors.max():.2g} px"


def fit_camera(
    points: Float[np.ndarray, "n 3"], pixels: Float[np.ndarray, "n 2"], where: str, name: str,
    size: tuple[int, int] | None = None,
) -> PointFit:  # fmt: skip
    """Return the camera that fits best.

    Parameters
    ----------
    points, pixels : of the world, in any unit, and of the image, px
    size : height and width of the image, px; None: unknown
    """
    if len(points) < MIN_POINTS:
        raise InputError(f"expected at least {MIN_POINTS} points, got {len(points)}", field=where)
    centre = points.mean(axis=0)
    extent = np.linalg.svd(points - centre, compute_uv=False)
    if not extent[2] > MIN_DEPTH * extent[0]:
        raise InputError(
            f"expected points in space, got {len(points)} on one plane, which do not determine the camera; add points "
            "of a second plane, or calibrate from images of the target in several poses",
            field=where,
        )
    height, width = size or (int(pixels[:, 1].max()) + 1, int(pixels[:, 0].max()) + 1)
    bundle, errors = _best(points - centre, pixels, (height, width))
    _, reversed_errors = _best(points - centre, pixels * (1, -1) + (0, height - 1), (height, width))
    if reversed_errors.mean() < MIRROR_GAIN * errors.mean():
        raise InputError(MIRRORED, field=where)
    (k,), (pose,) = bundle.intrinsics, bundle.cameras
    camera = CalibratedCamera.from_values(
        where, name, [[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]], pose.rotation,
        pose.translation - pose.rotation @ centre, k[4:9], size,
    )  # fmt: skip
    fit = PointFit(camera, errors)
    if not fit.typical < MAX_TYPICAL:
        raise InputError(
            f"no camera fits its {len(points)} points: typical error {fit.typical:.2g} px; check that world and pixels "
            "of each line are of the same point, and the order of the columns",
            field=where,
        )
    return fit


def _best(points: np.ndarray, pixels: np.ndarray, size: tuple[int, int]) -> tuple[CameraBundle, np.ndarray]:
    """Return the best fit of several starts, and the distances of its points, px."""
    import cv2

    height, width = size
    observation = TargetObservation(0, 0, Detection(np.arange(len(points)), pixels, points))
    radial, tangential = len(points) >= MIN_FOR_K1, len(points) >= MIN_FOR_ALL
    results = []
    for focal in FOCAL_LENGTHS:
        k = np.array([focal * width, focal * width, (width - 1) / 2, (height - 1) / 2, *np.zeros(INTRINSIC - 4)])
        matrix = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]])
        *_, turn, shift = cv2.solvePnP(points, pixels, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        bundle = CameraBundle(
            intrinsics=k[None],
            cameras=(Pose.of_vector(np.concatenate([turn.ravel(), shift.ravel()])),),
            poses=(Pose(np.eye(3), np.zeros(3)),),
            fixed=0,
            free=(*(True,) * 4, radial, *(tangential,) * 3, *(False,) * 3),
            sizes=(size,),
        )
        for noise in INITIAL_NOISE:
            bundle, _ = adjust(bundle, [observation], noise)
        results.append((float(np.median(np.linalg.norm(bundle.residual(observation), axis=1))), bundle))
    median, bundle = min(results, key=lambda result: result[0])
    bundle, _ = adjust(bundle, [observation], max(RMS_OF_MEDIAN * median / np.sqrt(2), MIN_NOISE))
    return bundle, np.linalg.norm(bundle.residual(observation), axis=1)
