"""Calibration from points that were found: exact ones give the rig back, bad ones are refused by name."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from calibration_images import detection, target_images
from nerif.common.conventions import InputError
from nerif.geometry import Camera, Plane, Ring
from nerif.imaging.calibration.bundle import Bundle, Observation, Pose, _Layout, adjust
from nerif.imaging.calibration.calibrate import CalibrationSettings, calibrate
from nerif.imaging.calibration.cameras_file import read_cameras
from nerif.imaging.calibration.result import Calibration
from nerif.imaging.calibration.targets import CalibrationTarget, Detection, ViewImages
from nerif.simulation.experiment import target_poses, world_axes
from refusals import refused

TARGET = CalibrationTarget("charuco", 9, 7, pitch=12.0)


def rig() -> tuple[Camera, ...]:
    """Four cameras that are not quite where they should be, with distortion and oblique backgrounds."""
    rng = np.random.default_rng(2)
    ring = Ring(views=4, arc=(20.0, 140.0), elevation=8.0, image_size=(400, 500), pixel_pitch=0.03)
    cameras = []
    for camera in ring.cameras():
        turn = torch.from_numpy(Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix())
        rotation = turn @ camera.rotation
        k = camera.intrinsics.clone()
        k[0, 2] += rng.normal(0, 5)
        k[1, 2] += rng.normal(0, 5)
        k[1, 1] *= 1.002
        normal = torch.from_numpy(Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()) @ camera.background.normal
        cameras.append(
            dataclasses.replace(
                camera,
                rotation=rotation,
                translation=-rotation @ (camera.centre + torch.from_numpy(rng.normal(0, 4, 3))),
                intrinsics=k,
                background=Plane(normal, -500.0 + float(rng.normal(0, 10))),
                distortion=torch.tensor([-0.12, 0.1, 0.001, -0.0005, 0.0], dtype=torch.float64),
            )
        )
    return tuple(cameras)


CAMERAS = rig()
SETTINGS = CalibrationSettings(world="0", axes=world_axes(CAMERAS))
NOISE = 0.05  # px


def images(noise: float = 0.0, poses: int = 12, backgrounds: int = 3) -> list[ViewImages]:
    return target_images(CAMERAS, TARGET, noise, poses, backgrounds)


@pytest.fixture(scope="module")
def exact() -> Calibration:
    """From points without noise."""
    return calibrate(images(), SETTINGS)


@pytest.fixture(scope="module")
def noisy() -> Calibration:
    return calibrate(images(NOISE, poses=16), SETTINGS)


def test_exact_points_give_the_rig_back(exact):
    assert exact.rms() < 1e-4
    for camera, pose, k, plane in zip(CAMERAS, exact.poses, exact.intrinsics, exact.backgrounds, strict=True):
        turn = Rotation.from_matrix(pose.rotation @ camera.rotation.numpy().T).magnitude()
        assert np.degrees(turn) < 1e-3
        assert np.abs(pose.translation - camera.translation.numpy()).max() < 0.01
        assert np.abs(k[:4] - camera.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].numpy()).max() < 0.05
        assert np.abs(k[4:8] - camera.distortion[:4].numpy()).max() < 0.02
        assert plane is not None
        assert plane.rms < 0.01
        assert np.abs(np.array(plane.normal) - camera.background.normal.numpy()).max() < 1e-5
        assert abs(plane.offset - camera.background.offset) < 0.01


def test_errors_are_about_what_is_stated(noisy):
    assert noisy.rms() == pytest.approx(NOISE * np.sqrt(2), rel=0.1)
    turns, moves = [], []
    for camera, pose in zip(CAMERAS, noisy.poses, strict=True):
        turns.append(np.degrees(Rotation.from_matrix(pose.rotation @ camera.rotation.numpy().T).magnitude()))
        moves.append(np.linalg.norm(pose.translation - camera.translation.numpy()))
    assert np.all(np.array(turns) < 3 * noisy.sigma_rotation)
    assert np.mean(turns) > 0.1 * noisy.sigma_rotation.mean()
    assert np.all(np.array(moves) < 3 * noisy.sigma_translation)


def test_turns_and_shifts_of_cameras_are_about_their_pose_sigma(noisy):
    """The mount is left out; what noise does to a camera about its own axes is what refinement goes by."""
    result = dataclasses.replace(noisy, mount=(0.0, 0.0))
    off = []
    for camera, found in zip(CAMERAS, result.cameras, strict=True):
        turn = Rotation.from_matrix((camera.rotation @ found.rotation.T).numpy()).as_rotvec()
        centre = -found.rotation.T @ found.translation
        shift = found.rotation @ (camera.centre - centre)
        off.append(np.concatenate([turn, shift.numpy()]) / found.pose_sigma.numpy())
    assert np.abs(off).max() < 4
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.6


def test_a_mount_adds_to_the_noise_and_is_kept_in_the_file(tmp_path, exact):
    exact.write(tmp_path / "c.toml")
    sigma = read_cameras(tmp_path / "c.toml")[0].camera((400, 500)).pose_sigma
    assert sigma.tolist() == pytest.approx([np.radians(0.005)] * 3 + [0.05] * 3, rel=0.05)


def test_without_background_images_there_is_no_plane_but_a_note():
    result = calibrate(images(backgrounds=0), SETTINGS)
    assert result.backgrounds == (None,) * 4
    assert sum("its plane is not known" in n for n in result.notes) == 4


@pytest.mark.slow
def test_world_is_where_it_is_asked_for():
    plain = calibrate(images(), dataclasses.replace(SETTINGS, axes=("x+", "y+", "z+")))
    moved = calibrate(images(), dataclasses.replace(SETTINGS, axes=("y+", "z+", "x+"), origin=(1.0, 2.0, 3.0)))
    for a, b in zip(plain.poses, moved.poses, strict=True):
        x, y, z = a.inverse.translation
        assert np.allclose(b.inverse.translation, [y + 1, z + 2, x + 3], atol=1e-3)


def test_a_bad_image_is_left_out_and_named():
    views = images(0.02)
    wrong = next(iter(n for n in views[1].poses if n != "0"))
    ids, pixels = views[1].poses[wrong].ids, views[1].poses[wrong].pixels.copy()
    pixels[::2] += 3.0  # the target moved while the image was taken
    poses = {**views[1].poses, wrong: Detection(ids, pixels, TARGET.points[ids])}
    views[1] = dataclasses.replace(views[1], poses=poses)
    result = calibrate(views, SETTINGS)
    assert [e.image for e in result.errors if not e.used and e.camera == views[1].name] == [wrong]
    assert any(f"{views[1].name}/{wrong}: left out" in n for n in result.notes)
    assert result.rms() < 0.1


def mirrored(view: ViewImages) -> ViewImages:
    """The view as through a mirror, its corners numbered as a chessboard's would be."""
    columns, rows = TARGET.shape
    flip = np.arange(columns * rows).reshape(rows, columns)[:, ::-1].ravel()

    def turned(found: Detection) -> Detection:
        pixels = found.pixels * [-1, 1] + [view.size[1] - 1, 0]
        return Detection(flip[found.ids], pixels, TARGET.points[flip[found.ids]])

    return dataclasses.replace(
        view,
        poses={n: turned(d) for n, d in view.poses.items()},
        background={n: turned(d) for n, d in view.background.items()},
    )


def test_a_mirrored_camera_is_refused_by_name():
    views = images(0.02)
    views[2] = mirrored(views[2])
    with refused("view '100deg'"):
        calibrate(views, SETTINGS)


def test_poses_under_wrong_names_are_refused():
    views = images(0.02)
    names = list(views[3].poses)
    shifted = dict(zip(names, list(views[3].poses.values())[1:] + list(views[3].poses.values())[:1], strict=True))
    views[3] = dataclasses.replace(views[3], poses=shifted)
    with refused("view '140deg'"):
        calibrate(views, SETTINGS)


def relabelled(target: Target) -> list[ViewImages]:
    """The same images, taken for those of another target."""

    def other(found: dict[str, Detection]) -> dict[str, Detection]:
        return {n: dataclasses.replace(d, points=target.points[d.ids]) for n, d in found.items()}

    return [dataclasses.replace(v, poses=other(v.poses), background=other(v.background)) for v in images()]


@pytest.mark.slow
def test_a_wrong_pitch_shows_in_the_size_of_the_rig_only():
    result = calibrate(relabelled(dataclasses.replace(TARGET, pitch=24.0)), SETTINGS)
    assert result.rms() < 1e-3
    reach = np.linalg.norm(result.poses[0].inverse.translation)
    assert reach == pytest.approx(2 * float(CAMERAS[0].centre.norm()), rel=1e-3)


def test_a_wrong_number_of_squares_is_refused():
    with refused("view '60deg'"):
        calibrate(relabelled(CalibrationTarget("charuco", 8, 8, pitch=12.0)), SETTINGS)


def test_too_few_poses_and_cameras_without_a_common_one():
    views = images()
    few = dataclasses.replace(views[0], poses=dict(list(views[0].poses.items())[:2]), background={})
    with refused("view '20deg'"):
        calibrate([few, *views[1:]], SETTINGS)
    lonely = dataclasses.replace(views[0], poses={f"9{n}": d for n, d in views[0].poses.items()})
    with refused("view '20deg'"):
        calibrate([lonely, *views[1:]], SETTINGS)
    with refused("calibrate"):
        calibrate([], SETTINGS)
    with refused("world"):
        calibrate(views, dataclasses.replace(SETTINGS, world="77"))


def test_a_large_error_is_refused_with_its_worst_image():
    with refused("view '20deg'"):
        calibrate(images(0.5, poses=8), dataclasses.replace(SETTINGS, max_error=0.3))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axes": ("x+", "y+", "z-")}, "right-handed"),
        ({"distortion": ("k9",)}, "k9"),
        ({"max_error": 0.0}, "max_error"),
    ],
)
def test_settings_that_cannot_be_right(change, words):
    with pytest.raises(InputError, match=words):
        CalibrationSettings(**change)


@pytest.fixture
def small() -> tuple[Bundle, list[Observation]]:
    """Two cameras, three poses, off from the truth."""
    rng = np.random.default_rng(0)
    poses = target_poses(CAMERAS[1:3], TARGET, 4, seed=3)
    observations = [
        Observation(i, j, d)
        for i, camera in enumerate(CAMERAS[1:3])
        for j, pose in enumerate(poses)
        for d in [detection(camera, TARGET, pose, 0.0, rng)]
    ]
    k = np.array([[c.intrinsics[0, 0], c.intrinsics[1, 1], 250, 200, 0, 0, 0, 0, 0] for c in CAMERAS[1:3]], dtype=float)
    cameras = tuple(Pose(c.rotation.numpy(), c.translation.numpy() + 1.0) for c in CAMERAS[1:3])
    return Bundle(k, cameras, tuple(poses), 0, (True,) * 8 + (False,), ((400, 500),) * 2), observations


def test_normal_equations_are_the_slope_of_the_cost(small):
    bundle, observations = small
    layout = _Layout(bundle, observations, noise=10.0)  # in the quadratic part of Huber's loss
    x = layout.pack(bundle)
    cost, curvature, slope = layout.normal_equations(x)
    assert cost == pytest.approx(layout.cost(x))
    assert np.allclose(curvature, curvature.T)
    for i in range(len(x)):
        step = 1e-5 * max(1.0, abs(x[i]))
        up, down = x.copy(), x.copy()
        up[i] += step
        down[i] -= step
        assert 2 * slope[i] == pytest.approx((layout.cost(up) - layout.cost(down)) / (2 * step), rel=1e-3, abs=1e-2)


def test_adjustment_ends_in_a_minimum(small):
    bundle, observations = small
    done, covariance = adjust(bundle, observations, noise=0.01)
    layout = _Layout(done, observations, 0.01)
    x = layout.pack(done)
    least = layout.cost(x)
    assert least < 1e-3 * _Layout(bundle, observations, 0.01).cost(layout.pack(bundle))
    rng = np.random.default_rng(0)
    spread = np.where(np.abs(x) > 0, np.abs(x), 1.0)
    assert all(layout.cost(x + 1e-4 * spread * rng.standard_normal(len(x))) > least for _ in range(20))
    assert np.all(np.diagonal(covariance, axis1=1, axis2=2)[:, 9:] > 0)


def test_poses_are_put_one_after_the_other_and_undone():
    rng = np.random.default_rng(0)
    a, b = (Pose.of_vector(rng.standard_normal(6)) for _ in range(2))
    point = rng.standard_normal(3)
    joint = a @ b
    assert np.allclose(
        joint.rotation @ point + joint.translation, a.rotation @ (b.rotation @ point + b.translation) + a.translation
    )
    assert np.allclose((a @ a.inverse).vector, 0, atol=1e-12)
    assert np.allclose(Pose.of_vector(a.vector).rotation, a.rotation)
