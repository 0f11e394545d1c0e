"""The gauge: an ambient region, and points at which the index is known, in place of ambient faces."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bodies import cuboid
from nerif.data.measurement import Measurement
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Grid
from nerif.reconstruction.gauge import Gauge, free_voxels, with_gauge
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from refusals import refused

QUICK = NeRIF(
    network=NetworkShape(depth=2, width=32, octaves=2), samples=(12, 16), points_per_batch=1024, max_steps=120,
    device="cpu", precision="float32",
)  # fmt: skip
SMOOTH = Tikhonov(voxels=16, device="cpu")
METHODS = pytest.mark.parametrize("method", [QUICK, SMOOTH], ids=["nerif", "tikhonov"])


@pytest.fixture(scope="module")
def corner(measurement):
    """A region in the corner of the box, far from the balls."""
    (x0, y0, z0), _ = measurement.box.lower, measurement.box.upper
    return (x0, x0 + 3.0, y0, y0 + 3.0, z0, z0 + 3.0)


@pytest.fixture(scope="module")
def probe(measurement, ball):
    """The place of the largest excess on a grid, and the index there."""
    grid = Grid.of_resolution(measurement.box, 24)
    points = grid.points().reshape(-1, 3)
    place = points[ball(points).abs().argmax()]
    return (*place.tolist(), measurement.n_ambient + float(ball(place[None])[0]))


@METHODS
def test_a_region_fixes_the_constant(measurement, ball, corner, method):
    result = replace(method, ambient_region=corner)(measurement)
    points, values = Gauge.of(with_gauge(measurement, replace(method, ambient_region=corner))).sample(
        500, torch.Generator().manual_seed(3)
    )
    assert not bool(values.any())
    largest = float(ball.sample(Grid.of_resolution(measurement.box, 24)).abs().max())
    assert float(result.field(points).abs().mean()) < 0.05 * largest


@METHODS
def test_a_known_point_fixes_the_constant(measurement, ball, probe, method):
    *place, index = probe
    result = replace(method, probes=(probe,))(measurement)
    excess = float(result.field(torch.tensor([place]))[0])
    assert excess == pytest.approx(index - measurement.n_ambient, rel=0.02)
    higher = replace(method, probes=((*place, index + 1e-4),))(measurement)
    points = torch.tensor([measurement.box.centre, place])
    assert float((higher.field(points) - result.field(points)).mean()) == pytest.approx(1e-4, rel=0.1)


def test_settings_replace_the_gauge_of_the_measurement(measurement, corner):
    faces = with_gauge(replace(measurement, ambient_region=corner), replace(QUICK, ambient_faces=("z-",)))
    assert faces.ambient_faces == ("z-",)
    assert faces.ambient_region is None
    both = with_gauge(measurement, replace(QUICK, ambient_faces=("z-",), ambient_region=corner))
    assert both.ambient_faces == ("z-",)
    assert both.ambient_region == corner
    assert with_gauge(measurement, QUICK) is measurement


def test_voxels_in_the_region_are_ambient(measurement, corner):
    grid = Grid.of_resolution(measurement.box, 20)
    region = replace(measurement, ambient_region=corner)
    free = free_voxels(region, grid)
    assert free is not None
    inside = (grid.points(torch.float64) <= torch.tensor(corner[1::2], dtype=torch.float64)).all(dim=-1)
    assert 0 < int(inside.sum()) < 100
    assert torch.equal(~free, inside)
    assert free_voxels(measurement, grid) is None


def test_the_region_is_written_and_read(measurement, corner, tmp_path):
    path = tmp_path / "m.nc"
    replace(measurement, ambient_region=corner).write(path)
    assert Measurement.read(path).ambient_region == pytest.approx(corner)
    assert Measurement.read(path).ambient_faces == measurement.ambient_faces


def test_a_gauge_that_cannot_be_is_refused(measurement, corner, probe):
    x0, *rest = corner
    with refused("ambient_region"):
        replace(measurement, ambient_region=(x0 - 5.0, *rest))
    with refused("ambient_region"):
        replace(QUICK, ambient_region=(5.0, 0.0, 0.0, 1.0, 0.0, 1.0))
    with refused("known"):
        replace(QUICK, probes=((0.0, 0.0, 0.0, 2.7e-4),))
    with refused("known"):
        Gauge.of(measurement, [(1e3, 0.0, 0.0, 1.0)])
    body = cuboid((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    with refused("known"):
        Gauge.of(replace(measurement, bodies=(body,)), [(0.0, 0.0, 0.0, 1.0)])
    masked = replace(measurement, flow_mask=torch.ones(measurement.shape, dtype=torch.bool))
    masked.flow_mask[:, :8] = False
    with refused("known"):
        replace(SMOOTH, probes=(probe,))(masked)
    with refused("ambient_faces"):
        QUICK(replace(measurement, ambient_faces=()))


def test_faces_that_are_stated_count_for_techniques_without_a_gauge(measurement):
    from nerif.forward.absorption import Absorption

    values = measurement.displacement[..., :1].abs()
    absorbing = Measurement(
        tuple(Absorption.seen_by(camera) for camera in measurement.cameras), None, measurement.box, 1.0,
        maps={"absorbance": values[..., 0]},
    )  # fmt: skip
    assert with_gauge(absorbing, QUICK).ambient_faces == ()
    assert with_gauge(absorbing, replace(QUICK, ambient_faces=("z-",))).ambient_faces == ("z-",)
    with refused("known"):
        with_gauge(absorbing, replace(QUICK, probes=((0.0, 0.0, 0.0, 1.0),)))
