"""Phantoms: exact gradients, and a flame that is as hard as it says."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.grid import VoxelField
from nerif.fields.phantoms import FLAME_INTERVAL, Flame, GaussianBalls, Octahedron, make_phantom
from nerif.fields.turbulence import LONGEST, Fire, TurbulentPlume, inertial_scalar
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral
from nerif.geometry import Box, Grid, Rays, paper_rig
from refusals import refused

CUBE = Box.cube(50.0)
SLAB = Box((-20.0, -25.0, -15.0), (24.0, 21.0, 33.0))
PLUME, FIRE = TurbulentPlume(SLAB, 2, shortest=0.1), Fire(SLAB, 2, shortest=0.1)


def voxels() -> VoxelField:
    values = torch.rand(5, 6, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return VoxelField.through(values, Grid(SLAB, (5, 6, 7)))


@pytest.mark.parametrize(
    "field",
    [GaussianBalls.random(SLAB, 3), Flame(SLAB, 2e-4, 1), Octahedron(SLAB), voxels(), PLUME, FIRE],
    ids=["gaussians", "flame", "octahedron", "voxels", "turbulence", "fire"],
)
def test_gradient_is_exact(field):
    unit = torch.rand(4, 50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    points = torch.tensor(SLAB.lower) + 0.5 + unit * (torch.tensor(SLAB.edges) - 1.0)
    points.requires_grad_()
    value, gradient = field.value_and_gradient(points)
    (expected,) = torch.autograd.grad(value.sum(), points)
    assert value.shape == (4, 50)
    assert float(expected.abs().max()) > 0
    assert float((gradient - expected).detach().abs().max()) < 1e-12 * float(expected.abs().max())


def test_voxel_field_passes_through_its_values():
    field = voxels()
    at_centres = field(field.grid.points(torch.float64))
    values = torch.rand(5, 6, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert float((at_centres - values).abs().max()) < 1e-12


def test_voxel_field_is_of_fourth_order():
    """A smooth field sampled twice as finely is met sixteen times as well (by eight at least)."""
    smooth = GaussianBalls(
        torch.tensor([[1.0, -2.0, 9.0]], dtype=torch.float64),
        torch.tensor([5.0], dtype=torch.float64),
        torch.tensor([1.0], dtype=torch.float64),
    )
    points = torch.tensor([1.0, -2.0, 9.0]) + 6 * torch.randn(400, 3, dtype=torch.float64).clamp(-1.5, 1.5)
    errors = []
    for n in (20, 40):
        grid = Grid.of_resolution(SLAB, n)
        field = VoxelField.through(smooth(grid.points(torch.float64)), grid)
        errors.append(float((field(points) - smooth(points)).norm()))
    assert errors[0] / errors[1] > 8


def hardness(flame: Flame, voxels: int = 40, samples: int = 2) -> float:
    """What averaging onto voxels and interpolating back costs, relative to the variation."""
    n = voxels * samples
    fine = flame.sample(Grid(CUBE, (n, n, n)))
    mean = fine.reshape(voxels, samples, voxels, samples, voxels, samples).mean((1, 3, 5))
    back = torch.nn.functional.interpolate(
        mean[None, None], scale_factor=samples, mode="trilinear", align_corners=False
    )[0, 0]
    return float((back - fine).norm() / fine.norm())


@pytest.mark.parametrize("instant", ["2", "7"])
def test_flame_is_as_hard_as_stated(instant):
    flame = make_phantom(instant, CUBE)
    assert isinstance(flame, Flame)
    assert 0.025 < hardness(flame) < 0.04


def test_flame_is_a_flame():
    flame = Flame(CUBE)
    points = Grid(CUBE, (100, 100, 100)).points().reshape(-1, 3)
    value, gradient = flame.value_and_gradient(points)
    contrast = -float(value.min())
    cold, hot = 2.7e-4, 2.7e-4 - contrast
    assert cold / hot >= 5
    assert contrast / float(gradient.norm(dim=1).max()) <= 1.0  # thinnest layer, mm
    wavelengths = 2 * torch.pi / flame.wave_vectors.norm(dim=1)
    assert float(wavelengths.max() / wavelengths.min()) >= 7.999
    core = flame(torch.tensor([[0.0, 0.0, -24.0]]))
    assert float(core.abs()) < 0.02 * contrast  # cold core
    products = flame(torch.tensor([[0.0, 0.0, 20.0]]))
    assert float(products) < -0.95 * contrast


@pytest.mark.parametrize("field", [Flame(CUBE), Flame(CUBE, 5e-4), GaussianBalls.random(CUBE, 3)])
def test_side_faces_are_ambient(field):
    faces = torch.cat([CUBE.face_points(f, torch.rand(2000, 2)) for f in ("x-", "x+", "y-", "y+")])
    assert float(field(faces).abs().max()) < 0.005 * 2.2e-4


def test_flame_is_convected_upward():
    """Shortly after, the outer surface looks most like itself moved up by speed x time."""
    early, late = Flame(CUBE, 0.0), Flame(CUBE, FLAME_INTERVAL)
    k, phases = early.wave_vectors, late.phases - early.phases
    moved = -k[:, 2] * Flame.speed * FLAME_INTERVAL
    drift = phases - moved
    assert float(drift.abs().max()) > 0  # it changes shape, too
    heights = torch.linspace(-15, 10, 60)
    angles = torch.linspace(0, 6.28, 40)
    z, a = torch.meshgrid(heights, angles, indexing="ij")
    surface = torch.stack([13.0 * a.cos(), 13.0 * a.sin(), z], dim=-1)
    expected = Flame.speed * FLAME_INTERVAL
    shifts = [expected * f for f in (-1.0, 0.0, 0.5, 1.0, 1.5, 2.0)]
    errors = []
    for shift in shifts:
        below = surface - torch.tensor([0.0, 0.0, shift])
        errors.append(float((late(surface) - early(below)).norm()))
    assert shifts[errors.index(min(errors))] == expected


def test_flame_moves_the_pixels_by_about_a_fifth():
    cameras, box = paper_rig()
    flame = Flame(box)
    pixels = [c.pixel_grid()[::8, ::8].reshape(-1, 2) for c in cameras]
    rays = Rays.concatenate([c.rays(p) for c, p in zip(cameras, pixels, strict=True)]).clip(box)
    d = PathIntegral(MODELS["lever_arm"](1.00027), 100)(flame, rays[rays.crosses].to(dtype=torch.float32))
    assert 0.15 < float(d.square().mean().sqrt()) < 0.3


def test_gaussians_repeat_by_seed():
    p = torch.rand(30, 3) * 40 - 20
    a, b, c = (GaussianBalls.random(CUBE, s)(p) for s in (3, 3, 4))
    assert torch.equal(a, b)
    assert not torch.equal(a, c)


def test_octahedron_is_the_paper_s():
    octahedron = Octahedron(CUBE, amplitude=1.0)
    unit = 50.0 / 4
    points = unit * torch.tensor([[0, 0, 0], [0.5, 0, 0], [0, -0.5, 0.5], [0, 0, 1.5], [1.0, 1.0, 0]])
    assert octahedron(points).tolist() == pytest.approx([1.5, 1.0, 0.5, 0.0, 0.0])


def test_unknown_phantom_is_refused():
    with refused("phantom"):
        make_phantom("cloud", CUBE)


@pytest.mark.parametrize("asked", [5 / 3, 3.0])
def test_the_scalar_of_turbulence_has_the_spectrum_of_the_inertial_range(asked):
    """Power summed over shells of wave numbers falls as k^-slope within the range, and there is none beyond."""
    scalar = inertial_scalar(CUBE, 0, shortest=0.04, slope=asked)
    values = scalar(scalar.grid.points(torch.float64))
    n = scalar.grid.shape[0]
    assert float(values.mean()) == pytest.approx(0, abs=1e-6)
    assert float(values.std()) == pytest.approx(1, rel=1e-3)
    power = torch.fft.fftn(values).abs().square()
    wave = torch.fft.fftfreq(n, 1 / n)
    k = (wave[:, None, None].square() + wave[:, None].square() + wave.square()).sqrt()
    shells = torch.arange(3, 24)
    found = torch.stack([power[(k >= s - 0.5) & (k < s + 0.5)].sum() for s in shells])
    slope = torch.linalg.lstsq(
        torch.stack([shells.double().log(), torch.ones(len(shells)).double()], dim=1), found.log()[:, None]
    ).solution[0, 0]
    assert float(slope) == pytest.approx(-asked, abs=0.15)
    outside = power[(k > 25.5) | (k < 1 / LONGEST - 0.5)].sum()
    assert float(outside / power.sum()) < 1e-6


def test_turbulent_phantoms_are_hot_inside_and_ambient_at_the_sides():
    for field in (TurbulentPlume(CUBE, 1, shortest=0.08), Fire(CUBE, 1, shortest=0.08)):
        values = field.sample(Grid.of_resolution(CUBE, 40))
        size = float(values.min())
        assert -3.2e-4 < size < -1.4e-4
        assert float(values[:, 0].abs().max()) < 0.01 * -size
        assert float(values[:, :, -1].abs().max()) < 0.01 * -size
    with refused("shortest"):
        inertial_scalar(CUBE, 0, shortest=0.6)
