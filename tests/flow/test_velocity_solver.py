"""The solver of nerif velocity: splines at moving points, the equations of motion, the residual of transport."""

from __future__ import annotations

import math

import pytest
import torch

from nerif.flow.assimilation import VelocityFit
from nerif.flow.boussinesq import Boussinesq
from nerif.flow.frame_resampling import laplacian, smooth
from nerif.flow.interpolation import periodic_spline
from nerif.flow.low_mach import LowMach
from nerif.flow.periodic_box import PeriodicBox
from nerif.flow.transport import Transport
from nerif.flow.velocity_deviations import deviations_of
from nerif.flow.velocity_problem import VelocityProblem, noise_of, resampled
from nerif.geometry import Box, Grid
from refusals import refused

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


@pytest.mark.parametrize("wavelength", [20.0, 10.0, 5.0])
@pytest.mark.parametrize("equations_of", [Boussinesq, LowMach])
def test_buoyancy_and_viscosity_are_of_second_order_in_time(equations_of: type[Boussinesq], wavelength: float):
    # theta = cos kx at rest: w = g cos kx (1 - exp(-nu k^2 t)) / (nu k^2), without pressure or advection
    grid = Grid(Box((0.0, 0.0, 0.0), (wavelength, wavelength, wavelength)), (8, 8, 16))
    box, duration, rate = PeriodicBox(grid, margin=0.0), 0.04, 30.0 * (2 * math.pi / wavelength) ** 2
    theta = 1e-4 * torch.cos(2 * math.pi / wavelength * axes_of(grid)[0])
    exact = 9810.0 * theta * (1 - math.exp(-rate * duration)) / rate
    equations, rest = equations_of(box, 30.0, 0.0, (0.0, 0.0, -9810.0)), torch.zeros(3, *grid.shape)
    errors = []
    for steps in (4, 8):
        film, intervals = theta.expand(steps + 1, -1, -1, -1), [duration / steps] * steps
        u, v, w = box.values(equations.solve(box.spectrum(rest), film, intervals)[-1])
        errors.append(float((w * exact).sum() / exact.square().sum()) - 1)
        assert float(torch.stack([u, v]).abs().max()) < 1e-3 * float(w.max())
    step = rate * duration / 8
    assert errors[1] == pytest.approx(step**2 / 12, rel=0.1, abs=2e-5)  # that of the trapezoidal rule
    assert errors[0] == pytest.approx(4 * errors[1], rel=0.15, abs=2e-5)


def test_the_air_around_rising_fluid_takes_no_part_of_its_momentum():
    # in a closed vessel as much sinks as rises, however long the fluid is accelerated
    box = PeriodicBox(GRID, margin=0.0)
    x, y, z = axes_of(GRID)
    puff = 0.2 * torch.exp(-0.5 * ((x - 20) ** 2 + (y - 20) ** 2 + (z - 20) ** 2) / 9)
    for equations_of in (Boussinesq, LowMach):
        equations, rest = equations_of(box, 30.0, 0.0, (0.0, 0.0, -9810.0)), torch.zeros(3, *GRID.shape)
        w = box.values(equations.solve(box.spectrum(rest), puff.expand(6, -1, -1, -1), [0.01] * 5)[-1])[2]
        assert abs(float(w.mean())) < 1e-3 * float(w.max())


def test_shear_carries_velocity_along():
    # u = U(z) carries v(x - U t, z) without changing it: no pressure, and nothing depends on y
    box = PeriodicBox(GRID, margin=0.0)
    x, _, z = axes_of(GRID)
    shear = 200.0 * torch.cos(WAVE * z)

    def carried(t: float) -> torch.Tensor:
        v = 20.0 * torch.exp(1.5 * (torch.cos(WAVE * (x - shear * t)) + torch.cos(2 * WAVE * z)) - 3.0)
        return torch.stack([shear, v - v.mean(), torch.zeros_like(v)])

    equations = Boussinesq(box, 1e-6, 0.0, (0.0, 0.0, 0.0))
    velocity = equations.solve(box.spectrum(carried(0.0)), torch.zeros(11, *GRID.shape), [0.002] * 10)[-1]
    exact, start = carried(0.02), carried(0.0)
    assert float((box.values(velocity) - exact).norm()) < 0.05 * float((start - exact).norm())


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


PUFF = Grid(Box((0.0, 0.0, 0.0), (60.0, 56.0, 70.0)), (35, 28, 30))
STEP, KAPPA, CARRY = 0.004, 30.0, (60.0, -40.0, 140.0)


def puffs(frames: int) -> torch.Tensor:
    """A puff that moves with CARRY and spreads."""
    x, y, z = axes_of(PUFF)

    def puff(t: float) -> torch.Tensor:
        width = 60.0 + 2 * KAPPA * t  # square of the radius, mm^2
        square = sum((a - c - u * t) ** 2 for a, c, u in zip((x, y, z), (28.0, 30.0, 32.0), CARRY, strict=True))
        return 0.2 * (60.0 / width) ** 1.5 * torch.exp(-0.5 * square / width)

    return torch.stack([puff(STEP * k) for k in range(frames)])


@pytest.mark.parametrize("start", [40.0, 4 * 3600.0, 1.7328e9])
def test_a_late_film_has_the_intervals_of_an_early_one(start: float):
    theta = puffs(3)
    box = PeriodicBox(Grid(PUFF.box, (9, 7, 8)))
    transport = Transport(theta, PUFF, [start + STEP * k for k in range(3)], torch.zeros_like(theta), box)
    torch.testing.assert_close(transport.intervals, torch.full((2,), STEP), rtol=2e-7 * max(start / 1e6, 1), atol=0)


def test_instants_that_do_not_increase_are_refused():
    with refused("film"):
        VelocityFit()(puffs(3), PUFF, [0.0, 0.1, 0.1])


@pytest.mark.parametrize("kind", ["uniform", "grows with the scalar", "smooth", "lasts"])
def test_the_misfit_of_noise_is_1_at_the_true_velocity(kind: str):
    frames = 9
    clean = puffs(frames)
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(8))
    if kind == "grows with the scalar":
        noise *= 0.2 + clean / clean.max()
    elif kind == "smooth":
        noise = 2.4 * smooth(noise, (1.0, 1.0, 1.0))
    elif kind == "lasts":
        for k in range(1, frames):
            noise[k] = 0.6 * noise[k - 1] + 0.8 * noise[k]
    theta, times = clean + 0.01 * noise, [STEP * k for k in range(frames)]
    box = PeriodicBox(Grid(PUFF.box, (18, 14, 15)))
    rate = Boussinesq(box, 0.0, KAPPA, (0.0, 0.0, 0.0)).rate(theta, PUFF)
    transport = Transport(theta, PUFF, times, rate, box, noise_of(theta, PUFF, box.grid))
    residual = transport.residual(torch.tensor(CARRY)[None, :, None, None, None].expand(frames, 3, *box.shape))
    for weighed in (False, True):
        if weighed:
            transport.weigh(residual)
        misfit = float((residual / transport.deviation)[transport.core].square().mean().sqrt())
        if weighed or kind != "grows with the scalar":  # of that the ambient fluid shows nothing
            assert 0.9 < misfit < 1.1
    noisy = transport.sample(torch.Generator().manual_seed(1))
    assert float((noisy / transport.deviation)[transport.core].square().mean().sqrt()) == pytest.approx(1, abs=0.1)
    lag = noisy[:, 1:] * noisy[:, :-1]  # averages of neighbours share voxels
    assert float(lag[transport.core[:, 1:]].mean() / noisy[transport.core].square().mean()) > 0.3


def test_forces_that_stand_for_the_flow_outside_are_no_lack_of_momentum():
    theta, times = puffs(3), [STEP * k for k in range(3)]
    problem = VelocityProblem(VelocityFit(resolution=8), theta, PUFF, times, PeriodicBox(Grid(PUFF.box, (9, 7, 8))))
    controls = torch.randn(3, 3, *problem.box.shape, generator=torch.Generator().manual_seed(0))
    margins = problem.box.margins()
    inside, outside = (problem.flow(controls * part).momentum for part in (1 - margins, margins))
    assert inside is not None
    assert outside is not None
    assert float(outside.norm()) < 0.3 * float(inside.norm())


def test_samples_have_the_weights_of_their_centre(monkeypatch: pytest.MonkeyPatch):
    theta, times = puffs(1).expand(5, -1, -1, -1), [STEP * k for k in range(5)]  # at rest, with noise where it is
    theta = theta + 0.1 * theta * torch.randn(theta.shape, generator=torch.Generator().manual_seed(3))
    settings = VelocityFit(physics="transport", resolution=8)
    problem = VelocityProblem(settings, theta, PUFF, times, PeriodicBox(Grid(PUFF.box, (9, 7, 8))))
    weights = []

    def recorded(problem: VelocityProblem, controls: torch.Tensor, *_: object) -> tuple[torch.Tensor, int]:
        weights.append(problem.transport.deviation)
        return controls, 0

    monkeypatch.setattr("nerif.flow.velocity_deviations.minimise", recorded)
    deviations_of(problem, torch.zeros(5, 3, *problem.box.shape), 2, 1, lambda misfit: 0.0)
    before, *after = weights
    assert len(after) == 3  # the centre and two samples
    assert not torch.equal(before, after[0])
    assert all(torch.equal(after[0], other) for other in after)
