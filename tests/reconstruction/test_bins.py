"""Bins of pixels: the mean they stand for, its noise and its ray."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Ring
from nerif.reconstruction.neural.bins import binned_rays, coarsest_edge
from nerif.reconstruction.target import Target
from nerif.simulation.simulate import simulate

EDGE = 3


def binned(m, open_faces=()):
    return binned_rays(m, m.observations[0], EDGE, open_faces)


@pytest.fixture(scope="module")
def noisy(measurement):
    """Noise that differs from pixel to pixel, and some that measured nothing."""
    generator = torch.Generator().manual_seed(2)
    sigma = 0.01 + 0.03 * torch.rand(measurement.displacement.shape, generator=generator)
    valid = torch.rand(measurement.displacement.shape[:3], generator=generator) > 0.1
    displacement = measurement.displacement.clone()
    displacement[~valid] = float("nan")
    return replace(measurement, displacement=displacement, sigma=sigma, valid=valid)


def test_a_bin_is_the_weighted_mean_of_its_usable_pixels(noisy):
    """One bin by hand, of the first view, in the middle of the image."""
    rays, displacement, sigma = binned(noisy.select([noisy.names[0]]))
    camera, row, column = noisy.cameras[0], 9, 12
    block = (0, slice(row, row + EDGE), slice(column, column + EDGE))
    good = noisy.valid[block]
    weight = noisy.sigma[block][good].double() ** -2
    mean = (weight * noisy.displacement[block][good]).sum(0) / weight.sum(0)
    pixels = camera.pixel_grid()[block[1:]][good]
    centre = (weight.mean(1, keepdim=True) * pixels).sum(0) / weight.mean(1).sum()
    wanted = camera.rays(centre[None])
    (found,) = ((rays.direction - wanted.direction.float()).norm(dim=1) < 1e-6).nonzero()
    assert torch.allclose(displacement[found].double(), mean, atol=1e-6)
    assert torch.allclose(sigma[found].double(), weight.sum(0).rsqrt(), rtol=1e-5)
    assert torch.allclose(rays.ends.sensitivity[found], wanted.ends.sensitivity.float(), rtol=1e-5)


def test_invalid_pixels_do_not_count(noisy):
    """Whatever stands in them."""
    absurd = noisy.displacement.clone()
    absurd[~noisy.valid] = 99.0
    assert torch.equal(binned(replace(noisy, displacement=absurd))[1], binned(noisy)[1])


def test_bins_stay_inside_the_box_and_off_open_faces(measurement):
    """Their pixels are all among those that cross it."""
    rays, _, _ = binned(measurement)
    assert bool(rays.crosses.all())
    assert 0.4 < len(rays) * EDGE**2 / len(Target.of(measurement)) <= 1
    fewer, _, _ = binned(measurement, ("z+",))
    assert 0 < len(fewer) < len(rays)


def test_bins_predict_what_they_measured(ball, box):
    """Without noise: the ray of a bin sees the mean of its pixels, up to the curvature of the displacement."""
    ring = Ring(views=2, image_size=(60, 72), pixel_pitch=0.03, distance=700.0, background_distance=450.0)
    fine = simulate(ball, ring.cameras(), box, n_ambient=1.00027, steps=60)
    errors = []
    for edge in (2, 4):
        (part,) = Target.of(fine, edge=edge).parts
        predicted = project(PathIntegral(MODELS["lever_arm"](1.00027)), ball, part.rays)
        errors.append(float((predicted - part.measured).norm() / part.measured.norm()))
    assert errors[0] < 0.03
    assert 4 < errors[1] / errors[0] < 6  # (edge^2 - 1) / 12, the variance of the pixels of a bin: 5 times


def test_without_sigma_a_bin_of_more_pixels_weighs_more(noisy):
    target = Target.of(replace(noisy, sigma=None), edge=EDGE)
    assert target.noise is None
    (part,) = target.parts
    assert float(part.of_nothing.square().mean()) == pytest.approx(1, rel=1e-5)
    ratio = part.inverse_scale.max() / part.inverse_scale.min()
    assert 1.1 < float(ratio) <= EDGE


def test_small_images_are_not_binned(measurement):
    assert coarsest_edge(measurement) == 1
    for pixels, edge in ((200, 1), (256, 2), (1000, 4), (1024, 8)):
        cameras = Ring(views=2, image_size=(pixels, pixels + 30)).cameras()
        shown = replace(measurement, cameras=cameras, displacement=torch.zeros(2, pixels, pixels + 30, 2), sigma=None)
        assert coarsest_edge(shown) == edge


def test_usable_pixels_at_the_rim_of_the_box_alone_are_kept(measurement):
    """No whole bin holds any of them."""
    view = measurement.select(measurement.names[:1])
    usable = view.usable & view.sees_box
    first = usable[0].nonzero()[:, 0].min()
    valid = torch.zeros_like(usable)
    valid[0, first] = usable[0, first]
    rays, displacement, _ = binned(replace(view, valid=valid))
    assert len(rays) == len(displacement) == int(valid.sum())
