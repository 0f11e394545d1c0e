"""Outlines of bodies: refined poses, visual hulls, and bodies that move in a film."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from bodies import ball, cuboid
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.geometry.body import contained, hidden_pixels
from nerif.geometry.pose import rotation_matrix
from nerif.imaging.bodies import film_with_bodies, with_bodies
from nerif.imaging.silhouettes import drawn_silhouettes, hull_of_silhouettes, outline, refine_pose
from nerif.simulation.simulate import simulate
from nerif.workflow.sequence.chunk import reconstruct_frames
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.store import SequenceStore
from refusals import refused
from sequence_films import COLD

BOX = Box.cube(40.0)
BRICK = cuboid((-8.0, -5.0, -3.0), (8.0, 5.0, 3.0), name="brick")


@pytest.fixture(scope="module")
def flow() -> Measurement:
    ring = Ring(views=5, arc=(0.0, 150.0), image_size=(64, 64), pixel_pitch=0.05)
    return simulate(make_phantom("gaussians", BOX, 0), ring.cameras(), BOX, 1.00027, 0.05, seed=1, steps=30)


def turned(body, degrees=(2.0, -3.0, 1.5), shift=(0.6, -0.4, 0.8)):
    rotation = rotation_matrix(torch.tensor(degrees, dtype=torch.float64).deg2rad())
    return body.moved(rotation, torch.tensor(shift, dtype=torch.float64))


def write_stl(path, body) -> None:
    import trimesh

    trimesh.Trimesh(body.vertices.numpy(), body.faces.numpy(), process=False).export(path)


def test_an_outline_is_halfway_between_pixels():
    mask = torch.zeros(5, 6, dtype=torch.bool)
    mask[2, 3] = True
    points = {tuple(point) for point in outline(mask).tolist()}
    assert points == {(2.5, 2.0), (3.5, 2.0), (3.0, 1.5), (3.0, 2.5)}


def test_the_pose_of_a_body_is_that_of_its_outlines(flow):
    there = turned(BRICK)
    masked = with_bodies(flow, [there])
    pose = refine_pose(replace(flow, displacement=masked.displacement), BRICK)
    assert pose.unknown == ()
    assert float((pose.body.vertices - there.vertices).norm(dim=1).max()) < 0.3  # mm; a pixel is 0.7 mm
    errors = pose.turn - torch.tensor([2.0, -3.0, 1.5]).deg2rad()
    assert bool((errors.abs() < 4 * pose.sigma[:3]).all())
    assert pose.residual < 0.5
    assert "brick: turned by" in pose.sentence


def test_turns_of_a_ball_are_not_determined(flow):
    there = ball(6.0, (1.0, -2.0, 0.5), rings=16)
    masked = with_bodies(flow, [there])
    pose = refine_pose(masked, ball(6.0, (0.2, -1.5, 0.0), rings=16))
    assert {name for name in pose.unknown if name.startswith("turn")} == {f"turn about {axis}" for axis in "xyz"}
    torch.testing.assert_close(pose.body.vertices.mean(dim=0), there.vertices.mean(dim=0), atol=0.15, rtol=0)
    assert "not determined: turn about" in pose.sentence


def test_an_outline_far_away_is_refused(flow):
    masked = with_bodies(flow, [BRICK])
    with refused("brick") as error:
        refine_pose(masked, turned(BRICK, shift=(0.0, 0.0, 17.0)))
    assert "--refine needs pixels without data where the body is" in str(error.value)
    with refused("brick") as error:
        refine_pose(flow, BRICK)
    assert str(error.value).endswith("--refine needs pixels without data where the body is, got none")


def test_the_hull_of_silhouettes_contains_the_body(flow):
    there = ball(7.0, (1.0, 2.0, -1.0), rings=20)
    silhouettes = torch.stack([hidden_pixels(camera, [there]) for camera in flow.cameras])
    hull = hull_of_silhouettes(flow, silhouettes, 64)
    inner = ball(6.5, (1.0, 2.0, -1.0), rings=20).vertices
    assert bool(contained([hull], inner).all())
    assert 1.0 < hull.volume / there.volume < 1.4
    with refused("silhouettes"):
        hull_of_silhouettes(flow, torch.zeros_like(silhouettes))


def test_silhouettes_on_the_command_line(flow, tmp_path, capsys):
    there, folder, flow = turned(BRICK), tmp_path / "drawn", flow.without(flow.names[3:])
    folder.mkdir()
    for name, camera in zip(flow.names, flow.cameras, strict=True):
        Image.fromarray(hidden_pixels(camera, [there]).numpy().astype(np.uint8) * 255).save(folder / f"{name}.png")
    flow.write(tmp_path / "m.nc")
    write_stl(tmp_path / "brick.stl", BRICK)
    refine = ["body", str(tmp_path / "m.nc"), str(tmp_path / "brick.stl"), "--refine", "--silhouettes", str(folder)]
    assert main([*refine, "-o", str(tmp_path / "refined.nc")]) == 0
    assert "turned by" in capsys.readouterr().out
    (body,) = Measurement.read(tmp_path / "refined.nc").bodies
    assert float((body.vertices.mean(dim=0) - there.vertices.mean(dim=0)).norm()) < 0.2
    hull = ["body", str(tmp_path / "m.nc"), "--silhouettes", str(folder), "-o", str(tmp_path / "hull.nc")]
    assert main(hull) == 0
    (body,) = Measurement.read(tmp_path / "hull.nc").bodies
    assert body.name == "hull"
    silhouettes = drawn_silhouettes({flow.names[0]: folder / f"{flow.names[0]}.png"}, flow)
    assert not bool(silhouettes[1:].any())


@pytest.fixture(scope="module")
def film(flow, tmp_path_factory) -> MeasurementSequence:
    """Two frames without a body."""
    sequence = MeasurementSequence.create(tmp_path_factory.mktemp("film") / "film.zarr", (0.0, 0.1), flow)
    for index in range(2):
        sequence.write_frame(index, flow)
    return sequence


POSES = "rx,ry,rz,tx,ty,tz\n0,0,0,0,0,0\n0,0,5,1.5,0,-1\n"


def test_a_body_that_moves_in_a_film(film, tmp_path, capsys):
    write_stl(tmp_path / "brick.stl", BRICK)
    (tmp_path / "poses.csv").write_text(POSES)
    words = ["body", str(film.path), str(tmp_path / "brick.stl"), "--poses", str(tmp_path / "poses.csv")]
    assert main([*words, "-o", str(tmp_path / "moving.zarr")]) == 0
    moving = MeasurementSequence.read(tmp_path / "moving.zarr")
    first, second = moving.frame(0), moving.frame(1)
    assert bool((first.hidden != second.hidden).any())
    there = turned(BRICK, (0.0, 0.0, 5.0), (1.5, 0.0, -1.0))
    torch.testing.assert_close(second.bodies[0].extent[1], there.extent[1], atol=1e-5, rtol=0)
    for content, message in (
        (POSES.rsplit("\n", 2)[0], "expected 2 rows"),
        ("a,b\n1,2\n", "columns rx"),
        (POSES.replace("1.5", "nan"), "row 2"),
    ):
        (tmp_path / "wrong.csv").write_text(content)
        words[4] = str(tmp_path / "wrong.csv")
        assert main([*words, "-o", str(tmp_path / "other.zarr")]) == 2
        assert message in capsys.readouterr().err
    for wrong, field in ((["--remove"], "models"), (["--silhouettes", str(tmp_path)], "silhouettes")):
        assert main([*words[:4], str(tmp_path / "poses.csv"), *wrong, "-o", str(tmp_path / "other.zarr")]) == 2
        assert field in capsys.readouterr().err
    assert main([*words[:4], str(tmp_path / "poses.csv"), "-o", str(film.path), "--force"]) == 2
    assert "frame by frame" in capsys.readouterr().err
    cold, grid = replace(COLD, max_steps=3), Grid.of_resolution(BOX, 16)
    settings = SequenceSettings(warm_steps=3, voxels=16, quantities=("index_excess",))
    plan = SequencePlan(moving.path, tmp_path / "r.zarr", cold, settings)
    SequenceStore.begin(plan.out, moving, grid, settings.quantities, cold.network, plan.attributes)
    reconstruct_frames(plan, 0, 2)
    result = SequenceStore(plan.out)
    for index, measurement in enumerate((first, second)):
        volume = result.volume(index, "index_excess")
        inside = contained(measurement.bodies, volume.grid.points())
        assert torch.equal(volume.values.isnan(), inside)
        assert bool(result.field(index)(torch.tensor([[12.0, 3.0, 2.0]])).isfinite().all())


def test_the_pose_in_each_frame_is_refined(flow, film, tmp_path):
    masked = MeasurementSequence.create(tmp_path / "seen.zarr", film.times, flow)
    places = [(0.0, 0.0, 0.0), (0.8, -0.5, 0.4)]
    for index, shift in enumerate(places):
        masked.write_frame(
            index, replace(flow, displacement=with_bodies(flow, [turned(BRICK, shift=shift)]).displacement)
        )
    whole = film_with_bodies(masked, tmp_path / "refined.zarr", [BRICK], refine=True)
    for index, shift in enumerate(places):
        (body,) = whole.frame(index).bodies
        expected = turned(BRICK, shift=shift).vertices.mean(dim=0)
        torch.testing.assert_close(body.vertices.mean(dim=0), expected, atol=0.2, rtol=0)
    assert not bool(whole.frame(0).usable.all())
