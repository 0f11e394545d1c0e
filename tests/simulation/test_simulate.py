"""Simulated measurements: noise as stated, misses untouched, steps enough."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from commands import run
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import Flame, make_phantom
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral
from nerif.forward.ray_tracing import CurvedRays
from nerif.geometry import Interface, Ring, paper_rig
from nerif.simulation.simulate import STEPS, add_noise, simulate, view_displacement
from refusals import refused


def test_noise_is_a_share_of_the_rms_over_crossing_rays(ball, cameras, box):
    clean = simulate(ball, cameras, box, 1.00027, noise=0.0, steps=40)
    assert clean.sigma is None
    noisy = add_noise(clean, 0.1, seed=1)
    _, d, _ = clean.rays()
    assert len(d) < clean.usable.sum()  # some rays miss the box: they must not count
    expected = 0.1 * float(d.square().mean().sqrt())
    assert float(noisy.sigma.min()) == float(noisy.sigma.max()) == pytest.approx(expected, rel=1e-5)
    added = (noisy.displacement - clean.displacement).flatten()
    assert float(added.std()) == pytest.approx(expected, rel=0.03)
    assert abs(float(added.mean())) < 0.05 * expected
    assert torch.equal(noisy.displacement, add_noise(clean, 0.1, seed=1).displacement)
    assert not torch.equal(noisy.displacement, add_noise(clean, 0.1, seed=2).displacement)
    with refused("noise"):
        add_noise(clean, -0.1)


def test_rays_that_miss_the_box_are_not_displaced(ball, cameras, box):
    camera = cameras[0]
    d = view_displacement(ball, camera, box, 1.00027, steps=30).reshape(-1, 2)
    crosses = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(box).crosses
    assert torch.equal(d[~crosses], torch.zeros_like(d[~crosses]))
    assert float(d[crosses].abs().max()) > 0.01


def test_simulation_meets_the_first_order_model(ball, cameras, box):
    """Exact projection of the bent ray's background point against S times its movement."""
    camera = cameras[1]
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(box)
    d = view_displacement(ball, camera, box, 1.00027, steps=100).reshape(-1, 2)[rays.crosses].double()
    straight = PathIntegral(MODELS["lever_arm"](1.00027), 200)(ball, rays[rays.crosses])
    assert float((d - straight).norm() / d.norm()) < 2e-3


def test_default_steps_are_enough_for_the_flame():
    cameras, box = paper_rig(pixels=24)
    flame = Flame(box)
    rays = cameras[3].rays(cameras[3].pixel_grid().reshape(-1, 2)).clip(box)
    rays = rays[rays.crosses][::4].to(dtype=torch.float32)
    fine = CurvedRays(4 * STEPS, 1.00027)(flame, rays)
    assert float((CurvedRays(STEPS, 1.00027)(flame, rays) - fine).norm() / fine.norm()) < 5e-4


def test_cameras_of_a_calibration_are_simulated_with_their_windows(tmp_path, capsys):
    """Behind a pane upright to the axis the flow seems nearer by t (1 - 1/n), and no ring's option is taken with it."""
    camera = Ring(views=1, arc=(0, 0), image_size=(12, 12), pixel_pitch=0.3).cameras()[0]
    normal, n = camera.rotation[2], 1.5
    front = float(normal @ (camera.centre + 500 * normal))
    pane = replace(camera, interfaces=(Interface(normal, front, n), Interface(normal, front + 60, 1.00027)))
    write_cameras(tmp_path / "pane.toml", [CalibratedCamera.from_camera(pane)])
    words = ("--calibration", tmp_path / "pane.toml", "--truth-voxels", 8, "--steps", 30)
    assert not run("simulate", "--out", tmp_path / "m.nc", *words)
    ours = Measurement.read(tmp_path / "m.nc")
    assert len(ours.cameras[0].interfaces) == 2
    forward = replace(camera, translation=camera.translation - torch.tensor([0, 0, 60 * (1 - 1 / n)]))
    expected = simulate(make_phantom("flame", ours.box), (forward,), ours.box, ours.n_ambient, steps=30)
    plain = simulate(make_phantom("flame", ours.box), (camera,), ours.box, ours.n_ambient, steps=30)
    d, near, far = (m.displacement.nan_to_num() for m in (ours, expected, plain))
    assert float((d - near).norm() / d.norm()) < 0.02
    assert float((d - far).norm() / d.norm()) > 0.04
    assert run("simulate", "--out", tmp_path / "n.nc", *words, "--views", 3) == 2
    assert "--calibration: expected without --views, which the file replaces" in capsys.readouterr().err


def test_views_of_different_size_are_padded_with_nan(ball, box):
    wide = Ring(views=1, arc=(0, 0), image_size=(10, 14), pixel_pitch=0.2).cameras()
    tall = Ring(views=1, arc=(60, 60), image_size=(13, 9), pixel_pitch=0.2).cameras()
    m = simulate(ball, wide + tall, box, 1.00027, steps=20)
    assert m.displacement.shape == (2, 13, 14, 2)
    assert bool(m.displacement[0, 10:].isnan().all())
    assert bool(m.displacement[1, :, 9:].isnan().all())
    assert int(m.usable.sum()) == 10 * 14 + 13 * 9
