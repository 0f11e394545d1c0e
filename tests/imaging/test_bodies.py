"""Bodies in a measurement: hidden pixels, files, volumes without a field within them, and wrong places."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bodies import ball, cuboid
from nerif.analysis.evaluation import evaluate
from nerif.analysis.prediction import reproject
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.body_file import read_body
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume, write_netcdf
from nerif.data.volume_file import read_volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.geometry.body import contained
from nerif.imaging.bodies import with_bodies, without_bodies
from nerif.reconstruction.gauge import Gauge, visual_hull
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings
from refusals import refused
from sequence_films import COLD

CONE = Path(__file__).parents[3] / "shared" / "data" / "body"
needs_cone = pytest.mark.skipif(not CONE.is_dir(), reason="the cone is not beside the project (shared/data)")
BOX = Box.cube(40.0)


@pytest.fixture(scope="module")
def flow() -> Measurement:
    """A measurement of balls of gas, without a body."""
    ring = Ring(views=4, arc=(0.0, 135.0), image_size=(32, 32), pixel_pitch=0.1)
    return simulate(make_phantom("gaussians", BOX, 0), ring.cameras(), BOX, 1.00027, 0.05, seed=1, steps=30)


@pytest.fixture(scope="module")
def with_ball(flow) -> Measurement:
    return with_bodies(flow, [ball(6.0, (2.0, 0.0, -3.0), rings=12)])


def test_pixels_that_see_a_body_have_no_data_and_others_keep_theirs(flow, with_ball):
    hidden = with_ball.hidden
    assert 0.02 < float(hidden.double().mean()) < 0.3
    assert torch.equal(with_ball.usable, flow.usable & ~hidden)
    assert bool(with_ball.displacement[hidden].isnan().all())
    assert torch.equal(with_ball.displacement[~hidden], flow.displacement[~hidden])
    assert torch.equal(with_ball.sigma, flow.sigma)


def test_bodies_and_hidden_pixels_come_back_from_a_file(with_ball, tmp_path):
    two = replace(with_ball, bodies=(*with_ball.bodies, cuboid((8.0, 8.0, 8.0), (9.0, 9.5, 9.0), "probe")))
    two.write(tmp_path / "m.nc")
    again = Measurement.read(tmp_path / "m.nc")
    assert [b.name for b in again.bodies] == ["ball", "probe"]
    for body, other in zip(again.bodies, two.bodies, strict=True):
        assert torch.equal(body.vertices[body.faces], other.vertices[other.faces])
    assert torch.equal(again.hidden, two.hidden)
    assert torch.equal(again.usable, two.usable)
    assert again.to_dataset().attrs["Conventions"] == "BOST-1.2"


def test_a_view_keeps_its_hidden_pixels_and_the_bodies(with_ball):
    one = with_ball.select(with_ball.names[2])
    assert torch.equal(one.hidden[0], with_ball.hidden[2])
    assert one.bodies == with_ball.bodies


def test_removed_bodies_leave_pixels_without_data(with_ball):
    without = without_bodies(with_ball)
    assert without.bodies == ()
    assert without.hidden is None
    assert torch.equal(without.usable, with_ball.usable)


def test_a_body_in_the_wrong_place_is_refused(flow):
    with refused("ball") as error:
        with_bodies(flow, [ball(2.0, (0.0, 0.0, 60.0), rings=4)])
    assert "in the box" in str(error.value)
    with pytest.raises(InputError, match="every pixel sees a body"):
        with_bodies(flow, [cuboid((-19.0, 16.0, -19.0), (19.0, 17.0, 19.0))], margin=16)


@pytest.mark.parametrize("factor", [1 / 25.4, 0.1])
def test_a_body_in_inches_or_cm_is_refused_unless_its_unit_is_stated(flow, factor):
    """A ball of 12 mm in a box of 40; as for metres."""
    small = ball(6.0 * factor, rings=8, name="model")
    with pytest.raises(InputError, match=r"model: .* got 0.39% by one of .* lengths in cm, in or m .* --unit mm"):
        with_bodies(flow, [small])
    placed = with_bodies(flow, [small], unit_stated=True)
    assert len(with_bodies(placed, [*placed.bodies, ball(6.0, (8.0, 0.0, 0.0), rings=8)]).bodies) == 2


def test_pixels_without_data_that_show_the_body_mirrored_name_the_axis(flow):
    there = ball(5.0, (9.0, 3.0, 6.0), rings=12, name="model")
    blank = without_bodies(with_bodies(flow, [there]))
    mirrored = ball(5.0, (-9.0, 3.0, 6.0), rings=12, name="model")
    with refused("model") as error:
        with_bodies(blank, [mirrored])
    assert "axes as (-x, y, z)" in str(error.value)
    assert with_bodies(blank, [there]).bodies == (there,)


def test_predictions_have_no_value_where_a_body_hides_the_background(with_ball):
    predicted = reproject(make_phantom("gaussians", BOX, 0), with_ball).maps["deflection"]
    assert torch.equal(predicted.isnan().all(dim=-1), with_ball.hidden)


def test_ambient_points_and_hull_respect_bodies(flow):
    body = cuboid((10.0, -10.0, -10.0), (25.0, 10.0, 10.0))  # through the face x+
    region = Gauge.of(with_bodies(replace(flow, ambient_faces=("x+",)), [body]))
    points_inside, _ = region.sample(2000, torch.Generator().manual_seed(0))
    assert not bool(contained([body], points_inside).any())
    assert 500 < len(points_inside) < 2000
    with refused("ambient_faces"):
        Gauge.of(replace(flow, ambient_faces=("x+",), bodies=(cuboid((15.0, -30.0, -30.0), (25.0, 30.0, 30.0)),)))
    grid = Grid.of_resolution(BOX, 20)
    nothing = torch.zeros_like(flow.usable)
    nothing[:, 8:24, 8:24] = True
    masked = replace(with_bodies(flow, [ball(6.0, rings=12)]), flow_mask=nothing)
    assert bool((visual_hull(replace(flow, flow_mask=nothing), grid) <= visual_hull(masked, grid)).all())


@pytest.mark.parametrize("method", [Tikhonov(voxels=12, iterations=3, device="cpu"), replace(COLD, max_steps=2)])
def test_a_result_has_no_field_within_a_body(with_ball, tmp_path, method):
    with_ball.write(tmp_path / "m.nc")
    run = RunSettings(report=isinstance(method, Tikhonov), withhold=("none",))
    reconstruct_into(tmp_path / "r", tmp_path / "m.nc", method, run, voxels=16)
    result = ResultDirectory(tmp_path / "r")
    inside = contained(with_ball.bodies, Grid.of_resolution(BOX, 16).points())
    for quantity in ("index_excess", "n"):
        volume = result.volumes()[quantity]
        assert torch.equal(volume.values.isnan(), inside), quantity
        assert volume.notes["masked_voxels"] == int(inside.sum())
        assert volume.notes["masked_where"] == "within a body"
    density = result.volumes()["density"]
    assert bool(density.values[inside].isnan().all())
    assert str(density.notes["masked_where"]).startswith("within a body")
    surface = result.read().surface
    assert surface is not None
    assert bool(surface.quantities["index_excess"].isfinite().all())
    assert torch.equal(result.bodies()[0].vertices, with_ball.bodies[0].vertices)
    assert (tmp_path / "r" / "report.html").is_file() == run.report
    assert main(["export", str(tmp_path / "r"), "-o", str(tmp_path / "v.vti"), "--voxels", "16"]) == 0
    assert torch.equal(read_volume(tmp_path / "v.vti", gaps=True).values.isnan(), inside)


def test_a_result_is_compared_with_the_truth_outside_the_body(with_ball, tmp_path):
    with_ball.write(tmp_path / "m.nc")
    method, run = Tikhonov(voxels=20, device="cpu"), RunSettings(report=False, withhold=("none",))
    reconstruct_into(tmp_path / "r", tmp_path / "m.nc", method, run, voxels=20)
    grid = Grid.of_resolution(BOX, 24)
    truth = make_phantom("gaussians", BOX, 0).sample(grid)
    inside = contained(with_ball.bodies, grid.points())
    scores = []
    for name, value in (("nan", torch.nan), ("other", 1.0)):
        values = truth.masked_fill(inside, value)
        write_netcdf(tmp_path / f"{name}.nc", [Volume.of(values, grid, "index_excess", 1.00027)])
        scores.append(evaluate(tmp_path / "r", truth=tmp_path / f"{name}.nc"))
    for name in ("l2", "l2_variation", "cc", "ssim", "psnr"):
        assert np.isfinite(scores[0][name])
        assert scores[0][name] == pytest.approx(scores[1][name])
    assert scores[0]["l2_variation"] < 0.5


def test_the_command_adds_and_removes_bodies(flow, tmp_path, capsys):
    import trimesh

    flow.write(tmp_path / "m.nc")
    body = ball(0.5, (0.0, 0.0, 0.0), rings=16)  # in cm
    trimesh.Trimesh(body.vertices.numpy(), body.faces.numpy()).export(tmp_path / "model.stl")
    files = [str(tmp_path / name) for name in ("m.nc", "model.stl")]
    place = ["--unit", "cm", "--translation", "2", "0", "-3", "--rotation", "0", "0", "90"]
    assert main(["body", *files, "-o", str(tmp_path / "b.nc"), *place]) == 0
    assert (tmp_path / "b.bodies.png").is_file()
    assert "model" in capsys.readouterr().out
    measurement = Measurement.read(tmp_path / "b.nc")
    centre = sum(measurement.bodies[0].extent) / 2
    torch.testing.assert_close(centre, torch.tensor([2.0, 0.0, -3.0], dtype=torch.float64), atol=1e-4, rtol=0)
    assert main(["info", str(tmp_path / "b.nc")]) == 0
    assert "pixels see a body" in capsys.readouterr().out
    assert main(["body", str(tmp_path / "b.nc"), "--remove", "-o", str(tmp_path / "c.nc")]) == 0
    assert Measurement.read(tmp_path / "c.nc").bodies == ()
    assert main(["body", *files, "-o", str(tmp_path / "d.nc"), "--unit", "mm", "--translation", "90", "0", "0"]) == 2
    assert "in the box" in capsys.readouterr().err
    assert main(["body", *files[:1], "-o", str(tmp_path / "d.nc")]) == 2
    assert "--remove" in capsys.readouterr().err


@needs_cone
def test_the_pixels_that_see_the_cone_are_those_without_data():
    measurement, cone = Measurement.read(CONE / "cone.nc"), read_body(CONE / "cone.stl")
    hidden = with_bodies(measurement, [cone]).hidden
    for view, camera in enumerate(measurement.cameras):
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(measurement.box)
        s = cone.hits(rays)
        in_box = ((s > rays.near) & (s < rays.far)).reshape(camera.image_size)  # the cone goes on beyond the box
        differing = in_box != ~measurement.usable[view]
        assert int(differing.sum()) <= 20  # at the edge, of a cone of flat triangles
        assert bool((in_box <= hidden[view]).all())
    truth = read_volume(CONE / "cone_truth.nc", gaps=True)
    inside = contained([cone], truth.grid.points())
    assert float((inside != truth.values.isnan()).double().mean()) < 1e-3
    upside_down = replace(cone, vertices=cone.vertices * torch.tensor([1.0, 1.0, -1.0]), faces=cone.faces.flip(1))
    with refused("cone") as error:
        with_bodies(measurement, [upside_down])
    assert "axes as (x, y, -z)" in str(error.value)


def test_a_thin_body_beside_a_thick_one_hides_pixels_as_well(flow):
    thick, wire = ball(6.0, rings=12), cuboid((12.0, -8.0, 6.02), (16.0, 8.0, 6.06), name="wire")
    alone = with_bodies(flow, [wire]).hidden
    both = with_bodies(flow, [thick, wire]).hidden
    assert bool(alone.any())
    assert bool((alone <= both).all())
