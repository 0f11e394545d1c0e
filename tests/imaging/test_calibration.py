"""Calibration from detected points: exact ones give the rig back, inconsistent ones are refused by view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from calibration_images import detection, target_images
from nerif.common.files import read_toml
from nerif.data.cameras_file import read_cameras
from nerif.geometry import PROJECTIONS, TELECENTRIC, Camera, Interface, Plane, Ring
from nerif.imaging.calibration.bundle import INTRINSIC, CameraBundle, Pose, TargetObservation, _ParameterOrder, adjust
from nerif.imaging.calibration.calibrate import _on_side, calibrate
from nerif.imaging.calibration.calibration_settings import CalibrationSettings
from nerif.imaging.calibration.first_guess import first_guess, mirror
from nerif.imaging.calibration.result import Calibration
from nerif.imaging.calibration.targets import CalibrationTarget, Detection, TargetDetections
from nerif.simulation.experiment import side_of_one, target_poses, world_axes
from refusals import refused

TARGET = CalibrationTarget("charuco", 9, 7, pitch=12.0)
NOISE = 0.05  # px
KINDS = sorted(PROJECTIONS)


def rig(kind: str) -> tuple[Camera, ...]:
    """Cameras off from a regular ring, with distortion and oblique backgrounds."""
    rng, perspective = np.random.default_rng(2), kind == "perspective"
    shape = (
        {"views": 4, "arc": (20.0, 140.0)} if perspective else {"views": 3, "arc": (20.0, 120.0), "magnification": 0.1}
    )
    distortion = [-0.12, 0.1, 0.001, -0.0005, 0.0] if perspective else [-2e-6, 0, 1e-6, -2e-6, 0]
    cameras = []
    for camera in Ring(elevation=8.0, image_size=(400, 500), pixel_pitch=0.03, projection=kind, **shape).cameras():
        rotation = torch.from_numpy(Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix()) @ camera.rotation
        k = camera.intrinsics.clone()
        k[:2, 2] += torch.from_numpy(rng.normal(0, 5, 2)) * perspective
        k[1, 1] *= 1.002
        normal = torch.from_numpy(Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()) @ camera.plane.normal
        cameras.append(
            replace(
                camera,
                rotation=rotation,
                translation=-rotation @ (camera.centre + torch.from_numpy(rng.normal(0, 4, 3))),
                intrinsics=k,
                background=Plane(normal, -500.0 + float(rng.normal(0, 10))),
                distortion=torch.tensor(distortion, dtype=torch.float64),
            )
        )
    return tuple(cameras)


RIGS = {kind: rig(kind) for kind in KINDS}
CAMERAS, BEAMS = RIGS["perspective"], RIGS["telecentric"]
NAMES = [c.name for c in BEAMS]
SETTINGS = {
    "perspective": CalibrationSettings(world="0", axes=world_axes(CAMERAS)),
    "telecentric": CalibrationSettings(
        world="0", axes=world_axes(BEAMS), projection="telecentric", side=side_of_one(BEAMS),
        distortion=("k1", "p1", "p2"),
    ),
}  # fmt: skip


def images(kind: str = "perspective", noise: float = 0, poses: int = 12, laid: int = 3) -> list[TargetDetections]:
    return target_images(RIGS[kind], TARGET, noise, poses, laid)


@pytest.fixture(scope="module")
def exact() -> dict[str, Calibration]:
    """From points without noise."""
    return {kind: calibrate(images(kind), SETTINGS[kind]) for kind in KINDS}


@pytest.fixture(scope="module")
def noisy() -> dict[str, Calibration]:
    distance = {"perspective": None, "telecentric": 480.0}
    return {kind: calibrate(images(kind, NOISE, 10), SETTINGS[kind], distance[kind]) for kind in KINDS}


def turns(result: Calibration, cameras: tuple[Camera, ...]) -> np.ndarray:
    """Angles between calibrated and true cameras, degrees."""
    rotations = [p.rotation @ c.rotation.numpy().T for c, p in zip(cameras, result.poses, strict=True)]
    return np.degrees(Rotation.from_matrix(np.stack(rotations)).magnitude())


@pytest.mark.parametrize("kind", KINDS)
def test_exact_points_give_the_rig_back(exact, kind):
    result = exact[kind]
    assert result.rms() < 1e-4
    assert turns(result, RIGS[kind]).max() < 1e-3
    points = torch.from_numpy(np.random.default_rng(0).uniform(-20, 20, (50, 3)))
    for camera, estimate, k in zip(RIGS[kind], result.cameras, result.intrinsics, strict=True):
        whole = estimate.camera(background=camera.background)
        assert estimate.projection == camera.projection
        assert float((whole.project(points) - camera.project(points)).abs().max()) < 2e-3
        assert np.allclose(k[:2], camera.intrinsics[[0, 1], [0, 1]].numpy(), rtol=2e-5)


def test_centres_distortion_and_backgrounds_of_perspective_cameras_come_back(exact):
    result = exact["perspective"]
    for camera, pose, k, plane in zip(CAMERAS, result.poses, result.intrinsics, result.backgrounds, strict=True):
        assert np.abs(pose.translation - camera.translation.numpy()).max() < 0.01
        assert np.abs(k[:4] - camera.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].numpy()).max() < 0.05
        assert np.abs(k[4:8] - camera.distortion[:4].numpy()).max() < 0.02
        assert plane is not None
        assert plane.rms < 0.01
        assert np.abs(np.array(plane.normal) - camera.plane.normal.numpy()).max() < 1e-5
        assert abs(plane.offset - camera.plane.offset) < 0.01


def through_windows(cameras: tuple[Camera, ...], behind: float) -> tuple[Camera, ...]:
    """Cameras with a pane of 20 mm in front, turned by 20 degrees, and another medium behind it."""
    turn = torch.from_numpy(Rotation.from_rotvec([0, 0, np.radians(20)]).as_matrix())
    normals = [turn @ -c.rotation[2] for c in cameras]
    return tuple(
        replace(c, interfaces=(Interface(n, 140.0, 1.52), Interface(n, 120.0, behind)))
        for c, n in zip(cameras, normals, strict=True)
    )


@pytest.mark.parametrize("behind", [1.0, pytest.param(1.333, marks=pytest.mark.slow)])
def test_targets_seen_through_windows_give_the_rig_back(tmp_path, behind):
    """With a tank the world seems nearer, with air behind the pane it is shifted: both come out as they are."""
    cameras = through_windows(CAMERAS[1:3], behind)
    views = target_images(cameras, TARGET, 0, 8, 0)
    windows = {camera.name: camera.interfaces for camera in cameras}
    settings = replace(SETTINGS["perspective"], axes=world_axes(cameras))
    result = calibrate(views, settings, 480.0, windows)
    assert result.rms() < 1e-4
    assert turns(result, cameras).max() < 2e-3
    result.write(tmp_path / "c.toml")
    points = torch.from_numpy(np.random.default_rng(0).uniform(-20, 20, (50, 3)))
    for camera, estimate in zip(cameras, read_cameras(tmp_path / "c.toml"), strict=True):
        assert len(estimate.interfaces) == 2
        assert (
            float((estimate.camera(background=camera.background).project(points) - camera.project(points)).abs().max())
            < 5e-3
        )
    if behind == 1.0:
        ignored = calibrate(views, settings, 480.0)
        assert turns(ignored, cameras).max() > 20 * turns(result, cameras).max()


@pytest.mark.parametrize("case", ["order", "behind the camera", "behind the targets"])
def test_windows_that_the_rays_do_not_cross_are_refused(case):
    cameras = through_windows(CAMERAS, 1.0)
    views = target_images(cameras, TARGET, 0, 10, 0)
    windows = {camera.name: camera.interfaces for camera in cameras}
    first = cameras[0]
    near, far = first.interfaces
    windows[first.name] = {
        "order": (far, near), "behind the camera": (replace(near, offset=5000.0),),
        "behind the targets": (replace(near, offset=-400.0),),
    }[case]  # fmt: skip
    with refused(f"interfaces of view '{first.name}'"):
        calibrate(views, SETTINGS["perspective"], 480.0, windows)


def test_windows_in_front_of_telecentric_targets_are_refused():
    planes = {NAMES[0]: (Interface(torch.tensor([1.0, 0, 0]), 100.0, 1.5),)}
    with refused("interfaces"):
        calibrate(images("telecentric"), SETTINGS["telecentric"], interfaces=planes)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_errors_are_about_their_standard_deviations(noisy, kind):
    """Without the depth of a telecentric camera: 700 mm that no image constrains."""
    result = noisy[kind]
    assert result.rms() == pytest.approx(NOISE * np.sqrt(2), rel=0.1)
    shifts = np.array([
        (p.translation - c.translation.numpy())[: 3 if kind == "perspective" else 2]
        for c, p in zip(RIGS[kind], result.poses, strict=True)
    ])  # fmt: skip
    angles = turns(result, RIGS[kind])
    assert np.all(angles < 4 * result.sigma_rotation)
    assert np.mean(angles) > 0.1 * result.sigma_rotation.mean()
    assert np.all(np.linalg.norm(shifts, axis=1) < 4 * result.sigma_translation)
    assert kind == "perspective" or result.sigma_translation.max() < 0.1


def test_pose_errors_about_the_cameras_axes_are_about_pose_sigma(noisy):
    """Noise alone, without the mount: the prior of a refinement."""
    result = replace(noisy["perspective"], mount=(0.0, 0.0))
    errors = []
    for camera, estimate in zip(CAMERAS, result.cameras, strict=True):
        turn = Rotation.from_matrix((camera.rotation @ estimate.rotation.T).numpy()).as_rotvec()
        shift = estimate.rotation @ (camera.centre + estimate.rotation.T @ estimate.translation)
        errors.append(np.concatenate([turn, shift.numpy()]) / estimate.pose_sigma.numpy())
    assert np.abs(errors).max() < 4
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.6


def test_a_mount_adds_to_the_noise_and_is_in_the_file(tmp_path, exact):
    exact["perspective"].write(tmp_path / "c.toml")
    sigma = read_cameras(tmp_path / "c.toml")[0].camera((400, 500)).pose_sigma
    assert sigma.tolist() == pytest.approx([np.radians(0.005)] * 3 + [0.05] * 3, rel=0.05)


def test_without_background_images_planes_are_unknown():
    result = calibrate(images(poses=8, laid=0), SETTINGS["perspective"])
    assert result.backgrounds == (None,) * 4
    assert sum("background plane is unknown" in n for n in result.notes) == 4


def test_backgrounds_of_telecentric_cameras_are_at_the_distance_of_the_settings(exact, noisy):
    result = exact["telecentric"]
    assert result.backgrounds == (None,) * 3  # though there are images of targets on it
    assert sum("background plane is unknown" in n for n in result.notes) == 3
    assert sum("z_cam = 0 was placed at the origin" in n for n in result.notes) == 1
    assert [float(c.translation[2]) for c in result.cameras] == [0.0] * 3
    for camera in noisy["telecentric"].cameras:
        assert camera.background.offset == -480.0
        assert torch.allclose(camera.background.normal, -camera.rotation[2])


@pytest.mark.slow
def test_world_is_as_in_the_settings():
    plain = calibrate(images(), replace(SETTINGS["perspective"], axes=("x+", "y+", "z+")))
    other = calibrate(images(), replace(SETTINGS["perspective"], axes=("y+", "z+", "x+"), origin=(1.0, 2.0, 3.0)))
    for a, b in zip(plain.poses, other.poses, strict=True):
        x, y, z = a.inverse.translation
        assert np.allclose(b.inverse.translation, [y + 1, z + 2, x + 3], atol=1e-3)


def changed(view: TargetDetections, change: Callable[[Detection], Detection]) -> TargetDetections:
    poses, background = ({n: change(d) for n, d in group.items()} for group in (view.poses, view.background))
    return replace(view, poses=poses, background=background)


@pytest.mark.slow
def test_a_bad_image_is_left_out_and_named():
    views = images(noise=0.02, poses=8)
    name, bad = next((n, d) for n, d in views[1].poses.items() if n != "0")
    pixels = bad.pixels.copy()
    pixels[::2] += 3.0  # the target moved while the image was recorded
    views[1] = replace(views[1], poses={**views[1].poses, name: replace(bad, pixels=pixels)})
    result = calibrate(views, SETTINGS["perspective"])
    assert [e.image for e in result.errors if not e.used and e.camera == views[1].name] == [name]
    assert any(f"{views[1].name}/{name}: left out" in n for n in result.notes)
    assert result.rms() < 0.1


def mirrored(detection: Detection) -> Detection:
    """A detection as through a mirror, its corners numbered as a chessboard's would be."""
    columns, rows = TARGET.shape
    flip = np.arange(columns * rows).reshape(rows, columns)[:, ::-1].ravel()
    ids = flip[detection.ids]
    return Detection(ids, detection.pixels * [-1, 1] + [499, 0], TARGET.points[ids])


def shifted(view: TargetDetections) -> TargetDetections:
    """Poses under wrong names."""
    values = list(view.poses.values())
    return replace(view, poses=dict(zip(view.poses, values[1:] + values[:1], strict=True)))


FAULTS: dict[str, Callable[[TargetDetections], TargetDetections]] = {
    "mirrored": lambda view: changed(view, mirrored),
    "mirrored, as ChArUco": lambda view: changed(view, lambda d: replace(d, pixels=d.pixels * [-1, 1] + [499, 0])),
    "wrong names": shifted,
    "too few": lambda view: replace(view, poses=dict(list(view.poses.items())[:2]), background={}),
    "none in common": lambda view: replace(view, poses={f"9{n}": d for n, d in view.poses.items()}),
}
COMMON = next(n for n in images("telecentric")[0].poses if n in images("telecentric")[1].poses)
FAULTS["one in common"] = lambda view: replace(
    view, poses={n if n == COMMON else f"9{n}": d for n, d in view.poses.items()}
)


@pytest.mark.parametrize(
    ("kind", "fault"), [(k, f) for k in KINDS for f in FAULTS if (k, f) != ("perspective", "one in common")]
)
def test_a_view_with_a_fault_is_refused_by_name(kind, fault):
    views = images(kind, 0.02)
    i = 0 if fault == "too few" or "in common" in fault else len(views) - 1
    views[i] = FAULTS[fault](views[i])
    with refused(f"view '{views[i].name}'"):
        calibrate(views, SETTINGS[kind])


def relabelled(target: CalibrationTarget) -> list[TargetDetections]:
    """The same images with the points of another target."""
    return [changed(view, lambda d: replace(d, points=target.points[d.ids])) for view in images(poses=8)]


@pytest.mark.slow
def test_a_wrong_pitch_shows_in_the_size_of_the_rig_only():
    result = calibrate(relabelled(replace(TARGET, pitch=24.0)), SETTINGS["perspective"])
    assert result.rms() < 1e-3
    reach = np.linalg.norm(result.poses[0].inverse.translation)
    assert reach == pytest.approx(2 * float(CAMERAS[0].centre.norm()), rel=1e-3)


@pytest.mark.slow
def test_a_wrong_number_of_squares_and_a_large_error_are_refused():
    with refused("view '100deg'"):
        calibrate(relabelled(CalibrationTarget("charuco", 8, 8, pitch=12.0)), SETTINGS["perspective"])
    with refused("view '20deg'"):
        calibrate(images("telecentric", NOISE), replace(SETTINGS["telecentric"], max_error=0.01))


def test_names_of_views_and_poses_that_are_none():
    with refused("calibrate"):
        calibrate([], SETTINGS["perspective"])
    with refused("world"):
        calibrate(images(poses=4), replace(SETTINGS["perspective"], world="77"))
    with refused("side"):
        calibrate(images("telecentric"), replace(SETTINGS["telecentric"], side=("cam9", "x+")))


# -- Scheimpflug ---------------------------------------------------------------------------------------------------

TILTS = np.array([[6.0, -8.0], [-9.0, 2.5]])  # degrees
SCHEIMPFLUG = replace(SETTINGS["perspective"], scheimpflug=True, axes=world_axes(CAMERAS[1:3]))


def tilted_pair(tilts: np.ndarray) -> tuple[Camera, ...]:
    pairs = zip(CAMERAS[1:3], np.radians(tilts), strict=True)
    return tuple(replace(camera, tilt=torch.from_numpy(tilt)) for camera, tilt in pairs)


@pytest.mark.parametrize("tilts", [TILTS, pytest.param(0 * TILTS, marks=pytest.mark.slow)])
def test_tilts_come_back_within_their_standard_deviations_also_of_0(tmp_path, tilts):
    cameras = tilted_pair(tilts)
    result = calibrate(target_images(cameras, TARGET, NOISE, 10), SCHEIMPFLUG)
    assert result.rms() == pytest.approx(NOISE * np.sqrt(2), rel=0.05)
    errors = (result.tilt - tilts) / result.sigma_tilt
    assert np.abs(errors).max() < 3.5
    assert 0.1 < result.sigma_tilt.min() < result.sigma_tilt.max() < 1.0
    points = torch.from_numpy(np.random.default_rng(0).uniform(-20, 20, (50, 3)))
    for camera, calibrated in zip(cameras, result.cameras, strict=True):
        whole = calibrated.camera(background=camera.background)
        assert float((whole.project(points) - camera.project(points)).abs().max()) < NOISE
    result.write(tmp_path / "c.toml")
    cameras, about = read_cameras(tmp_path / "c.toml"), read_toml(tmp_path / "c.toml")["about"]
    assert np.allclose(np.degrees(np.stack([c.tilt.numpy() for c in cameras])), result.tilt, atol=1e-12)
    assert list(about["sigma_tilt_deg"].values()) == result.sigma_tilt.tolist()


@pytest.mark.slow
def test_pose_sigma_is_for_the_tilt_as_it_is():
    """The prior of a refinement, which keeps the tilt: about that of a calibration without it."""
    views = target_images(tilted_pair(TILTS), TARGET, NOISE, 10)
    one, other = (calibrate(views, replace(SCHEIMPFLUG, scheimpflug=s)) for s in (True, False))
    assert np.all(one.pose_sigma < 1.5 * other.pose_sigma)
    assert one.sigma_rotation.min() > 2 * other.sigma_rotation.max()


@pytest.mark.slow
def test_the_reprojection_error_is_that_of_opencv():
    """One camera of the same parameters; where images hardly distinguish tilt from principal point, they may differ."""
    (view,) = target_images(tilted_pair(TILTS)[:1], TARGET, NOISE, 14)
    result = calibrate([view], SCHEIMPFLUG)
    images = [*view.poses.values(), *view.background.values()]
    points, pixels = ([getattr(d, name).astype(np.float32) for d in images] for name in ("points", "pixels"))
    k = np.array([[1700.0, 0, 249.5], [0, 1700.0, 199.5], [0, 0, 1]])
    flags = cv2.CALIB_TILTED_MODEL | cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    flags |= sum(getattr(cv2, f"CALIB_FIX_{name}") for name in ("K4", "K5", "K6"))
    rms, *_ = cv2.calibrateCamera(points, pixels, (500, 400), k, np.zeros(14), flags=flags)
    assert result.rms() == pytest.approx(rms, rel=2e-3)


# -- telecentric: two rotations per image, and the mirror image of the rig -----------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_the_first_guess_resolves_every_tilt_up_to_one_mirror_image(seed):
    """Whatever the order of the two rotations of an image, and with noise."""
    noisy = images("telecentric", NOISE, 16)
    views = [noisy[i] for i in np.random.default_rng(seed).permutation(3)]
    bundle, observations = first_guess(views, ("k1",), "0", TELECENTRIC)
    assert max(bundle.rms(o) for o in observations) < 3.0
    truth = {c.name: c.rotation.numpy() for c in BEAMS}
    relative = truth[views[0].name] @ truth[views[1].name].T
    errors = [
        np.degrees(Rotation.from_matrix(b.cameras[0].rotation @ b.cameras[1].rotation.T @ relative.T).magnitude())
        for b in (bundle, mirror(bundle))
    ]
    assert min(errors) < 2.0 < 10.0 < max(errors)


def test_the_mirror_image_takes_the_same_images_and_the_side_decides():
    settings = SETTINGS["telecentric"]
    assert settings.side == (NAMES[0], "x+")
    bundle, observations = first_guess(images("telecentric"), ("k1",), "0", TELECENTRIC)
    for o in observations:
        assert np.allclose(bundle.project(o), mirror(bundle).project(o), atol=1e-9)
    for face, sign in (("x+", 1), ("x-", -1)):
        result = _on_side(bundle, replace(settings, side=(NAMES[0], face)), NAMES)
        assert -sign * float(settings.rotation[0] @ result.cameras[0].rotation[2]) > 0.5
    with refused("side"):
        _on_side(bundle, replace(settings, side=(NAMES[1], "y+")), NAMES)  # where the mirror image stands too


def test_one_telecentric_camera_alone_has_a_scale_and_poses(exact):
    one = calibrate(images("telecentric")[:1], replace(SETTINGS["telecentric"], world="1"))
    assert one.rms() < 1e-3
    assert one.intrinsics[0, 0] == pytest.approx(exact["telecentric"].intrinsics[0, 0], rel=1e-4)


# -- bundle adjustment ---------------------------------------------------------------------------------------------


def small(kind: str) -> tuple[CameraBundle, list[TargetObservation]]:
    """Two cameras, three or four poses, off from the truth."""
    rng = np.random.default_rng(0)
    if kind == "telecentric":
        views = images(kind)[:2]
        common = sorted(set(views[0].poses) & set(views[1].poses))[:3]
        views = [replace(v, poses={n: v.poses[n] for n in common}) for v in views]
        bundle, observations = first_guess(views, ("k1", "k2", "p1", "p2", "k3"), common[0], TELECENTRIC)
        bundle.intrinsics[:, 4:9] = (1e-6, 1e-10, 1e-6, 2e-6, 1e-14)
        return bundle, observations
    pair = CAMERAS[1:3]
    poses = target_poses(pair, TARGET, 4, seed=3)[: 3 if kind == "windows" else 4]
    observations = [
        TargetObservation(i, j, detection(camera, TARGET, pose, 0.0, rng))
        for i, camera in enumerate(pair)
        for j, pose in enumerate(poses)
    ]
    k = np.array([[c.intrinsics[0, 0], c.intrinsics[1, 1], 250, 200, *np.zeros(7)] for c in pair], dtype=float)
    cameras = tuple(Pose(c.rotation.numpy(), c.translation.numpy() + 1.0) for c in pair)
    tilted = kind == "scheimpflug"
    k[:, 9:] = [(0.1, -0.07), (-0.05, 0.2)] if tilted else 0
    free = (*(True,) * 8, False, *(tilted,) * 2)
    planes = tuple(c.interfaces for c in through_windows(pair, 1.333)) if kind == "windows" else ()
    return CameraBundle(k, cameras, tuple(poses), 0, free, ((400, 500),) * 2, interfaces=planes), observations


@pytest.mark.parametrize("kind", [*KINDS, "scheimpflug", "windows"])
def test_normal_equations_are_the_slope_of_the_cost(kind):
    bundle, observations = small(kind)
    layout = _ParameterOrder(bundle, observations, noise=10.0)  # in the quadratic part of Huber's loss
    x = layout.pack(bundle)
    cost, curvature, slope = layout.normal_equations(x)
    assert cost == pytest.approx(layout.cost(x))
    assert np.allclose(curvature, curvature.T)
    size = np.sqrt(np.diag(curvature))
    for i in range(len(x)):
        step = np.zeros_like(x)
        step[i] = 1e-2 / size[i] if size[i] > 0 else 1.0  # the cost does not depend on an unconstrained depth
        numeric = (layout.cost(x + step) - layout.cost(x - step)) / (2 * step[i])
        assert 2 * slope[i] == pytest.approx(numeric, rel=1e-3, abs=1e-5 * max(size[i], 1.0))
    assert int((size == 0).sum()) == (2 if kind == "telecentric" else 0)  # the depths of the cameras


def test_adjustment_ends_in_a_minimum():
    bundle, observations = small("perspective")
    result, covariance = adjust(bundle, observations, noise=0.01)
    layout = _ParameterOrder(result, observations, 0.01)
    x = layout.pack(result)
    minimum = layout.cost(x)
    assert minimum < 1e-3 * _ParameterOrder(bundle, observations, 0.01).cost(layout.pack(bundle))
    rng = np.random.default_rng(0)
    spread = np.where(np.abs(x) > 0, np.abs(x), 1.0)
    assert all(layout.cost(x + 1e-4 * spread * rng.standard_normal(len(x))) > minimum for _ in range(20))
    assert np.all(np.diagonal(covariance, axis1=1, axis2=2)[:, INTRINSIC:] > 0)


def test_poses_compose_and_invert():
    rng = np.random.default_rng(0)
    a, b = (Pose.of_vector(rng.standard_normal(6)) for _ in range(2))
    points = rng.standard_normal((2, 3))
    assert np.allclose((a @ b).apply(points), a.apply(b.apply(points)))
    assert np.allclose((a @ a.inverse).vector, 0, atol=1e-12)
    assert np.allclose(Pose.of_vector(a.vector).rotation, a.rotation)
