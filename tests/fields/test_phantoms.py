"""Phantoms: ambient sides, and the properties of flame, turbulence and axisymmetric flows."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nerif.fields.jets import AXISYMMETRIC
from nerif.fields.phantoms import FLAME_INTERVAL, Flame, GaussianBalls, Octahedron, make_phantom
from nerif.fields.turbulence import LONGEST, Fire, TurbulentPlume, inertial_scalar
from nerif.fields.voxel_field import VoxelField
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral
from nerif.geometry import Box, Grid, Rays, paper_rig
from refusals import refused

CUBE = Box.cube(50.0)
SLAB = Box((-20.0, -25.0, -15.0), (24.0, 21.0, 33.0))


def points(box: Box, count: int = 2000) -> torch.Tensor:
    """Points in the middle three quarters, at all heights."""
    unit = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5
    share = torch.tensor([0.75, 0.75, 1.0], dtype=torch.float64)
    return torch.tensor(box.centre, dtype=torch.float64) + unit * share * torch.tensor(box.edges, dtype=torch.float64)


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


@pytest.mark.parametrize("box", [CUBE, SLAB], ids=["cube", "slab"])
@pytest.mark.parametrize("name", [*AXISYMMETRIC, "gaussians", "flame"])
def test_side_faces_are_ambient(name, box):
    field, places = make_phantom(name, box, 3), torch.rand(5000, 2, generator=torch.Generator().manual_seed(0))
    faces = torch.cat([box.face_points(f, places) for f in ("x-", "x+", "y-", "y+")])
    least = 1e-4 if name in AXISYMMETRIC else 0.005
    assert float(field(faces).abs().max()) < least * float(field(points(box)).abs().max())


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


# -- axisymmetric ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", AXISYMMETRIC)
def test_rotation_about_the_axis_changes_nothing(name, rotation_about):
    field, p, turn = make_phantom(name, SLAB), points(SLAB), rotation_about((0.0, 0.0, 1.0), 1.1)
    centre = torch.tensor(SLAB.centre, dtype=torch.float64)
    value, gradient = field.value_and_gradient(p)
    turned, slope = field.value_and_gradient((p - centre) @ turn.T + centre)
    assert float((turned - value).abs().max()) < 1e-12 * float(value.abs().max())
    assert float((slope - gradient @ turn.T).abs().max()) < 1e-11 * float(gradient.abs().max())


@pytest.mark.parametrize("name", AXISYMMETRIC)
def test_fields_are_smooth_on_the_axis(name):
    """The transverse gradient is proportional to the distance."""
    field = make_phantom(name, CUBE)
    heights = torch.linspace(-24.9, 24.9, 400, dtype=torch.float64)
    axis = torch.stack([torch.zeros_like(heights), torch.zeros_like(heights), heights], dim=-1)
    value, gradient = field.value_and_gradient(axis)
    assert bool(value.isfinite().all())
    assert float(gradient[:, :2].abs().max()) == 0
    shift = torch.tensor([1e-4, 0.0, 0.0], dtype=torch.float64)
    near, twice = (field.gradient(axis + k * shift)[:, 0] for k in (1, 2))
    steepest = float(field.gradient(points(CUBE)).norm(dim=-1).max())
    assert float((twice - 2 * near).abs().max()) < 1e-4 * float(twice.abs().max()) + 1e-9 * steepest


@pytest.mark.parametrize("name", AXISYMMETRIC)
def test_values_are_those_of_a_gas(name):
    values = make_phantom(name, CUBE).sample(Grid.of_resolution(CUBE, 80))
    assert -2.3e-4 < float(values.min()) < -0.7e-4
    low, high = (1.2e-4, 2.0e-4) if name == "underexpanded" else (-1e-9, 0.0)
    assert low < float(values.max()) <= high


def test_shock_cells_repeat_along_the_axis():
    """Fronts, where the index rises steeply upward, are a cell apart."""
    field = make_phantom("underexpanded", CUBE)
    z = torch.linspace(-25, 25, 5001, dtype=torch.float64)
    slope = field.gradient(torch.stack([torch.zeros_like(z), torch.zeros_like(z), z], dim=-1))[:, 2]
    peaks = z[1:-1][(slope[1:-1] > slope[:-2]) & (slope[1:-1] > slope[2:]) & (slope[1:-1] > 0.2 * slope.max())]
    assert peaks.diff().tolist() == pytest.approx([50 / 3.5] * (len(peaks) - 1), abs=0.1)
    assert len(peaks) == 4
