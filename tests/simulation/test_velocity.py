"""The vortex ring, and velocities from two volumes."""

from __future__ import annotations

import math

import pytest
import torch

import nerif
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid
from nerif.simulation.particles.cloud import Particles
from nerif.simulation.particles.particle_velocity import velocity_between, write_velocities
from nerif.simulation.particles.ring import VortexRing
from refusals import refused

RING = VortexRing(radius=4.0, core=1.2, circulation=300.0, centre=(0.5, -1.0, 2.0))
BOX = Box((-1.6, -2.4, -2.0), (1.6, 2.4, 2.0))
GRID = Grid(BOX, (40, 48, 32))


def test_velocity_on_the_axis_is_that_of_biot_and_savart():
    z = torch.linspace(-9, 9, 13).double()
    points = torch.stack([torch.zeros_like(z), torch.zeros_like(z), z], dim=1) + torch.tensor(RING.centre)
    far = (z**2 + RING.radius**2).sqrt()
    s = far / RING.core
    blurred = torch.erf(s / math.sqrt(2)) - math.sqrt(2 / math.pi) * s * torch.exp(-(s**2) / 2)
    velocity = RING.velocity(points)
    expected = RING.circulation * RING.radius**2 / (2 * far**3) * blurred
    torch.testing.assert_close(velocity[:, 2], expected, rtol=1e-9, atol=0)
    assert float(velocity[:, :2].abs().max()) < 1e-9


def test_the_ring_is_free_of_divergence_and_at_rest_far_away():
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(200, 3, generator=generator, dtype=torch.float64) - 0.5) * 14
    points = torch.cat([points, torch.tensor([[4.5, -1.0, 2.0]]).double()])  # and the middle of the core
    h = 1e-4
    jacobian = torch.stack(
        [(RING.velocity(points + h * e) - RING.velocity(points - h * e)) / (2 * h) for e in torch.eye(3).double()]
    )
    divergence = jacobian.diagonal(dim1=0, dim2=2).sum(dim=-1)
    assert float(divergence.abs().max()) < 1e-6 * float(jacobian.abs().max())
    away = torch.tensor([[300.0, 200.0, -400.0]]).double()
    assert float(RING.velocity(away).norm()) < 1e-4 * float(RING.velocity(torch.tensor([RING.centre])).norm())
    ratio = RING.velocity(2 * away).norm() / RING.velocity(away).norm()
    assert float(ratio) == pytest.approx(1 / 8, rel=0.02)


def test_a_ring_within_a_box_has_the_largest_speed():
    ring = VortexRing.within(BOX, speed=70.0)
    points = Grid(BOX, (41, 49, 33)).points().reshape(-1, 3)
    assert float(ring.velocity(points).norm(dim=1).max()) == pytest.approx(70.0, rel=0.02)


def test_particles_move_with_the_ring_and_back():
    cloud = Particles.draw(Box.cube(40.0), 50, seed=1)
    inside = cloud.moved_to(cloud.positions / 4)
    there = RING.advect(inside, 0.02)
    back = RING.advect(there, -0.02)
    assert float((there.positions - inside.positions).norm(dim=1).max()) > 0.5
    assert float((back.positions - inside.positions).abs().max()) < 1e-4
    finer = RING.advect(inside, 0.02, steps=64)
    assert float((there.positions - finer.positions).abs().max()) < 1e-4


def shifted(shift: tuple[float, float, float]) -> tuple[Volume, Volume]:
    """A volume of particles, and the same moved by a number of voxels along x, y, z."""
    cloud = Particles.draw(Box.cube(8.0), 20_000, seed=2)
    moved = Particles(cloud.positions + 0.1 * torch.tensor(shift), cloud.brightness, cloud.box)
    return cloud.volume(GRID), moved.volume(GRID)


def test_velocity_of_a_shift():
    shift = (1.3, -2.6, 0.7)
    velocity = velocity_between(*shifted(shift), seconds=0.002, window=16, passes=3)
    assert velocity.points.shape == velocity.values.shape == (7, 9, 5, 3)
    torch.testing.assert_close(velocity.points[0, 0, 0], torch.tensor(BOX.lower).double() + 0.8)
    torch.testing.assert_close(velocity.points[-1, -1, -1], torch.tensor(BOX.upper).double() - 0.8)
    assert velocity.valid.all()
    expected = 0.1 * torch.tensor(shift).double() / 0.002
    assert velocity.rms_error(expected.expand_as(velocity.points)) < 0.05 * 0.1
    error = velocity.displacement / 0.1 - torch.tensor(shift)
    assert float(error.mean(dim=(0, 1, 2)).abs().max()) < 0.02


def test_the_velocity_is_that_halfway():
    """In a rotation a one-sided difference points inward, by (1 - cos 0.2) = 0.02 of the radius."""
    cloud = Particles.draw(Box.cube(8.0), 20_000, seed=2)
    c, s = math.cos(0.1), math.sin(0.1)
    turn = torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]]).double()
    start, end = (Particles(cloud.positions @ t.T, cloud.brightness, cloud.box).volume(GRID) for t in (turn.T, turn))
    velocity = velocity_between(start, end, seconds=1.0, window=12, passes=3)
    inner = velocity.valid & (velocity.points[..., 1:].norm(dim=-1) < 1.5)
    _, y, z = velocity.points[inner].unbind(-1)
    _, v, w = velocity.values[inner].unbind(-1)
    size = (y**2 + z**2).sum()
    assert float((y * v + z * w).sum() / size) == pytest.approx(0, abs=0.005)
    assert float((y * w - z * v).sum() / size) == pytest.approx(2 * math.tan(0.1), abs=0.005)


def test_where_there_are_no_particles_there_is_no_velocity():
    first, second = shifted((0.5, 0.0, 0.0))
    for volume in (first, second):
        volume.values[:, 24:] = 0
    velocity = velocity_between(first, second, seconds=1.0, window=12, passes=2)
    dark = velocity.points[..., 1] > 0.8
    assert velocity.displacement[dark].isnan().all()
    assert float(velocity.valid[velocity.points[..., 1] < -0.5].double().mean()) > 0.95


def empty(grid: Grid) -> Volume:
    return Volume(torch.zeros(grid.shape), grid)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: VortexRing(0.0, 1.0, 1.0), "radius"),
        (lambda: VortexRing(4.0, 0.1, 1.0), "core"),
        (lambda: RING.advect(Particles.draw(BOX, 2), 1.0, steps=0), "steps"),
        (lambda: velocity_between(empty(GRID), empty(GRID), 0.0), "seconds"),
        (lambda: velocity_between(empty(GRID), empty(Grid(BOX, (4, 4, 4))), 1.0), "second"),
        (lambda: velocity_between(*[empty(Grid(BOX, (40, 48, 16)))] * 2, 1.0), "grid"),
        (lambda: velocity_between(empty(GRID), empty(GRID), 1.0, window=33), "window"),
        (lambda: velocity_between(empty(GRID), empty(GRID), 1.0, 16, passes=0), "passes"),
    ],
)
def test_invalid_input(call, field):
    with refused(field):
        call()


def test_velocities_over_time_are_written_for_movies_and_the_app(tmp_path):
    pytest.importorskip("zarr", reason="velocities are stored by zarr (the extra `sequence`)")
    velocity = velocity_between(*shifted((1.0, -0.5, 2.0)), seconds=0.002, window=16, passes=2)
    store = write_velocities(tmp_path / "v.zarr", [velocity, velocity], (0.0, 0.002))
    assert store.times == (0.0, 0.002)
    torch.testing.assert_close(store.vectors(1).double(), 1e-3 * velocity.values.movedim(-1, 0), rtol=1e-5, atol=1e-6,
                               equal_nan=True)  # fmt: skip
    torch.testing.assert_close(store.grid.points(torch.float64), velocity.points, rtol=0, atol=1e-6)
    assert nerif.read(tmp_path / "v.zarr").volume(0, "speed").unit == "m s-1"
    with refused(tmp_path / "v.zarr"):
        write_velocities(tmp_path / "v.zarr", [velocity], (0.0,))
    with refused("times"):
        write_velocities(tmp_path / "w.zarr", [velocity], (0.0, 1.0))
