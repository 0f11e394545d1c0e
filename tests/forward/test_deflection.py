"""The forward models against closed forms, against each other, and under a turn of the whole rig."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from nerif.common.conventions import InputError
from nerif.fields.base import Field
from nerif.fields.phantoms import GaussianBalls
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.ray_tracing import CurvedRays, trace
from nerif.geometry import Box, Camera, Plane, Rays, Ring

N_AMBIENT = 1.0


def one_ball(amplitude: float, centre: tuple[float, float, float] = (0.3, -0.4, 0.2), width: float = 1.5) -> Field:
    return GaussianBalls(
        torch.tensor([centre], dtype=torch.float64),
        torch.tensor([width], dtype=torch.float64),
        torch.tensor([amplitude], dtype=torch.float64),
    )


def all_rays(cameras: tuple[Camera, ...], box: Box) -> Rays:
    return Rays.concatenate([c.rays(c.pixel_grid().reshape(-1, 2)) for c in cameras]).clip(box)


def rays_of(cameras: tuple[Camera, ...], box: Box) -> Rays:
    rays = all_rays(cameras, box)
    return rays[rays.crosses]


@pytest.fixture
def cube() -> Box:
    return Box((-16.0, -15.0, -14.0), (16.0, 15.0, 14.0))


def test_lever_arm_meets_the_closed_form_of_a_gaussian_ball(cameras, cube):
    """d = S int (s_b - s) grad(n) ds; for a ball the part across the ray integrates to a Gaussian of the miss distance.

    With b the vector from the centre to the nearest point of the ray, at s_0, the transverse gradient is
    -b a / w^2 exp(-b^2 / 2 w^2) exp(-(s - s_0)^2 / 2 w^2), so d = -S b a sqrt(2 pi) / w (s_b - s_0) exp(-b^2 / 2 w^2).
    The box is wide enough for the tails to be nothing, and the middle view looks through its middle.
    """
    a, w = -2e-4, 1.5
    field = one_ball(a, width=w)
    rays = rays_of(cameras, cube)
    to_centre = torch.tensor([0.3, -0.4, 0.2], dtype=torch.float64) - rays.origin
    s_0 = (to_centre * rays.direction).sum(-1)
    b = s_0[:, None] * rays.direction - to_centre
    size = a * math.sqrt(2 * math.pi) / w * (rays.ends.distance - s_0) * torch.exp(-b.square().sum(-1) / (2 * w * w))
    expected = -torch.einsum("nij,nj->ni", rays.ends.sensitivity, b) * size[:, None]
    chord = rays.far - rays.near
    clear = (chord > 20) & ((s_0 - rays.near).minimum(rays.far - s_0) > 9)  # tails inside the box
    assert int(clear.sum()) > 500
    # n in the denominator of the integrand is 1 to 2e-4
    got = PathIntegral(MODELS["lever_arm"](N_AMBIENT), 400)(field, rays)
    assert float((got - expected)[clear].abs().max()) < 4e-4 * float(expected.abs().max())


def test_zero_field_moves_nothing(cameras, box):
    rays = rays_of(cameras, box)
    field = one_ball(0.0)
    for model in (PathIntegral(MODELS["lever_arm"](), 20), PathIntegral(MODELS["paraxial"](), 20), CurvedRays(20)):
        assert float(model(field, rays).abs().max()) < 1e-9  # px; the rounding of a position


def test_curved_rays_converge_to_lever_arm_at_second_order(cameras, cube):
    rays = rays_of(cameras, cube)[::4]
    differences = []
    for amplitude in (-4e-3, -2e-3, -1e-3):
        field = one_ball(amplitude, width=2.5)
        straight = PathIntegral(MODELS["lever_arm"](N_AMBIENT), 200)(field, rays)
        curved = CurvedRays(200, N_AMBIENT)(field, rays)
        differences.append(float((straight - curved).square().mean().sqrt()))
    orders = [math.log2(a / b) for a, b in pairwise(differences)]
    assert all(1.9 < order < 2.1 for order in orders), (differences, orders)


def test_curved_deflection_is_right_to_second_order(cameras, cube):
    """Bending the straight ray once leaves what is of third order."""
    rays = rays_of(cameras, cube)[::4]
    differences = []
    for amplitude in (-1.6e-2, -8e-3, -4e-3):
        field = one_ball(amplitude, width=2.5)
        bent = PathIntegral(MODELS["curved"](N_AMBIENT), 400)(field, rays)
        curved = CurvedRays(400, N_AMBIENT)(field, rays)
        straight = PathIntegral(MODELS["lever_arm"](N_AMBIENT), 400)(field, rays)
        differences.append(float((bent - curved).square().mean().sqrt()))
        assert differences[-1] < 0.1 * float((straight - curved).square().mean().sqrt())
    orders = [math.log2(a / b) for a, b in pairwise(differences)]
    assert all(order > 2.6 for order in orders), (differences, orders)


def test_paraxial_differs_by_the_lever_arm_alone(cameras, cube):
    """On a field thin along the rays and at their middle, one lever arm for the whole ray is exact."""
    rays = rays_of(cameras, cube)
    middle = one_ball(-2e-4, (0.0, 0.0, 0.0), 0.7)
    lever, paraxial = (PathIntegral(MODELS[m](), 300)(middle, rays) for m in ("lever_arm", "paraxial"))
    away = one_ball(-2e-4, (9.0, 0.0, 0.0), 0.7)
    lever_away, paraxial_away = (PathIntegral(MODELS[m](), 300)(away, rays) for m in ("lever_arm", "paraxial"))
    near, far = (float((a - b).norm() / a.norm()) for a, b in ((lever, paraxial), (lever_away, paraxial_away)))
    assert near < 2e-3
    assert 5e-3 < far < 5e-2  # 9 mm of a lever arm of 450 mm


def turned(camera: Camera, rotation: torch.Tensor) -> Camera:
    """The camera and its background after turning the world by `rotation`."""
    plane = Plane(rotation @ camera.background.normal, camera.background.offset)
    return replace(camera, rotation=camera.rotation @ rotation.T, background=plane)


def test_turning_rig_and_phantom_together_changes_nothing(cameras, ball, rotation_about):
    turn = rotation_about((0.3, -1.0, 0.5), 0.8)
    moved = GaussianBalls(ball.centres @ turn.T, ball.widths, ball.amplitudes)
    # the box does not turn: take one so wide that the balls are deep inside it both ways
    wide = Box((-20.0, -20.0, -20.0), (20.0, 20.0, 20.0))
    for model in (PathIntegral(MODELS["lever_arm"](), 300), CurvedRays(200)):
        before = model(ball, all_rays(cameras, wide)[::4])
        after = model(moved, all_rays(tuple(turned(c, turn) for c in cameras), wide)[::4])
        assert float((before - after).abs().max()) < 1e-5 * float(before.abs().max())


def test_oblique_background_sees_the_same_to_first_order(ball, cube, rotation_about):
    """A background turned by 30 degrees about its middle: lever_arm still meets curved rays."""
    camera = Ring(views=1, arc=(20.0, 20.0), image_size=(18, 24), pixel_pitch=0.11).cameras()[0]
    tilt = rotation_about((0.2, 0.5, 1.0), math.radians(30))
    normal = tilt @ camera.background.normal
    centre = camera.background.normal * camera.background.offset
    oblique = replace(camera, background=Plane(normal, float(normal @ centre)))
    rays = rays_of((oblique,), cube)
    straight, curved = PathIntegral(MODELS["lever_arm"](), 300)(ball, rays), CurvedRays(200)(ball, rays)
    assert float((straight - curved).norm() / curved.norm()) < 4e-4
    upright = PathIntegral(MODELS["lever_arm"](), 300)(ball, rays_of((camera,), cube))
    assert float((straight - upright).norm() / upright.norm()) > 2e-3  # the tilt does matter


def test_runge_kutta_is_of_fourth_order(cameras, cube):
    rays = rays_of(cameras[:1], cube)
    field = one_ball(-5e-2, width=3.0)
    fine = trace(field, rays, 640)[1]
    errors = [float((trace(field, rays, n)[1] - fine).norm()) for n in (20, 40, 80)]
    orders = [math.log2(a / b) for a, b in pairwise(errors)]
    assert min(orders) > 3.7, orders


def test_rays_bend_towards_the_denser_gas():
    """A field that grows along +z bends a horizontal ray upward."""
    camera = Ring(views=1, arc=(0.0, 0.0), image_size=(3, 5), pixel_pitch=0.2).cameras()[0]
    rays = camera.rays(torch.tensor([[2.0, 1.0]], dtype=torch.float64)).clip(Box.cube(10.0))
    heading = trace(one_ball(1e-3, (0.0, 0.0, 1.0)), rays, 50)[1]
    assert float(heading[0, 2]) > 1e-5


def test_project_in_chunks_equals_at_once_and_misses_are_zero(cameras, ball, box):
    rays = Rays.concatenate([c.rays(c.pixel_grid().reshape(-1, 2)) for c in cameras]).clip(box)
    model = PathIntegral(MODELS["lever_arm"](), 50)
    got = project(model, ball, rays, chunk=37)
    hit = rays.crosses
    assert 0 < int(hit.sum()) < len(rays)
    assert torch.allclose(got[hit], model(ball, rays[hit]), atol=1e-12)
    assert torch.equal(got[~hit], torch.zeros_like(got[~hit]))


@pytest.mark.parametrize("make", [lambda: PathIntegral(MODELS["lever_arm"](), 0), lambda: CurvedRays(0)])
def test_refusals(make):
    with pytest.raises(InputError, match="expected"):
        make()
