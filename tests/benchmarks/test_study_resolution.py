"""The resolution of blurred edges and octahedra, of which it is known."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter

from benchmarks.study.resolution import cutoff, measure_resolution, pixels_per_unit, transfer_function
from nerif.fields.field import Field
from nerif.fields.phantoms import Octahedron
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid, Ring

PHANTOM = Octahedron(Box((-9.0, -12.0, -14.0), (11.0, 13.0, 16.0)))  # off the origin; one unit is 5 mm
STEP, HALF = 0.01, 1.2


def expected(sigma):
    """exp(-2 (pi f sigma)^2) = 0.1."""
    return math.sqrt(2 * math.log(10)) / (2 * math.pi * sigma)


def edge(sigma, strength=1.0):
    """A step from -strength to 0, blurred by a Gaussian."""
    t = (torch.arange(-round(HALF / STEP), round(HALF / STEP), dtype=torch.float64) + 0.5) * STEP
    return -0.5 * strength * torch.erfc(t / (math.sqrt(2) * sigma))


def of_edges(edges):
    return cutoff(*transfer_function(edges, STEP))


@pytest.mark.parametrize(("of_length", "error"), [(0.03, 1e-3), (1 / 5, 1e-3), (1 / 3, 8e-3), (1 / 2, 0.14)])
def test_gaussian_edges_within_the_errors_that_the_module_states(of_length, error):
    sigma = of_length * HALF
    frequency, mtf = transfer_function(edge(sigma), STEP)
    assert float(cutoff(frequency, mtf)) == pytest.approx(expected(sigma), rel=error)
    assert float(mtf[0]) == pytest.approx(1)
    assert float(frequency[-1]) == pytest.approx(0.5 / STEP)


def test_many_edges_at_once_faint_ones_and_a_sharp_one():
    edges = torch.stack([edge(0.1), edge(0.2), edge(0.1, 0.5), edge(0.1, 0.05), torch.zeros(240).double(), edge(1e-6)])
    values = of_edges(edges)
    assert values[0].item() == pytest.approx(2 * values[1].item(), rel=1e-3)
    assert values[2].item() == pytest.approx(values[0].item())  # a weak edge is as sharp as a strong one
    assert values[3:5].tolist() == [0, 0]  # no edge
    assert math.isnan(values[5])  # finer than the samples
    ramp = torch.linspace(-1, 0, 240, dtype=torch.float64)  # the window alone
    assert float(of_edges(ramp)) == pytest.approx(0.6 / HALF, rel=0.02)


class Blurred(Field):
    """The octahedron, of which the steps at the faces are error functions of the distance to them.

    `sigma` gives the blur (mm) at points from the centre (mm).
    """

    def __init__(self, sigma) -> None:
        self.sigma = sigma

    def value_and_gradient(self, points):
        p = points - points.new_tensor(PHANTOM.box.centre)
        sigma = self.sigma(p)
        distance = (p.abs().sum(-1) - 1.5 * PHANTOM.unit) / math.sqrt(3)
        tail = 0.5 * torch.erfc(distance / (math.sqrt(2) * sigma))
        bell = sigma / math.sqrt(2 * math.pi) * torch.exp(-0.5 * (distance / sigma) ** 2)
        slope = PHANTOM.amplitude / PHANTOM.unit
        return slope * math.sqrt(3) * (bell - distance * tail), -slope * p.sign() * tail[..., None]


def test_blur_that_depends_on_the_place():
    """Twice as sharp above the centre as below, where the blur grows with x."""
    field = Blurred(lambda p: 0.2 * torch.where(p[..., 2] > 0, 1.0, 2.0 + p[..., 0] / 10))
    measured = measure_resolution(field, PHANTOM)
    patches = torch.tensor(measured["patches_mm"]) - torch.tensor(PHANTOM.box.centre)
    p, values = patches.mean(dim=1).double(), 5 * torch.tensor(measured["local_lp_per_unit"]).double() / 25
    torch.testing.assert_close(p.abs().sum(-1), torch.full((128,), 7.5).double(), rtol=1e-6, atol=0)  # on the faces
    assert len(torch.unique((p * 1e4).round(), dim=0)) == 128
    above = p[:, 2] > 0
    torch.testing.assert_close(values[above], torch.full((64,), expected(0.2)).double(), rtol=1e-3, atol=0)
    blur = 0.2 * (2 + p[~above, 0] / 10)
    assert float(blur.max() / blur.min()) > 1.4
    torch.testing.assert_close(values[~above], expected(1.0) / blur, rtol=0.02, atol=0)
    assert expected(0.4 * 1.6) < measured["lp_per_unit"] / 5 < expected(0.2)


@pytest.mark.parametrize(("sigma", "error", "of_patches"), [(0.05, 0.01, 0.01), (0.1, 0.025, 0.03)])
def test_the_whole_phantom_blurred_in_three_dimensions(sigma, error, of_patches):
    """The other steps of the gradient, at the planes of the edges, hardly count."""
    box = Box.cube(20.0)
    grid = Grid(box, (110, 110, 110))
    phantom = Octahedron(box)
    sharp = phantom(grid.points(torch.float64).reshape(-1, 3)).reshape(grid.shape)
    field = VoxelField.through(torch.from_numpy(gaussian_filter(sharp.numpy(), sigma * 27.5)), grid)
    measured = measure_resolution(field, phantom)
    assert measured["lp_per_unit"] == pytest.approx(expected(sigma), rel=error)
    assert measured["local_lp_per_unit"] == pytest.approx([expected(sigma)] * 128, rel=of_patches)


def test_the_phantom_itself_is_finer_than_the_samples():
    measured = measure_resolution(PHANTOM, PHANTOM)
    assert math.isnan(measured["lp_per_unit"])
    assert measured["frequency_lp_per_unit"][-1] == pytest.approx(128)  # half of 256 samples a unit
    assert min(measured["mtf"]) > 0.99
    truth = [-1.0 if distance < 0 else 0.0 for distance in measured["distance_mm"]]
    assert measured["edge_spread"] == pytest.approx(truth, abs=1e-6)


def test_pixels_of_a_unit():
    ring = Ring(views=2, focal_length=50, pixel_pitch=0.02, image_size=(30, 40), distance=700, elevation=10)
    centred = Octahedron(Box((-25.0, -30.0, -35.0), (25.0, 30.0, 35.0)))
    for camera in ring.cameras():  # 50 / 700 of 12.5 mm, in pixels of 0.02 mm
        assert pixels_per_unit(camera, centred) == pytest.approx(50 / 700 * 12.5 / 0.02)
