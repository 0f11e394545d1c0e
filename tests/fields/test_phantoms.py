"""Phantoms: exact gradients, and the properties of the flame and of turbulence."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nerif.fields.phantoms import FLAME_INTERVAL, Flame, GaussianBalls, Octahedron, make_phantom
from nerif.fields.turbulence import LONGEST, Fire, TurbulentPlume, inertial_scalar
from nerif.fields.voxel_field import VoxelField
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral
from nerif.geometry import Box, Grid, Rays, paper_rig
from refusals import refused

CUBE = Box.cube(50.0)
SLAB = Box((-20.0, -25.0, -15.0), (24.0, 21.0, 33.0))
PLUME, FIRE = TurbulentPlume(SLAB, 2, shortest=0.1), Fire(SLAB, 2, shortest=0.1)


def test_voxel_fields_are_of_fourth_order():
    """Half the spacing reduces the error of a smooth field by 16 (at least 8)."""
    centre = torch.tensor([[1.0, -2.0, 9.0]], dtype=torch.float64)
    smooth = GaussianBalls(centre, *(torch.tensor([x], dtype=torch.float64) for x in (5.0, 1.0)))
    points, errors = centre + 6 * torch.randn(400, 3, dtype=torch.float64).clamp(-1.5, 1.5), []
    for n in (20, 40):
        grid = Grid.of_resolution(SLAB, n)
        field = VoxelField.through(smooth(grid.points(torch.float64)), grid)
        errors.append(float((field(points) - smooth(points)).norm()))
    assert errors[0] / errors[1] > 8


@pytest.mark.parametrize("instant", ["2", "7"])
def test_averaging_onto_voxels_and_interpolating_back_costs_a_few_per_cent_of_the_flame(instant):
    flame = make_phantom(instant, CUBE)
    assert isinstance(flame, Flame)
    fine = flame.sample(Grid(CUBE, (80, 80, 80)))[None, None]
    mean = torch.nn.functional.avg_pool3d(fine, 2)
    back = torch.nn.functional.interpolate(mean, scale_factor=2, mode="trilinear", align_corners=False)
    assert 0.025 < float((back - fine).norm() / fine.norm()) < 0.04


def test_flame_has_a_cold_core_hot_products_and_thin_layers():
    flame = Flame(CUBE)
    value, gradient = flame.value_and_gradient(Grid(CUBE, (100, 100, 100)).points().reshape(-1, 3))
    contrast = -float(value.min())
    assert 2.7e-4 / (2.7e-4 - contrast) >= 5  # ratio of densities
    assert contrast / float(gradient.norm(dim=1).max()) <= 1.0  # thinnest layer, mm
    wavelengths = 2 * torch.pi / flame.wave_vectors.norm(dim=1)
    assert float(wavelengths.max() / wavelengths.min()) >= 7.999
    core, products = flame(torch.tensor([[0.0, 0.0, -24.0], [0.0, 0.0, 20.0]])).tolist()
    assert abs(core) < 0.02 * contrast
    assert products < -0.95 * contrast


@pytest.mark.parametrize("field", [Flame(CUBE), Flame(CUBE, 5e-4), GaussianBalls.random(CUBE, 3)])
def test_side_faces_are_ambient(field):
    faces = torch.cat([CUBE.face_points(f, torch.rand(2000, 2)) for f in ("x-", "x+", "y-", "y+")])
    assert float(field(faces).abs().max()) < 0.005 * 2.2e-4


def test_flame_is_convected_upward():
    """Shortly after, the outer surface is most similar to itself shifted by speed x time, and differs from it."""
    early, late = Flame(CUBE, 0.0), Flame(CUBE, FLAME_INTERVAL)
    z, a = torch.meshgrid(torch.linspace(-15, 10, 60), torch.linspace(0, 6.28, 40), indexing="ij")
    surface = torch.stack([13.0 * a.cos(), 13.0 * a.sin(), z], dim=-1)
    up = torch.tensor([0.0, 0.0, Flame.speed * FLAME_INTERVAL])
    errors = {f: float((late(surface) - early(surface - f * up)).norm()) for f in (-1.0, 0.0, 0.5, 1.0, 1.5, 2.0)}
    assert min(errors, key=errors.get) == 1.0
    assert errors[1.0] > 0


def test_flame_displaces_the_pixels_by_about_a_fifth():
    cameras, box = paper_rig()
    flame = Flame(box)
    pixels = [c.pixel_grid()[::8, ::8].reshape(-1, 2) for c in cameras]
    rays = Rays.concatenate([c.rays(p) for c, p in zip(cameras, pixels, strict=True)]).clip(box)
    d = PathIntegral(MODELS["lever_arm"](1.00027), 100)(flame, rays[rays.crosses].to(dtype=torch.float32))
    assert 0.15 < float(d.square().mean().sqrt()) < 0.3


def test_gaussians_depend_on_the_seed_only():
    p = torch.rand(30, 3) * 40 - 20
    a, b, c = (GaussianBalls.random(CUBE, s)(p) for s in (3, 3, 4))
    assert torch.equal(a, b)
    assert not torch.equal(a, c)


def test_octahedron_is_the_paper_s():
    octahedron = Octahedron(CUBE, amplitude=1.0)
    unit = 50.0 / 4
    points = unit * torch.tensor([[0, 0, 0], [0.5, 0, 0], [0, -0.5, 0.5], [0, 0, 1.5], [1.0, 1.0, 0]])
    assert octahedron(points).tolist() == pytest.approx([1.5, 1.0, 0.5, 0.0, 0.0])


def test_unknown_phantoms_and_empty_spectra_are_refused():
    with refused("phantom"):
        make_phantom("cloud", CUBE)
    with refused("shortest"):
        inertial_scalar(CUBE, 0, shortest=0.6)


@pytest.mark.parametrize("exponent", [5 / 3, 3.0])
def test_the_scalar_of_turbulence_has_the_spectrum_of_the_inertial_range(exponent):
    """Power summed over shells of wave numbers falls as k^-slope within the range, and there is none beyond."""
    scalar = inertial_scalar(CUBE, 0, shortest=0.04, slope=exponent)
    values = scalar(scalar.grid.points(torch.float64))
    n = scalar.grid.shape[0]
    assert float(values.mean()) == pytest.approx(0, abs=1e-6)
    assert float(values.std()) == pytest.approx(1, rel=1e-3)
    power = torch.fft.fftn(values).abs().square()
    wave = torch.fft.fftfreq(n, 1 / n)
    k = (wave[:, None, None].square() + wave[:, None].square() + wave.square()).sqrt()
    shells = torch.arange(3, 24)
    energy = torch.stack([power[(k >= s - 0.5) & (k < s + 0.5)].sum() for s in shells])
    slope = np.polyfit(shells.log(), energy.log(), 1)[0]
    assert slope == pytest.approx(-exponent, abs=0.15)
    outside = power[(k > 25.5) | (k < 1 / LONGEST - 0.5)].sum()
    assert float(outside / power.sum()) < 1e-6


@pytest.mark.parametrize("kind", [TurbulentPlume, Fire])
def test_turbulent_phantoms_are_hot_inside_and_ambient_at_the_sides(kind):
    values = kind(CUBE, 1, shortest=0.08).sample(Grid.of_resolution(CUBE, 40))
    size = float(values.min())
    assert -3.2e-4 < size < -1.4e-4
    assert max(float(side.abs().max()) for side in (values[:, 0], values[:, :, -1])) < 0.01 * -size
