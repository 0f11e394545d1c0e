"""Networks beside bodies: the direction from the surface, and a field that jumps across a thin plate."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bodies import ball, cuboid
from nerif.fields.field import Field
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Box, Grid, Ring
from nerif.geometry.body import contained, from_surface
from nerif.imaging.bodies import with_bodies
from nerif.reconstruction.neural.presets import preset
from nerif.simulation.simulate import simulate

BOX = Box.cube(40.0)
PLATE = cuboid((-10.0, -8.0, -0.25), (10.0, 8.0, 0.25), name="plate")
SHAPE = NetworkShape(depth=2, width=16, octaves=2)


def points_near(count: int = 4000) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5) * torch.tensor([30.0, 26.0, 8.0])
    return points[~contained([PLATE], points)]


def test_the_direction_fades_and_points_away_from_both_sides():
    above, below = torch.tensor([[1.0, 2.0, 0.3]]), torch.tensor([[1.0, 2.0, -0.3]])
    far = torch.tensor([[1.0, 2.0, 4.3]])
    up, _ = from_surface([PLATE], above, 4.0)
    down, _ = from_surface([PLATE], below, 4.0)
    torch.testing.assert_close(up, torch.tensor([[0.0, 0.0, 1.0]]), atol=1e-3, rtol=0)
    torch.testing.assert_close(down, -up)
    assert not bool(from_surface([PLATE], far, 4.0)[0].any())
    on = torch.tensor([[1.0, 2.0, 0.25], [1.0, 2.0, -0.25]], dtype=torch.float64)
    torch.testing.assert_close(from_surface([PLATE], on, 4.0)[0], torch.cat([up, down]).double(), atol=1e-3, rtol=0)
    middle, _ = from_surface([PLATE], torch.tensor([[0.0, 0.0, 2.25]]), 4.0)
    assert float(middle[0, 2]) == pytest.approx((1 - 0.25) ** 2)


@pytest.mark.parametrize("body", [PLATE, ball(6.0)], ids=["plate", "ball"])
def test_its_derivative_is_that_of_differences(body):
    points = points_near(2000)
    points = points[~contained([body], points)]
    step, reach = 1e-6, 5.0
    v, slope = from_surface([body], points, reach)
    assert bool(v.any())
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        a, b = (from_surface([body], points + sign * shift, reach)[0] for sign in (1, -1))
        error = ((a - b) / (2 * step) - slope[:, :, axis]).norm(dim=-1)
        # beside the border between a face and an edge the two differ
        assert float((error > 1e-4).double().mean()) < 0.01


def test_the_nearest_of_several_bodies_counts():
    other = cuboid((-10.0, -8.0, 5.75), (10.0, 8.0, 6.25))
    points = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 5.0]])
    v, _ = from_surface([PLATE, other], points, 4.0)
    assert float(v[0, 2]) > 0 > float(v[1, 2])


class Sides(Field):
    """A field that is of opposite sign on the two sides of the plate, and continuous around its edges."""

    def value_and_gradient(self, points):
        with torch.enable_grad():
            p = points.detach().double().reshape(-1, 3).clone().requires_grad_()
            x, y, z = p.unbind(-1)
            span = (1 - (x / 10) ** 2).clamp_min(0) * (1 - (y / 8) ** 2).clamp_min(0)
            value = 2e-5 * torch.sign(z) * span**2 * torch.exp(-((z / 4) ** 2))
            (gradient,) = torch.autograd.grad(value.sum(), p)
        return value.detach().to(points).reshape(points.shape[:-1]), gradient.to(points).reshape(points.shape)


@pytest.mark.slow
def test_the_two_sides_of_a_thin_plate_are_independent():
    rig = Ring(views=7, arc=(0.0, 155.0), image_size=(64, 64), pixel_pitch=4.0 / 64)
    measurement = with_bodies(simulate(Sides(), rig.cameras(), BOX, 1.00027, 0.05, seed=3), [PLATE])
    result = replace(preset("fast"), max_steps=400, device="cpu")(measurement)
    grid = Grid.of_resolution(BOX, 64)
    points = grid.points().reshape(-1, 3)
    points = points[~contained([PLATE], points)]
    truth = Sides()(points)
    assert float((result.field(points) - truth).norm() / truth.norm()) < 0.06
    above = torch.tensor([[2.0, 1.0, 0.3], [-4.0, 3.0, 0.3]])
    below = above * torch.tensor([1.0, 1.0, -1.0])
    for side in (above, below):
        torch.testing.assert_close(result.field(side), Sides()(side), atol=1e-6, rtol=0.1)
