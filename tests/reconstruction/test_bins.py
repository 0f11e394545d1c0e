"""Bins of pixels: their mean, noise and ray; subsets of pixels, and withheld pixels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.data.measurement import Measurement, measurement_of
from nerif.forward.deflection import MODELS, Deflection
from nerif.forward.interferometry import Interferometry
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Ring, paper_rig
from nerif.reconstruction.bins import binned_rays, coarsest_edge, pixel_subset, withhold_pixels
from nerif.reconstruction.target import Target
from nerif.simulation.simulate import simulate

EDGE = 3


def binned(m, open_faces=()):
    return binned_rays(m, m.observations[0], EDGE, open_faces)


@pytest.fixture(scope="module")
def noisy(measurement):
    """Noise that differs between pixels, and invalid pixels."""
    generator = torch.Generator().manual_seed(2)
    sigma = 0.01 + 0.03 * torch.rand(measurement.displacement.shape, generator=generator)
    valid = torch.rand(measurement.displacement.shape[:3], generator=generator) > 0.1
    displacement = measurement.displacement.clone()
    displacement[~valid] = float("nan")
    return replace(measurement, displacement=displacement, sigma=sigma, valid=valid)


def test_a_bin_is_the_weighted_mean_of_its_usable_pixels(noisy):
    """One bin by hand, in the middle of the first image; values of invalid pixels have no effect."""
    rays, displacement, sigma = binned(noisy.select([noisy.names[0]]))
    camera, row, column = noisy.cameras[0], 9, 12
    block = (0, slice(row, row + EDGE), slice(column, column + EDGE))
    good = noisy.valid[block]
    weight = noisy.sigma[block][good].double() ** -2
    mean = (weight * noisy.displacement[block][good]).sum(0) / weight.sum(0)
    pixels = camera.pixel_grid()[block[1:]][good]
    centre = (weight.mean(1, keepdim=True) * pixels).sum(0) / weight.mean(1).sum()
    expected = camera.rays(centre[None])
    (i,) = ((rays.direction - expected.direction.float()).norm(dim=1) < 1e-6).nonzero()
    assert torch.allclose(displacement[i].double(), mean, atol=1e-6)
    assert torch.allclose(sigma[i].double(), weight.sum(0).rsqrt(), rtol=1e-5)
    assert torch.allclose(rays.ends.sensitivity[i], expected.ends.sensitivity.float(), rtol=1e-5)
    absurd = noisy.displacement.clone()
    absurd[~noisy.valid] = 99.0
    assert torch.equal(binned(replace(noisy, displacement=absurd))[1], binned(noisy)[1])


def test_bins_stay_inside_the_box_and_off_open_faces(measurement):
    rays, _, _ = binned(measurement)
    assert bool(rays.crosses.all())
    assert 0.4 < len(rays) * EDGE**2 / len(Target.of(measurement)) <= 1
    assert 0 < len(binned(measurement, ("z+",))[0]) < len(rays)


def test_bins_predict_the_mean_of_their_pixels(ball, box):
    """Without noise, up to the curvature of the displacement."""
    ring = Ring(views=2, image_size=(60, 72), pixel_pitch=0.03, distance=700.0, background_distance=450.0)
    fine = simulate(ball, ring.cameras(), box, n_ambient=1.00027, steps=60)
    errors = []
    for edge in (2, 4):
        (part,) = Target.of(fine, edge=edge).parts
        predicted = project(PathIntegral(MODELS["lever_arm"](1.00027)), ball, part.rays)
        errors.append(float((predicted - part.measured).norm() / part.measured.norm()))
    assert errors[0] < 0.03
    assert 4 < errors[1] / errors[0] < 6  # (edge^2 - 1) / 12, the variance of the pixels of a bin: 5 times


def test_without_sigma_a_bin_of_more_pixels_has_more_weight(noisy):
    target = Target.of(replace(noisy, sigma=None), edge=EDGE)
    assert target.noise is None
    (part,) = target.parts
    assert float(part.ambient_residual.square().mean()) == pytest.approx(1, rel=1e-5)
    assert 1.1 < float(part.inverse_scale.max() / part.inverse_scale.min()) <= EDGE


@pytest.mark.parametrize(("pixels", "edge"), [(20, 1), (200, 1), (256, 2), (1000, 4), (1024, 8)])
def test_small_images_are_not_binned(measurement, pixels, edge):
    cameras = Ring(views=2, image_size=(pixels, pixels + 30)).cameras()
    images = replace(measurement, cameras=cameras, displacement=torch.zeros(2, pixels, pixels + 30, 2), sigma=None)
    assert coarsest_edge(images) == edge


def test_usable_pixels_at_the_rim_of_the_box_stay_single(measurement):
    view = measurement.select(measurement.names[:1])
    usable = view.usable & view.sees_box
    first = usable[0].nonzero()[:, 0].min()
    valid = torch.zeros_like(usable)
    valid[0, first] = usable[0, first]
    rays, displacement, _ = binned(replace(view, valid=valid))
    assert len(rays) == len(displacement) == int(valid.sum())


def displacements_and_fringes(rows: tuple[int, int]) -> Measurement:
    """Two views of displacements, and fringes in a few pixels of the first."""
    cameras, box = paper_rig(60)
    fringes = torch.full((2, 60, 60, 1), torch.nan)
    fringes[0, slice(*rows), 30:40] = 1.0
    values = {Deflection: torch.ones(2, 60, 60, 2), Interferometry: fringes}
    return measurement_of(values, cameras[:2], box, 1.00027, 532.0)


def counts(measurement: Measurement) -> list[list[int]]:
    return [measurement.usable_for(o).flatten(1).sum(dim=1).tolist() for o in measurement.observations]


def test_subset_has_pixels_of_every_technique_and_view():
    both = displacements_and_fringes((20, 22))
    (first, second), fringes = counts(pixel_subset(both, 1000))
    assert 800 < first + second < 1200
    assert fringes == [20, 0]  # too few to choose from
    assert torch.equal(pixel_subset(both, 1000).usable, pixel_subset(both, 1000).usable)
    valid = torch.ones(2, 60, 60, dtype=torch.bool)
    valid[1] = False
    valid[1, 3, 4] = True
    assert counts(pixel_subset(replace(both, valid=valid), 100))[0][1] == 1  # a view of a single pixel


def test_withheld_pixels_and_the_others_are_all(measurement):
    rest, withheld = withhold_pixels(measurement, 1)
    index = [measurement.names.index(name) for name in withheld.names]
    assert len(index) > len(measurement.names) / 2
    mask = torch.zeros_like(measurement.usable)
    mask[index] = withheld.usable
    assert torch.equal(mask ^ rest.usable, measurement.usable)
    assert bool(rest.usable.flatten(1).any(dim=1).all())
    assert 0.02 < mask.sum() / measurement.usable.sum() < 0.2


def test_pixels_are_withheld_of_every_technique_inside_the_box():
    both = displacements_and_fringes((28, 31))
    parts = withhold_pixels(replace(both, box=replace(both.box, lower=(-9.0,) * 3, upper=(9.0,) * 3)), 1)
    assert bool((parts[1].usable <= parts[1].sees_box).all())
    assert all(bool(part.usable_for(o).any()) for part in parts for o in part.observations)


def test_one_pixel_of_a_few_is_withheld_and_none_of_single_ones(measurement):
    valid = torch.zeros_like(measurement.usable)
    valid[:, 10, 10] = True
    assert withhold_pixels(replace(measurement, valid=valid), 1)[1] is None
    valid[1, 10, 11] = True
    rest, withheld = withhold_pixels(replace(measurement, valid=valid), 1)
    assert withheld.names == (measurement.names[1],)
    assert int(withheld.usable.sum()) == 1
    assert rest.usable.flatten(1).sum(dim=1).tolist() == [1] * len(measurement.names)
