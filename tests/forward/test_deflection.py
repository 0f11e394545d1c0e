"""The models of deflection against closed forms, against each other, and when the whole rig is turned."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from nerif.fields.field import Field
from nerif.fields.phantoms import GaussianBalls
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.ray_tracing import CurvedRays, trace
from nerif.geometry import Box, Camera, Plane, Rays, Ring
from refusals import refused

CUBE = Box((-16.0, -15.0, -14.0), (16.0, 15.0, 14.0))


def model(name: str, samples: int) -> PathIntegral:
    return PathIntegral(MODELS[name](1.0), samples)


def one_ball(amplitude: float, centre: tuple[float, float, float] = (0.3, -0.4, 0.2), width: float = 1.5) -> Field:
    return GaussianBalls(*(torch.tensor(x, dtype=torch.float64) for x in ([centre], [width], [amplitude])))


def rays_of(cameras: tuple[Camera, ...], box: Box, crossing: bool = True) -> Rays:
    rays = Rays.concatenate([c.rays(c.pixel_grid().reshape(-1, 2)) for c in cameras]).clip(box)
    return rays[rays.crosses] if crossing else rays


def test_lever_arm_equals_the_closed_form_of_a_gaussian_ball(cameras):
    """d = S int (s_b - s) grad(n) ds; for a ball the part across the ray integrates to a Gaussian of the miss distance.

    With b the vector from the centre to the nearest point of the ray, at s_0, the transverse gradient is
    -b a / w^2 exp(-b^2 / 2 w^2) exp(-(s - s_0)^2 / 2 w^2), so d = -S b a sqrt(2 pi) / w (s_b - s_0) exp(-b^2 / 2 w^2).
    """
    a, w = -2e-4, 1.5
    rays = rays_of(cameras, CUBE)
    to_centre = torch.tensor([0.3, -0.4, 0.2], dtype=torch.float64) - rays.origin
    s_0 = (to_centre * rays.direction).sum(-1)
    b = s_0[:, None] * rays.direction - to_centre
    size = a * math.sqrt(2 * math.pi) / w * (rays.ends.distance - s_0) * torch.exp(-b.square().sum(-1) / (2 * w * w))
    expected = -torch.einsum("nij,nj->ni", rays.ends.sensitivity, b) * size[:, None]
    clear = (rays.far - rays.near > 20) & ((s_0 - rays.near).minimum(rays.far - s_0) > 9)  # tails inside the box
    assert int(clear.sum()) > 500
    d = model("lever_arm", 400)(one_ball(a, width=w), rays)
    assert float((d - expected)[clear].abs().max()) < 4e-4 * float(expected.abs().max())  # n is 1 to 2e-4


def test_zero_field_has_zero_deflection(cameras, box):
    for projector in (model("lever_arm", 20), model("paraxial", 20), CurvedRays(20)):
        assert float(projector(one_ball(0.0), rays_of(cameras, box)).abs().max()) < 1e-9  # px


@pytest.mark.parametrize(("name", "amplitude", "order"), [("lever_arm", -4e-3, 1.9), ("curved", -1.6e-2, 2.6)])
def test_models_converge_to_curved_rays(cameras, name, amplitude, order):
    """lever_arm is of first order in the field, curved of second: their errors are of the next."""
    rays = rays_of(cameras, CUBE)[::4]
    errors = []
    for a in (amplitude, amplitude / 2, amplitude / 4):
        field = one_ball(a, width=2.5)
        exact = CurvedRays(400, 1.0)(field, rays)
        error, straight = (float((model(m, 400)(field, rays) - exact).norm()) for m in (name, "lever_arm"))
        errors.append(error)
        assert name == "lever_arm" or error < 0.1 * straight
    orders = [math.log2(a / b) for a, b in pairwise(errors)]
    assert all(o > order and (name == "curved" or o < 2.1) for o in orders), (errors, orders)


def test_paraxial_differs_by_the_lever_arm_alone(cameras):
    """For a field thin along the rays and at their middle, one lever arm for the whole ray is exact."""
    rays, differences = rays_of(cameras, CUBE), []
    for x in (0.0, 9.0):
        ball = one_ball(-2e-4, (x, 0.0, 0.0), 0.7)
        lever, paraxial = (model(m, 300)(ball, rays) for m in ("lever_arm", "paraxial"))
        differences.append(float((lever - paraxial).norm() / lever.norm()))
    assert differences[0] < 2e-3
    assert 5e-3 < differences[1] < 5e-2  # 9 mm of a lever arm of 450 mm


def test_turning_rig_and_phantom_together_changes_nothing(cameras, ball, rotation_about):
    turn = rotation_about((0.3, -1.0, 0.5), 0.8)
    turned_ball = GaussianBalls(ball.centres @ turn.T, ball.widths, ball.amplitudes)
    turned = tuple(
        replace(c, rotation=c.rotation @ turn.T, background=Plane(turn @ c.background.normal, c.background.offset))
        for c in cameras
    )
    wide = Box((-20.0, -20.0, -20.0), (20.0, 20.0, 20.0))  # does not turn: the balls are deep inside it both times
    for projector in (model("lever_arm", 300), CurvedRays(200)):
        before = projector(ball, rays_of(cameras, wide, crossing=False)[::4])
        after = projector(turned_ball, rays_of(turned, wide, crossing=False)[::4])
        assert float((before - after).abs().max()) < 1e-5 * float(before.abs().max())


def test_an_oblique_background_has_the_same_order(ball, rotation_about):
    """A background tilted by 30 degrees about its middle: lever_arm still agrees with curved rays."""
    camera = Ring(views=1, arc=(20.0, 20.0), image_size=(18, 24), pixel_pitch=0.11).cameras()[0]
    normal = rotation_about((0.2, 0.5, 1.0), math.radians(30)) @ camera.background.normal
    offset = float(normal @ camera.background.normal) * camera.background.offset
    rays = rays_of((replace(camera, background=Plane(normal, offset)),), CUBE)
    straight, curved = model("lever_arm", 300)(ball, rays), CurvedRays(200)(ball, rays)
    assert float((straight - curved).norm() / curved.norm()) < 4e-4
    upright = model("lever_arm", 300)(ball, rays_of((camera,), CUBE))
    assert float((straight - upright).norm() / upright.norm()) > 2e-3  # the tilt matters


def test_runge_kutta_is_of_fourth_order_and_bends_rays_towards_denser_gas(cameras):
    rays, field = rays_of(cameras[:1], CUBE), one_ball(-5e-2, width=3.0)
    fine = trace(field, rays, 640)[1]
    errors = [float((trace(field, rays, n)[1] - fine).norm()) for n in (20, 40, 80)]
    orders = [math.log2(a / b) for a, b in pairwise(errors)]
    assert min(orders) > 3.7, orders
    camera = Ring(views=1, arc=(0.0, 0.0), image_size=(3, 5), pixel_pitch=0.2).cameras()[0]
    ray = camera.rays(torch.tensor([[2.0, 1.0]], dtype=torch.float64)).clip(Box.cube(10.0))
    heading = trace(one_ball(1e-3, (0.0, 0.0, 1.0)), ray, 50)[1]
    assert float(heading[0, 2]) > 1e-5


def test_projection_in_chunks_equals_that_at_once_and_is_zero_outside_the_box(cameras, ball, box):
    rays, projector = rays_of(cameras, box, crossing=False), model("lever_arm", 50)
    d, crosses = project(projector, ball, rays, chunk=37), rays.crosses
    assert 0 < int(crosses.sum()) < len(rays)
    assert torch.allclose(d[crosses], projector(ball, rays[crosses]), atol=1e-12)
    assert torch.equal(d[~crosses], torch.zeros_like(d[~crosses]))
    with refused("samples"):
        model("lever_arm", 0)
    with refused("steps"):
        CurvedRays(0)
