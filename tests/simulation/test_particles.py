"""A cloud of particles, its ideal volume and its images."""

from __future__ import annotations

import math

import pytest
import torch

from nerif.common.conventions import InputError
from nerif.geometry import Box, Grid
from nerif.reconstruction.voxels.multiplicative import MART, MLEM
from nerif.simulation.particles.cloud import Particles, quality_factor, spread
from nerif.simulation.particles.images import image, images
from nerif.simulation.particles.rig import four_cameras
from refusals import refused

BOX = Box((-1.0, -2.0, -1.5), (1.0, 2.0, 1.5))
GRID = Grid(BOX, (30, 40, 20))


def one(x: float, y: float, z: float, brightness: float = 2.5) -> Particles:
    return Particles(torch.tensor([[x, y, z]]).double(), torch.tensor([brightness]).double(), BOX)


def test_particles_are_drawn_by_seed_evenly_over_the_box():
    cloud = Particles.draw(BOX, 20_000, variation=0.5, seed=3)
    assert torch.equal(cloud.positions, Particles.draw(BOX, 20_000, variation=0.5, seed=3).positions)
    assert not torch.equal(cloud.positions, Particles.draw(BOX, 20_000, variation=0.5, seed=4).positions)
    assert len(cloud.moved_to(cloud.positions)) == len(cloud) == 20_000
    edges = torch.tensor(BOX.edges).double()
    assert (cloud.positions.mean(dim=0).abs() < 0.02 * edges).all()
    torch.testing.assert_close(cloud.positions.std(dim=0), edges / math.sqrt(12), rtol=0.02, atol=0)
    assert float(cloud.brightness.mean()) == pytest.approx(1, abs=0.02)
    assert float(cloud.brightness.log().std()) == pytest.approx(0.5, abs=0.02)


def test_particles_that_leave_the_box_are_gone():
    cloud = Particles(torch.tensor([[0.0, 0, 0], [0.9, 0, 0], [0, 1.9, 0]]).double(), torch.arange(3).double(), BOX)
    later = cloud.moved_to(cloud.positions + torch.tensor([0.2, 0, 0]))
    assert later.brightness.tolist() == [0, 2]


def test_the_ideal_volume_holds_the_brightness_at_its_place_with_its_width():
    volume = one(0.13, -0.42, 0.31).volume(GRID, diameter=4.0)
    points, values = GRID.points(torch.float64), volume.values.double()
    voxel = math.prod(GRID.spacing)
    assert float(values.sum()) * voxel == pytest.approx(2.5, rel=1e-5)
    mean = (points * values[..., None]).sum((0, 1, 2)) / values.sum()
    torch.testing.assert_close(mean, torch.tensor([0.13, -0.42, 0.31]).double(), rtol=0, atol=1e-5)
    variance = ((points - mean).square() * values[..., None]).sum((0, 1, 2)) / values.sum()
    expected = torch.full((3,), 0.1**2 * (1.0 + 1 / 12)).double()  # one voxel of deviation, and the voxel itself
    torch.testing.assert_close(variance, expected, rtol=1e-3, atol=0)


def test_what_falls_beside_the_array_is_lost():
    assert float(spread(torch.tensor([[-0.5, 3.0]]).double(), torch.ones(1).double(), 0.8, (9, 8)).sum()) == (
        pytest.approx(0.5, abs=1e-5)
    )


def test_a_image_has_the_particle_where_it_is_seen_and_all_its_light():
    cameras, _ = four_cameras(64, 16)
    for camera in cameras:
        particle = one(0.3, -0.8, 0.9)
        seen = image(particle, camera, diameter=3.0)
        rows, columns = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
        centroid = torch.stack([(columns * seen).sum(), (rows * seen).sum()]) / seen.sum()
        torch.testing.assert_close(centroid, camera.project(particle.positions)[0], rtol=0, atol=1e-4)
        # a pixel of a pinhole covers (z / f)^2 across the axis, less by the cosine of the ray's angle across the ray
        local = camera.rotation @ particle.positions[0] + camera.translation
        f = float(camera.intrinsics[0, 0])
        area = float(local[2] / f) ** 2 * float(local[2] / local.norm())
        assert float(seen.sum()) * area == pytest.approx(2.5, rel=1e-5)


def test_shot_noise_has_the_sigma_that_is_told():
    cameras, box = four_cameras(64, 16)
    cloud = Particles.draw(box, 200, seed=1)
    noisy, clean = images(cloud, cameras, counts=500, seed=2), images(cloud, cameras, counts=0)
    assert clean.observations[0].sigma is None
    assert not torch.equal(noisy.maps["radiance"], images(cloud, cameras, counts=500, seed=3).maps["radiance"])
    bright = clean.maps["radiance"] > clean.maps["radiance"].max() / 5
    error = (noisy.maps["radiance"] - clean.maps["radiance"]) / noisy.maps["radiance_sigma"]
    assert float(error[bright].square().mean().sqrt()) == pytest.approx(1, abs=0.1)
    dark = clean.maps["radiance"] == 0
    assert dark.any()
    assert (noisy.maps["radiance"][dark] == 0).all()


def test_four_cameras_see_the_whole_box_from_30_degrees_aside():
    cameras, box = four_cameras(80, 20)
    for camera in cameras:
        assert camera.background is None
        assert math.degrees(math.acos(float(-camera.rotation[2, 0]))) == pytest.approx(30)
        seen = image(Particles.draw(box, 2000, seed=0), camera)
        assert float(seen[0].max()) < 1e-2 * float(seen.max())
    assert box.edges[0] == pytest.approx(2.0)
    assert box.edges[1] > 5.0


@pytest.mark.usefixtures("unchecked")
def test_quality_is_one_for_the_ideal_volume_whatever_its_scale():
    volume = Particles.draw(BOX, 30).volume(GRID).values
    assert quality_factor(3 * volume, volume) == pytest.approx(1)
    assert quality_factor(torch.zeros_like(volume), volume) == 0
    assert quality_factor(Particles.draw(BOX, 30, seed=1).volume(GRID).values, volume) < 0.3
    with refused("ideal"):
        quality_factor(volume, volume[..., 1:])


@pytest.mark.parametrize("method", [MART, MLEM], ids=["MART", "MLEM"])
def test_a_few_particles_are_found(method):
    cameras, box = four_cameras(48, 12)
    cloud = Particles.draw(box, 40, seed=5)
    grid = Grid.of_resolution(box, 34)
    result = method(voxels=34, basis="linear")(images(cloud, cameras, seed=5))
    assert quality_factor(result.volume(grid).values, cloud.volume(grid).values) > 0.85


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Particles.draw(BOX, 0), "count: expected at least 1 particle, got 0"),
        (lambda: Particles.draw(BOX, 3, variation=-1), "variation: expected 0 or more, got -1"),
        (lambda: one(0, 0, 0).volume(GRID, diameter=0), "diameter: expected above 0, got 0"),
        (lambda: images(one(0, 0, 0), four_cameras(48, 12)[0], counts=-1), "counts: expected 0 or more, got -1"),
        (lambda: images(one(0, 0, 99), four_cameras(48, 12)[0]), "particles: expected some in view 'left below'"),
        (lambda: four_cameras(angle=90), "angle: expected between 0 and 80 degrees, got 90"),
        (lambda: four_cameras(depth=0), "depth: expected at least 1 px, got 0"),
        (lambda: four_cameras(20, 100), "pixels: expected images that hold a box 100 px deep, got 20 px"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(InputError, match=message):
        call()
