"""A cloud of particles, its ideal volume and its images."""

from __future__ import annotations

import math

import pytest
import torch

from nerif.geometry import Box, Grid
from nerif.reconstruction.voxels.multiplicative import MART, MLEM
from nerif.simulation.particles.cloud import Particles, quality_factor, spread
from nerif.simulation.particles.particle_images import image, images
from nerif.simulation.particles.particle_rig import four_cameras
from refusals import refused

BOX = Box((-1.0, -2.0, -1.5), (1.0, 2.0, 1.5))
GRID = Grid(BOX, (30, 40, 20))


def one(x: float, y: float, z: float, brightness: float = 2.5) -> Particles:
    return Particles(torch.tensor([[x, y, z]]).double(), torch.tensor([brightness]).double(), BOX)


def test_random_particles_are_uniform_over_the_box():
    cloud, again, other = (Particles.draw(BOX, 20_000, variation=0.5, seed=n) for n in (3, 3, 4))
    assert torch.equal(cloud.positions, again.positions)
    assert not torch.equal(cloud.positions, other.positions)
    assert len(cloud.moved_to(cloud.positions)) == len(cloud) == 20_000
    edges = torch.tensor(BOX.edges).double()
    assert (cloud.positions.mean(dim=0).abs() < 0.02 * edges).all()
    torch.testing.assert_close(cloud.positions.std(dim=0), edges / math.sqrt(12), rtol=0.02, atol=0)
    assert float(cloud.brightness.mean()) == pytest.approx(1, abs=0.02)
    assert float(cloud.brightness.log().std()) == pytest.approx(0.5, abs=0.02)


def test_particles_that_leave_the_box_are_removed():
    cloud = Particles(torch.tensor([[0.0, 0, 0], [0.9, 0, 0], [0, 1.9, 0]]).double(), torch.arange(3).double(), BOX)
    assert cloud.moved_to(cloud.positions + torch.tensor([0.2, 0, 0])).brightness.tolist() == [0, 2]


def test_the_ideal_volume_has_the_brightness_position_and_width_of_a_particle():
    volume = one(0.13, -0.42, 0.31).volume(GRID, diameter=4.0)
    points, values = GRID.points(torch.float64), volume.values.double()
    voxel = math.prod(GRID.spacing)
    assert float(values.sum()) * voxel == pytest.approx(2.5, rel=1e-5)
    mean = (points * values[..., None]).sum((0, 1, 2)) / values.sum()
    torch.testing.assert_close(mean, torch.tensor([0.13, -0.42, 0.31]).double(), rtol=0, atol=1e-5)
    variance = ((points - mean).square() * values[..., None]).sum((0, 1, 2)) / values.sum()
    expected = torch.full((3,), 0.1**2 * (1.0 + 1 / 12)).double()  # one voxel of deviation, and the voxel itself
    torch.testing.assert_close(variance, expected, rtol=1e-3, atol=0)
    edge = spread(torch.tensor([[-0.5, 3.0]]).double(), torch.ones(1).double(), 0.8, (9, 8))  # half of it outside
    assert float(edge.sum()) == pytest.approx(0.5, abs=1e-5)


def test_an_image_has_the_position_and_all_the_light_of_a_particle():
    cameras, _ = four_cameras(64, 16)
    for camera in cameras:
        particle = one(0.3, -0.8, 0.9)
        values = image(particle, camera, diameter=3.0)
        rows, columns = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
        centroid = torch.stack([(columns * values).sum(), (rows * values).sum()]) / values.sum()
        torch.testing.assert_close(centroid, camera.project(particle.positions)[0], rtol=0, atol=1e-4)
        # a pixel of a pinhole covers (z / f)^2 across the axis, less by the cosine of the ray's angle across the ray
        local = camera.rotation @ particle.positions[0] + camera.translation
        f = float(camera.intrinsics[0, 0])
        area = float(local[2] / f) ** 2 * float(local[2] / local.norm())
        assert float(values.sum()) * area == pytest.approx(2.5, rel=1e-5)


def test_shot_noise_has_the_sigma_of_the_measurement():
    cameras, box = four_cameras(64, 16)
    cloud = Particles.draw(box, 200, seed=1)
    noisy, other, clean = (images(cloud, cameras, counts=n, seed=seed) for n, seed in ((500, 2), (500, 3), (0, 2)))
    assert clean.observations[0].sigma is None
    noise = noisy.maps["radiance"] - clean.maps["radiance"]
    assert not torch.equal(noisy.maps["radiance"], other.maps["radiance"])
    bright, dark = clean.maps["radiance"] > clean.maps["radiance"].max() / 5, clean.maps["radiance"] == 0
    assert float((noise / noisy.maps["radiance_sigma"])[bright].square().mean().sqrt()) == pytest.approx(1, abs=0.1)
    assert dark.any()
    assert (noise[dark] == 0).all()


def test_four_cameras_see_the_whole_box_from_30_degrees_aside():
    cameras, box = four_cameras(80, 20)
    for camera in cameras:
        assert camera.background is None
        assert math.degrees(math.acos(float(-camera.rotation[2, 0]))) == pytest.approx(30)
        values = image(Particles.draw(box, 2000, seed=0), camera)
        assert float(values[0].max()) < 1e-2 * float(values.max())
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
def test_a_few_particles_are_reconstructed(method):
    cameras, box = four_cameras(48, 12)
    cloud = Particles.draw(box, 40, seed=5)
    grid = Grid.of_resolution(box, 34)
    result = method(voxels=34, basis="linear")(images(cloud, cameras, seed=5))
    assert quality_factor(result.volume(grid).values, cloud.volume(grid).values) > 0.85


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: Particles.draw(BOX, 0), "count"),
        (lambda: Particles.draw(BOX, 3, variation=-1), "variation"),
        (lambda: one(0, 0, 0).volume(GRID, diameter=0), "diameter"),
        (lambda: images(one(0, 0, 0), four_cameras(48, 12)[0], counts=-1), "counts"),
        (lambda: images(one(0, 0, 99), four_cameras(48, 12)[0]), "particles"),
        (lambda: four_cameras(angle=90), "angle"),
        (lambda: four_cameras(depth=0), "depth"),
        (lambda: four_cameras(20, 100), "pixels"),
    ],
)
def test_invalid_input(call, field):
    with refused(field):
        call()
