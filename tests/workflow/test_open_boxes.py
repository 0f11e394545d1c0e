"""Flow that leaves the box: rays through open faces are left out, or kept while the box grows."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.analysis.evaluation import evaluate
from nerif.fields.network import NetworkShape
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.reconstruction_run import grown
from nerif.workflow.run_settings import RunSettings
from refusals import refused

WHOLE, CUT = Box.cube(40.0), Box((-20.0, -20.0, -20.0), (20.0, 20.0, 2.0))
QUIET = RunSettings(report=False, withhold=(), detail="off", extend_open_faces=8.0)
SHAPE = NetworkShape(depth=2, width=32, octaves=3)
SHORT = NeRIF(
    network=SHAPE, samples=(12, 16), points_per_batch=1024, max_steps=100, open_faces=("z+",), device="cpu",
    precision="float32",
)  # fmt: skip
VOXELS = Tikhonov(voxels=16, open_faces=("z+",), device="cpu")


@pytest.fixture(scope="module")
def cut():
    """A flow that passes through the face z+, in views from above and below."""
    ring = Ring(views=5, arc=(0.0, 144.0), elevation=15.0, image_size=(24, 26), pixel_pitch=0.13)
    field = make_phantom("gaussians", WHOLE, 1)
    return replace(simulate(field, ring.cameras(), WHOLE, 1.00027, 0.05, seed=1, steps=30), box=CUT), field


def test_the_box_grows_through_the_named_faces():
    assert CUT.grown(("z+", "x-"), 3.0) == Box((-23.0, -20.0, -20.0), (20.0, 20.0, 5.0))
    assert CUT.grown((), 3.0) == CUT


def test_growing_keeps_the_size_of_voxels_and_the_other_ambient_faces(cut):
    measurement, _ = cut
    larger, settings = grown(replace(measurement, ambient_faces=("x-", "z+")), VOXELS, 8.0)
    assert larger.box.upper == (20.0, 20.0, 10.0)
    assert larger.ambient_faces == ("x-",)
    assert settings.open_faces == ()
    assert settings.voxels == 16  # the longest edge is across
    with refused("extend_open_faces"):
        grown(measurement, replace(SHORT, open_faces=()), 8.0)


@pytest.mark.parametrize("method", [SHORT, VOXELS], ids=["nerif", "tikhonov"])
def test_the_result_is_that_of_the_box(cut, method, tmp_path):
    measurement, truth = cut
    measurement.write(tmp_path / "m.nc")
    result = reconstruct_into(tmp_path / "r", tmp_path / "m.nc", method, QUIET, voxels=16)
    assert result.box == CUT
    directory = ResultDirectory(tmp_path / "r")
    field, box, _ = directory.field()
    assert box == CUT
    points = torch.rand(200, 3) * torch.tensor([30.0, 30.0, 20.0]) + torch.tensor([-15.0, -15.0, -18.0])
    torch.testing.assert_close(field(points), result.field(points))
    settings = directory.settings()
    assert list(settings["open_faces"]) == ["z+"]
    assert settings["extend_open_faces"] == 8.0
    before = directory.metrics().views
    evaluate(tmp_path / "r", measurement=tmp_path / "m.nc")
    after = directory.metrics().views
    assert [view["rms"] for view in after] == pytest.approx([view["rms"] for view in before], rel=0.02)
    without = replace(QUIET, extend_open_faces=0.0)
    left_out = reconstruct_into(tmp_path / "left-out", tmp_path / "m.nc", method, without, voxels=16)
    errors = [float((r.field(points) - truth(points)).norm()) for r in (result, left_out)]
    assert errors[0] < errors[1]
