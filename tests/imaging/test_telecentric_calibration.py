"""Telecentric cameras from points of flat targets: the rig comes back, and of it and its mirror image the right one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from calibration_images import target_images
from nerif.geometry import TELECENTRIC, Camera, Ring
from nerif.imaging.calibration.bundle import _Layout
from nerif.imaging.calibration.calibrate import CalibrationSettings, _on_side, calibrate
from nerif.imaging.calibration.first_guess import first_guess, mirror
from nerif.imaging.calibration.result import Calibration
from nerif.imaging.calibration.targets import CalibrationTarget, Detection
from nerif.simulation.experiment import side_of_one, world_axes
from refusals import refused

TARGET = CalibrationTarget("charuco", 9, 7, pitch=12.0)


def rig() -> tuple[Camera, ...]:
    """Three telecentric cameras, not quite where they should be, with some distortion."""
    rng = np.random.default_rng(2)
    ring = Ring(
        views=3, arc=(20.0, 120.0), elevation=8.0, image_size=(400, 500), pixel_pitch=0.03, projection="telecentric",
        magnification=0.1,
    )  # fmt: skip
    cameras = []
    for camera in ring.cameras():
        rotation = torch.from_numpy(Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix()) @ camera.rotation
        shift = torch.tensor([*rng.normal(0, 4, 2), 700.0], dtype=torch.float64)
        k = camera.intrinsics.clone()
        k[1, 1] *= 1.002
        distortion = torch.tensor([-2e-6, 0, 1e-6, -2e-6, 0], dtype=torch.float64)
        cameras.append(
            dataclasses.replace(camera, rotation=rotation, translation=shift, intrinsics=k, distortion=distortion)
        )
    return tuple(cameras)


CAMERAS = rig()
NAMES = [c.name for c in CAMERAS]
SETTINGS = CalibrationSettings(
    world="0", axes=world_axes(CAMERAS), projection="telecentric", side=side_of_one(CAMERAS),
    distortion=("k1", "p1", "p2"),
)  # fmt: skip
IMAGES = target_images(CAMERAS, TARGET)
NOISE = 0.05
NOISY = target_images(CAMERAS, TARGET, NOISE, poses=16)


@pytest.fixture(scope="module")
def exact() -> Calibration:
    return calibrate(IMAGES, SETTINGS)


@pytest.fixture(scope="module")
def noisy() -> Calibration:
    return calibrate(NOISY, SETTINGS, background_distance=480.0)


def turns(result: Calibration) -> np.ndarray:
    """Angles between calibrated and true cameras, degrees."""
    pairs = zip(CAMERAS, result.poses, strict=True)
    return np.array([
        np.degrees(Rotation.from_matrix(p.rotation @ c.rotation.numpy().T).magnitude()) for c, p in pairs
    ])  # fmt: skip


def test_exact_points_give_the_rig_back(exact):
    assert exact.rms() < 1e-4
    assert SETTINGS.side == (NAMES[0], "x+")
    assert turns(exact).max() < 1e-3
    points = torch.from_numpy(np.random.default_rng(0).uniform(-20, 20, (50, 3)))
    for camera, found, k in zip(CAMERAS, exact.cameras, exact.intrinsics, strict=True):
        assert found.projection == TELECENTRIC
        assert np.allclose(k[:2], camera.intrinsics[[0, 1], [0, 1]].numpy(), rtol=1e-5)
        assert float(found.translation[2]) == 0.0  # does not show: laid through the origin
        whole = found.camera(background=camera.background)
        assert float((whole.project(points) - camera.project(points)).abs().max()) < 1e-3


def test_errors_are_about_what_is_stated_and_depth_is_not_among_them(noisy):
    assert noisy.rms() == pytest.approx(NOISE * np.sqrt(2), rel=0.1)
    moves = np.array([
        np.linalg.norm((p.translation - c.translation.numpy())[:2]) for c, p in zip(CAMERAS, noisy.poses, strict=True)
    ])  # fmt: skip
    assert np.all(turns(noisy) < 4 * noisy.sigma_rotation)
    assert np.all(moves < 4 * noisy.sigma_translation)
    assert np.mean(turns(noisy)) > 0.1 * noisy.sigma_rotation.mean()
    assert noisy.sigma_translation.max() < 0.1  # mm; 700 mm of depth that no image shows would be far more
    assert sum("z_cam = 0 was laid through the origin" in note for note in noisy.notes) == 1


def test_the_background_stands_where_it_is_said_to_and_nowhere_else(exact, noisy):
    assert exact.backgrounds == (None,) * 3  # though there are images of targets laid on it
    assert sum("depth does not show, so its plane is not known" in note for note in exact.notes) == 3
    for camera in noisy.cameras:
        assert camera.background is not None
        assert camera.background.offset == -480.0
        assert torch.allclose(camera.background.normal, -camera.rotation[2])


@pytest.mark.parametrize("seed", range(6))
def test_the_first_guess_tells_every_tilt_up_to_one_mirror(seed):
    """Whatever the order in which the two rotations of an image come, and with noise."""
    views = [NOISY[i] for i in np.random.default_rng(seed).permutation(3)]
    truth = {c.name: c.rotation.numpy() for c in CAMERAS}
    bundle, observations = first_guess(views, ("k1",), "0", TELECENTRIC)
    assert max(bundle.rms(o) for o in observations) < 3.0
    relative = truth[views[0].name] @ truth[views[1].name].T
    apart = [
        np.degrees(Rotation.from_matrix(b.cameras[0].rotation @ b.cameras[1].rotation.T @ relative.T).magnitude())
        for b in (bundle, mirror(bundle))
    ]
    assert min(apart) < 2.0 < 10.0 < max(apart)


def test_the_mirror_image_takes_the_same_images_and_the_side_decides():
    bundle, observations = first_guess(IMAGES, ("k1",), "0", TELECENTRIC)
    for o in observations:
        assert np.allclose(bundle.project(o), mirror(bundle).project(o), atol=1e-9)
    for face, sign in (("x+", 1), ("x-", -1)):
        chosen = _on_side(bundle, dataclasses.replace(SETTINGS, side=(NAMES[0], face)), NAMES)
        assert -sign * float(SETTINGS.rotation[0] @ chosen.cameras[0].rotation[2]) > 0.5


def test_normal_equations_are_the_slope_of_the_cost():
    common = sorted(set(IMAGES[0].poses) & set(IMAGES[1].poses))[:3]
    some = [dataclasses.replace(v, poses={n: v.poses[n] for n in common}) for v in IMAGES[:2]]
    bundle, observations = first_guess(some, ("k1", "k2", "p1", "p2", "k3"), common[0], TELECENTRIC)
    bundle.intrinsics[:, 4:] = (1e-6, 1e-10, 1e-6, 2e-6, 1e-14)
    layout = _Layout(bundle, observations, noise=10.0)
    x = layout.pack(bundle)
    cost, curvature, slope = layout.normal_equations(x)
    assert cost == pytest.approx(layout.cost(x))
    size = np.sqrt(np.diag(curvature))
    for i in range(len(x)):
        step = 1e-2 / size[i] if size[i] > 0 else 1.0  # along unseen depths the cost does not change at all
        up, down = x.copy(), x.copy()
        up[i] += step
        down[i] -= step
        numeric = (layout.cost(up) - layout.cost(down)) / (2 * step)
        assert 2 * slope[i] == pytest.approx(numeric, rel=1e-3, abs=1e-5 * max(size[i], 1.0))
    assert int((size == 0).sum()) == 2  # the depths of the two cameras


def seen_in_a_mirror(found: Detection) -> Detection:
    return dataclasses.replace(found, pixels=found.pixels * [-1, 1] + [499, 0])


def test_mirrored_images_wrong_names_and_too_few_shared_poses_are_refused():
    flipped = dataclasses.replace(IMAGES[1], poses={n: seen_in_a_mirror(d) for n, d in IMAGES[1].poses.items()})
    with refused("view '70deg'"):
        calibrate([IMAGES[0], flipped, IMAGES[2]], SETTINGS)
    names = list(IMAGES[2].poses)
    values = list(IMAGES[2].poses.values())
    shifted = dataclasses.replace(IMAGES[2], poses=dict(zip(names, values[1:] + values[:1], strict=True)))
    with refused("view '120deg'"):
        calibrate([*IMAGES[:2], shifted], SETTINGS)
    lonely = dataclasses.replace(
        IMAGES[0], poses={n if n == "0" else f"9{n}": d for n, d in IMAGES[0].poses.items()}
    )  # fmt: skip
    with refused("view '20deg'"):
        calibrate([lonely, *IMAGES[1:]], SETTINGS)
    few = dataclasses.replace(IMAGES[0], poses=dict(list(IMAGES[0].poses.items())[:2]))
    with refused("view '20deg'"):
        calibrate([few, *IMAGES[1:]], SETTINGS)


@pytest.mark.parametrize(
    ("side", "words"),
    [
        (None, "side: expected a view and the side of the world"),
        ((NAMES[0], "left"), "side: expected a view and the side of the world"),
        (("cam9", "x+"), f"side: expected one of {NAMES[0]}, .*, got 'cam9'"),
    ],
)
def test_sides_that_cannot_be(side, words):
    with refused("side"):
        calibrate(IMAGES, dataclasses.replace(SETTINGS, side=side))


def test_a_side_on_which_the_mirror_image_stands_too():
    bundle, _ = first_guess(IMAGES, ("k1",), "0", TELECENTRIC)
    with refused("side"):
        _on_side(bundle, dataclasses.replace(SETTINGS, side=(NAMES[1], "y+")), NAMES)


def test_an_unknown_projection_is_refused():
    with refused("projection"):
        CalibrationSettings(projection="fisheye")


def test_one_camera_alone_has_a_scale_and_poses(exact):
    one = calibrate(IMAGES[:1], dataclasses.replace(SETTINGS, world="1"))
    assert one.rms() < 1e-3
    assert one.intrinsics[0, 0] == pytest.approx(exact.intrinsics[0, 0], rel=1e-4)
