"""Velocity of an axisymmetric film in the plane through its axis, against another solver and exact solutions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from axisymmetric_plume import GRAVITY, HEIGHT, KAPPA, NU, RADIUS, Plume, plume
from nerif.flow.assimilation import VelocityFit
from nerif.flow.axisymmetric_box import AxisymmetricBox
from nerif.flow.boussinesq import Boussinesq
from nerif.flow.box_domain import BoxDomain, MeridionalPlane, section_of
from nerif.flow.transport import Transport
from nerif.geometry import Box, Grid
from nerif.geometry.symmetry import Symmetry
from refusals import refused

STEP = 0.005  # s


def in_plane(values: np.ndarray, sign: int) -> torch.Tensor:
    """Values on both sides of the axis, (..., z, 1, x)."""
    both = np.concatenate([sign * values[..., ::-1], values], axis=-1)
    return torch.tensor(both, dtype=torch.float32)[..., None, :]


def vectors_in_plane(velocity: np.ndarray) -> torch.Tensor:
    u, w = in_plane(velocity[:, 0], -1), in_plane(velocity[:, 1], 1)
    return torch.stack([u, torch.zeros_like(u), w], dim=1)


def whole_plane(film: Plume) -> Grid:
    return Grid(Box((-RADIUS, -0.5, 0.0), (RADIUS, 0.5, HEIGHT)), (len(film.z), 1, 2 * len(film.r)))


def test_a_bessel_mode_decays_at_its_rate_and_has_its_velocity():
    from scipy.special import j0, j1, jn_zeros

    grid = Grid(Box((-20.0, -1.0, 0.0), (20.0, 1.0, 40.0)), (32, 1, 40))
    box = AxisymmetricBox(grid, margin=0.0)
    x, z = grid.x.numpy()[None, None], grid.z.numpy()[:, None, None]
    k, m = jn_zeros(1, 3)[2] / 20.0, 2 * math.pi * 3 / 40.0
    # curl of J1(k r) cos(m z) e_phi, whose vorticity is (k^2 + m^2) times it
    vorticity = torch.tensor((k**2 + m**2) * j1(k * x) * np.cos(m * z), dtype=torch.float32)
    u, w = m * j1(k * x) * np.sin(m * z), k * j0(k * x) * np.cos(m * z)
    zero = np.zeros_like(u)
    velocity = torch.tensor(np.stack([u, zero, w]), dtype=torch.float32)
    spectrum = box.velocity(torch.stack([torch.zeros_like(vorticity), vorticity, torch.zeros_like(vorticity)]))
    torch.testing.assert_close(box.values(spectrum), velocity, rtol=0, atol=1e-4)
    torch.testing.assert_close(box.values(box.solenoidal(spectrum)), velocity, rtol=0, atol=1e-4)
    decayed = box.values(box.filtered(spectrum, lambda k2: torch.exp(-0.7 * k2)))
    torch.testing.assert_close(decayed, math.exp(-0.7 * (k**2 + m**2)) * velocity, rtol=0, atol=1e-4)
    scalar = torch.tensor(j0(k * x) * np.cos(m * z), dtype=torch.float32)
    gradient = box.gradient(box.spectrum(scalar))
    exact = np.stack([-k * j1(k * x) * np.cos(m * z), zero, -m * j0(k * x) * np.sin(m * z)])
    torch.testing.assert_close(gradient, torch.tensor(exact, dtype=torch.float32), rtol=0, atol=0.02 * k)
    mixed = box.spectrum(gradient) + spectrum
    torch.testing.assert_close(box.values(box.solenoidal(mixed)), velocity, rtol=0, atol=0.03 * k)
    torch.testing.assert_close(box.values(box.potential(mixed)), scalar, rtol=0, atol=0.03)
    inner = (slice(4, -4), slice(None), slice(4, -4))
    laplacian = box.laplacian(scalar, grid)[inner]
    torch.testing.assert_close(laplacian, -(k**2 + m**2) * scalar[inner], rtol=0, atol=0.03 * (k**2 + m**2))


def test_the_shortest_wave_along_the_axis_moves_nothing():
    grid = Grid(Box((-20.0, -1.0, 0.0), (20.0, 1.0, 40.0)), (32, 1, 40))
    box = AxisymmetricBox(grid, margin=0.0)
    alternating = (-1.0) ** torch.arange(32)[:, None, None] * torch.tanh(grid.x.float())
    vorticity = torch.stack([torch.zeros_like(alternating), alternating, torch.zeros_like(alternating)])
    assert float(box.values(box.velocity(vorticity)).abs().max()) < 1e-3
    upwards = torch.stack([0 * alternating, 0 * alternating, alternating.abs() * alternating.sign()])
    assert float(box.values(box.solenoidal(box.spectrum(upwards))).abs().max()) < 1e-3


def test_noise_of_samples_has_the_symmetry_of_the_flow():
    box = AxisymmetricBox(Grid(Box((-20.0, -1.0, 0.0), (20.0, 1.0, 40.0)), (200, 1, 100)), margin=0.0)
    for odd, sign in ((True, -1), (False, 1)):
        noise = box.white((3, *box.shape), odd, torch.Generator().manual_seed(1))
        assert float(noise.std()) == pytest.approx(1, abs=0.02)
        torch.testing.assert_close(noise, sign * noise.flip(-1))


def test_noise_on_the_axis_is_not_that_beside_it():
    grid = Grid(Box((-20.0, -0.5, 0.0), (20.0, 0.5, 40.0)), (40, 1, 40))
    box = AxisymmetricBox(Grid(grid.box, (20, 1, 20)))
    x, _, z = grid.points().unbind(-1)
    puff = 0.1 * torch.exp(-((x / 8) ** 2) - ((z - 20) / 8) ** 2)
    transport = Transport(
        puff.expand(7, -1, -1, -1), grid, [0.01 * k for k in range(7)], torch.zeros(7, 40, 1, 40), box
    )
    size = 1e-3 * (1 + 3 * torch.exp(-((box.grid.x.float() / 3) ** 2)))  # of the noise of a frame
    frames = size * torch.randn(7, *box.grid.shape, generator=torch.Generator().manual_seed(5))
    frames = 0.5**0.5 * (frames + frames.flip(-1))  # even
    evaluated = (box.grid.z < 30)[:, None, None]
    transport.weigh((frames[1:] - frames[:-1]) * evaluated)
    estimate = transport.deviation.square().mean(dim=(0, 1, 2)).sqrt()
    torch.testing.assert_close(estimate, 2**0.5 * size.float(), rtol=0.35, atol=0)


def test_grids_that_have_no_axis_are_refused():
    with refused("grid"):
        AxisymmetricBox(Grid(Box((-10.0, -1.0, 0.0), (20.0, 1.0, 40.0)), (32, 1, 40)))
    with refused("grid"):
        AxisymmetricBox(Grid(Box.cube(20.0), (8, 8, 8)))
    with refused("film"):
        VelocityFit()(torch.zeros(3, 8, 1, 8), Grid(Box.cube(20.0), (8, 1, 8)), [0.0, 0.1, 0.2])


def test_a_plume_is_solved_as_by_finite_differences():
    film = plume(0.5 + STEP * np.arange(11), h=1.25)  # risen to 90 mm
    box = AxisymmetricBox(whole_plane(film), margin=0.0)
    theta, velocity = in_plane(film.theta, 1), vectors_in_plane(film.velocity)
    equations = Boussinesq(box, NU, KAPPA, (0.0, 0.0, -GRAVITY))
    result = equations.solve(box.spectrum(velocity[0]), theta, [STEP] * 10)
    strong = theta[-1] > 0.05 * theta.max()
    strong[film.z < 25] = False  # there heat is added
    error, change = (v[:, strong].norm() for v in (box.values(result[-1]) - velocity[-1], velocity[0] - velocity[-1]))
    assert float(error) < 0.04 * float(change)


def test_the_velocity_of_a_plume_follows_from_its_densities():
    film, part = plume(0.5 + 2 * STEP * np.arange(4), h=2.0), slice(10, 55)
    grid = Grid(Box((-30.0, -0.5, 20.0), (30.0, 0.5, 110.0)), (45, 1, 30))
    theta = in_plane(film.theta[:, part, :15], 1)
    true = vectors_in_plane(film.velocity[:, :, part, :15])
    settings = VelocityFit(
        viscosity=NU, diffusivity=KAPPA, time_limit=0, max_iterations=12, samples=2, sample_iterations=12
    )
    flow = settings(theta, grid, [2 * STEP * k for k in range(4)], box_of=AxisymmetricBox)
    assert flow.deviations is not None
    assert flow.pressure is not None
    plane = MeridionalPlane(grid_in_space(20.0, 110.0), Symmetry.about("axis", (0, 0, 0), (0, 0, 1), 1e-3))
    estimate = torch.stack([plane.vector(v, flow.grid) for v in flow.velocity])
    exact = torch.stack([plane.vector(v, grid) for v in true])
    strong = torch.stack([plane.scalar(t, grid) for t in theta]) > 0.05 * float(theta.max())
    strong = strong[:, None].expand_as(estimate)
    assert float((estimate - exact)[strong].norm() / exact[strong].norm()) < 0.15
    deviations = torch.stack([plane.deviation(v, flow.deviations.grid) for v in flow.deviations.velocity])
    ratio = float((estimate - exact)[strong].norm() / deviations[strong].norm())
    assert 0.2 < ratio < 3


def grid_in_space(low: float, high: float) -> Grid:
    return Grid(Box((-25.0, -25.0, low), (25.0, 25.0, high)), (45, 25, 25))


def test_vectors_of_a_plane_point_away_from_and_along_any_axis():
    film = Grid(Box((-40.0, -20.0, -15.0), (40.0, 20.0, 25.0)), (20, 20, 40))
    symmetry = Symmetry.about("axis", (0.0, 0.0, 5.0), (1.0, 0.0, 0.0), 1e-3)
    plane = section_of(film, symmetry)
    assert isinstance(plane, MeridionalPlane)
    x, _, z = plane.grid.points().unbind(-1)
    assert float(x.max()) < 20
    vectors = plane.vector(torch.stack([x, torch.zeros_like(x), 2 * z]), plane.grid)
    points = film.points()
    inside = (points[..., 1] ** 2 + (points[..., 2] - 5) ** 2).sqrt() < 18
    inside &= points[..., 0].abs() < 36
    expected = torch.stack([2 * points[..., 0], points[..., 1], points[..., 2] - 5])
    torch.testing.assert_close(vectors[:, inside], expected[:, inside], rtol=0, atol=0.3)
    corner = points.abs().amax(dim=(0, 1, 2))
    assert not bool(torch.isfinite(vectors[:, (points.abs() == corner).all(dim=-1)]).any())
    scalar = torch.exp(-((points[..., 1] ** 2 + (points[..., 2] - 5) ** 2) / 60) - (points[..., 0] / 15) ** 2)
    section = plane.of(scalar[None])[0]
    torch.testing.assert_close(section, torch.exp(-(x**2) / 60 - (z / 15) ** 2), rtol=0, atol=0.01)
    back = plane.scalar(section, plane.grid)
    torch.testing.assert_close(back[inside], scalar[inside], rtol=0, atol=0.02)
    mask = plane.mask((x.abs() < 10) & (z > 0), plane.grid)
    r = (points[..., 1] ** 2 + (points[..., 2] - 5) ** 2).sqrt()
    assert float((mask == ((r < 10) & (points[..., 0] > 0))).float().mean()) > 0.97


def test_about_a_tilted_axis_only_what_is_in_the_box_counts():
    film = Grid(Box((-25.0, -25.0, 0.0), (25.0, 25.0, 120.0)), (60, 25, 25))
    lean = math.radians(9.0)
    axis = (math.sin(lean), 0.0, math.cos(lean))
    symmetry = Symmetry.about("axis", (0.0, 0.0, 2.0), axis, 1e-3)
    plane = MeridionalPlane(film, symmetry)
    assert plane.grid.box.upper[2] < 120  # the axis leaves through the top
    r, _, h = symmetry.reduced(film.points()).unbind(-1)
    volume = torch.exp(-((r / 8) ** 2)) * (1 + 0.005 * h)
    x, _, z = plane.grid.points().unbind(-1)
    exact = torch.exp(-((x / 8) ** 2)) * (1 + 0.005 * z)
    assert float((plane.of(volume[None])[0] - exact).abs().max()) < 0.05


def test_gravity_across_the_axis_is_refused():
    film = Grid(Box.cube(40.0), (20, 20, 20))
    plane = MeridionalPlane(film, Symmetry.about("axis", (0, 0, 0), (1.0, 0.0, 0.0), 1e-3))
    with refused("gravity"):
        plane.settings(VelocityFit())
    assert plane.settings(VelocityFit(gravity=(9810.0, 0.0, 0.0))).gravity == pytest.approx((0.0, 0.0, 9810.0))
    plane.settings(VelocityFit(physics="transport"))


def test_only_axisymmetric_flows_have_a_plane():
    film = Grid(Box.cube(40.0), (20, 20, 20))
    for name in ("planar", "axis+1"):
        symmetry = Symmetry.about(name, (0, 0, 0), (0, 0, 1), 1e-3)
        assert type(section_of(film, symmetry)) is BoxDomain
    assert type(section_of(film, None)) is BoxDomain
