"""Simulated measurements: noise as stated, misses untouched, steps enough."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.phantoms import Flame
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral
from nerif.forward.ray_tracing import CurvedRays
from nerif.geometry import Ring, paper_rig
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


def test_views_of_different_size_are_padded_with_nan(ball, box):
    wide = Ring(views=1, arc=(0, 0), image_size=(10, 14), pixel_pitch=0.2).cameras()
    tall = Ring(views=1, arc=(60, 60), image_size=(13, 9), pixel_pitch=0.2).cameras()
    m = simulate(ball, wide + tall, box, 1.00027, steps=20)
    assert m.displacement.shape == (2, 13, 14, 2)
    assert bool(m.displacement[0, 10:].isnan().all())
    assert bool(m.displacement[1, :, 9:].isnan().all())
    assert int(m.usable.sum()) == 10 * 14 + 13 * 9
