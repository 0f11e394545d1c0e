"""The solver of nerif velocity: splines at moving points, the equations of motion, the residual of transport."""

from __future__ import annotations

import math

import pytest
import torch

from nerif.geometry import Box, Grid
from nerif.reconstruction.velocity.boussinesq import Boussinesq
from nerif.reconstruction.velocity.interpolation import periodic_spline
from nerif.reconstruction.velocity.periodic_box import PeriodicBox
from nerif.reconstruction.velocity.problem import resampled
from nerif.reconstruction.velocity.resampling import laplacian
from nerif.reconstruction.velocity.transport import Transport

EDGE = 40.0
GRID = Grid(Box((0.0, 0.0, 0.0), (EDGE, EDGE, EDGE)), (32, 32, 32))
WAVE = 2 * math.pi / EDGE


def axes_of(grid: Grid) -> tuple[torch.Tensor, ...]:
    """Coordinates x, y, z of the voxels."""
    return grid.points(torch.float32).unbind(-1)


def test_splines_have_the_derivatives_of_finite_differences():
    generator = torch.Generator().manual_seed(3)
    coefficients = torch.randn(2, 5, 6, 7, generator=generator).requires_grad_()
    points = (20 * torch.rand(9, 3, generator=generator) - 7).requires_grad_()  # also beyond the period
    weights = torch.randn(2, 9, generator=generator)
    (periodic_spline(coefficients, points) * weights).sum().backward()
    step = 1e-2
    for variable in (coefficients, points):
        assert variable.grad is not None
        for at in (0, 4, 11):
            shift = torch.zeros_like(variable).reshape(-1)
            shift[at] = step
            ends = []
            for sign in (1, -1):
                moved = (variable + sign * shift.reshape(variable.shape)).detach()
                both = (moved, points) if variable is coefficients else (coefficients, moved)
                ends.append(float((periodic_spline(*both) * weights).sum().detach()))
            assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(float(variable.grad.reshape(-1)[at]), abs=2e-3)


def test_vorticity_gives_the_velocity_and_nothing_diverges():
    box = PeriodicBox(GRID, margin=0.0)
    x, y, z = axes_of(GRID)
    # (sin ky, sin kz, sin kx) has the vorticity (-k cos kz, -k cos kx, -k cos ky)
    velocity = torch.stack([torch.sin(WAVE * y), torch.sin(WAVE * z), torch.sin(WAVE * x)])
    vorticity = -WAVE * torch.stack([torch.cos(WAVE * z), torch.cos(WAVE * x), torch.cos(WAVE * y)])
    torch.testing.assert_close(box.values(box.velocity(vorticity)), velocity, atol=1e-5, rtol=0)
    any_field = torch.randn(3, *GRID.shape, generator=torch.Generator().manual_seed(0))
    spectrum = box.solenoidal(box.spectrum(any_field))
    assert float((box.wave * spectrum).sum(dim=0).abs().max()) < 1e-3 * float(spectrum.abs().max())


@pytest.mark.parametrize("steps", [10, 20])
def test_a_beltrami_flow_decays_by_viscosity_alone(steps: int):
    # Arnold, Beltrami and Childress: u . grad u is a gradient, so that u ~ exp(-nu k^2 t) exactly
    box = PeriodicBox(GRID, margin=0.0)
    x, y, z = (WAVE * a for a in axes_of(GRID))
    start = 100.0 * torch.stack([
        torch.sin(z) + 0.7 * torch.cos(y), 0.4 * torch.sin(x) + torch.cos(z), 0.7 * torch.sin(y) + 0.4 * torch.cos(x),
    ])  # fmt: skip
    viscosity, seconds = 30.0, 0.1
    equations = Boussinesq(box, viscosity, 0.0, (0.0, 0.0, -9810.0))
    calm = torch.zeros(GRID.shape)
    velocity = box.spectrum(start)
    velocity = equations.solve(velocity, calm.expand(steps + 1, -1, -1, -1), [seconds / steps] * steps)[-1]
    exact = start * math.exp(-viscosity * WAVE**2 * seconds)
    error = float((box.values(velocity) - exact).norm() / exact.norm())
    assert error < 4e-3 * (10 / steps) ** 1.8


def test_buoyancy_accelerates_light_fluid_upwards():
    # theta = cos kx at rest: w = g cos kx (1 - exp(-nu k^2 t)) / (nu k^2), without pressure or advection
    box = PeriodicBox(GRID, margin=0.0)
    theta = 0.01 * torch.cos(WAVE * axes_of(GRID)[0])
    equations, seconds = Boussinesq(box, 30.0, 0.0, (0.0, 0.0, -9810.0)), 0.002
    velocity = torch.zeros_like(box.spectrum(torch.zeros(3, *GRID.shape)))
    velocity = equations.solve(velocity, theta.expand(21, -1, -1, -1), [seconds] * 20)[-1]
    rate = 30.0 * WAVE**2
    exact = 9810.0 * theta * (1 - math.exp(-rate * 20 * seconds)) / rate
    u, v, w = box.values(velocity)
    torch.testing.assert_close(w, exact, atol=2e-3 * float(exact.max()), rtol=0)
    assert float(torch.stack([u, v]).abs().max()) < 1e-3 * float(w.max())


def test_vortices_move_with_the_mean_flow():
    box = PeriodicBox(GRID, margin=0.0)
    x, _, z = axes_of(GRID)

    def vortex(shift: float) -> torch.Tensor:
        # stream function exp(cos kx + cos kz): a vortex in the plane of x and z, carried along y by nothing
        psi = torch.exp(1.5 * (torch.cos(WAVE * (x - shift)) + torch.cos(WAVE * z)) - 3.0)
        dx, dz = -1.5 * WAVE * torch.sin(WAVE * (x - shift)) * psi, -1.5 * WAVE * torch.sin(WAVE * z) * psi
        return 20.0 * torch.stack([-dz, torch.zeros_like(dx), dx])

    mean = torch.tensor([200.0, 0.0, 0.0])[:, None, None, None]
    equations, velocity = Boussinesq(box, 1e-6, 0.0, (0.0, 0.0, 0.0)), box.spectrum(vortex(0.0) + mean)
    velocity = equations.solve(velocity, torch.zeros(21, *GRID.shape), [0.002] * 20)[-1]
    moved = box.values(velocity) - mean
    exact, start = vortex(8.0), vortex(0.0)  # mm, after 40 ms
    assert float((moved - exact).norm()) < 0.15 * float((start - exact).norm())


def test_the_laplacian_is_that_of_a_wave():
    x, y, z = axes_of(GRID)
    wave = torch.sin(WAVE * x) * torch.cos(2 * WAVE * y) * torch.sin(WAVE * z)
    inner = slice(4, -4)
    exact = -6 * WAVE**2 * wave
    result = laplacian(wave, GRID.spacing[::-1])
    torch.testing.assert_close(
        result[inner, inner, inner], exact[inner, inner, inner], atol=2e-3 * float(exact.abs().max()), rtol=0
    )


@pytest.mark.parametrize("velocity", [(300.0, -150.0, 450.0), (0.0, 0.0, 0.0)])
def test_transport_leaves_no_residual_of_a_puff_that_moves_and_spreads(velocity: tuple[float, float, float]):
    x, y, z = axes_of(GRID)
    kappa, interval, times = 30.0, 0.004, (0.0, 0.004, 0.008)

    def puff(t: float) -> torch.Tensor:
        width = 18.0 + 2 * kappa * t  # square of the radius, mm^2
        square = sum((a - 18.0 - u * t) ** 2 for a, u in zip((x, y, z), velocity, strict=True))
        return 0.2 * (18.0 / width) ** 1.5 * torch.exp(-0.5 * square / width)

    film = torch.stack([puff(t) for t in times])
    box = PeriodicBox(Grid(GRID.box, (16, 16, 16)))
    transport = Transport(film, GRID, times, Boussinesq(box, 0.0, kappa, (0.0, 0.0, 0.0)).rate(film, GRID), box)
    uniform = torch.tensor(velocity)[None, :, None, None, None].expand(3, 3, *box.shape)
    change = transport.coarse(film[1:] - film[:-1])
    moving = float(torch.tensor(velocity).norm()) * interval > 1
    size = float(change.norm()) if moving else float(film.norm())
    assert float(transport.residual(uniform).norm()) < 0.01 * size
    if moving:
        still = torch.zeros_like(uniform)
        assert float(transport.residual(still).norm()) > 0.9 * size
        assert bool(transport.region.any())
        assert not bool(transport.region.all())


@pytest.mark.parametrize("shapes", [((20, 16, 15), (30, 24, 22)), ((30, 24, 22), (15, 12, 11))])
def test_controls_on_another_grid_stay_in_place(shapes: tuple[tuple[int, int, int], tuple[int, int, int]]):
    box = Box((0.0, 0.0, 0.0), (75.0, 80.0, 100.0))
    before, after = (PeriodicBox(Grid(box, shape)) for shape in shapes)
    centre = torch.tensor([30.0, 55.0, 70.0])

    def blob(grid: Grid) -> torch.Tensor:
        return torch.exp(-0.5 * ((grid.points(torch.float32) - centre) / 9.0).square().sum(dim=-1))

    values = before.extended(blob(before.grid))[None, None].expand(1, 3, *before.shape)
    moved = after.inside(resampled(values, before, after))[0, 0]
    scale = (math.prod(after.spacing) / math.prod(before.spacing)) ** 0.5
    expected = scale * blob(after.grid)
    assert float((moved - expected).norm() / expected.norm()) < 0.25
    weights = moved / moved.sum()
    points = after.grid.points(torch.float32)
    torch.testing.assert_close((weights[..., None] * points).sum(dim=(0, 1, 2)), centre, rtol=0, atol=0.5)
