"""The pages Check and Displacement: a mirrored view found and undone, a model added, masks drawn and put in."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import trimesh

from app.visiting import visiting
from bodies import ball
from nerif.analysis.consistency_file import read_findings
from nerif.app.views.mask_editor import Brush
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.simulation.simulate import simulate

pytestmark = pytest.mark.anyio

BOX = Box.cube(50.0)


def measured(views: int, size: tuple[int, int], pitch: float, steps: int) -> Measurement:
    """A measurement of balls."""
    cameras = Ring(views=views, arc=(0.0, 150.0), image_size=size, pixel_pitch=pitch).cameras()
    return simulate(make_phantom("gaussians", BOX, 1), cameras, BOX, 1.00027, 0.05, 1, steps=steps)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A measurement by six views, one of which is mirrored in another."""
    project = tmp_path_factory.mktemp("project")
    good = measured(6, (30, 36), 0.12, 30)
    good.write(project / "good.nc")
    d = good.displacements.clone()
    d[3] = d[3].flip(1) * torch.tensor([-1.0, 1.0])
    replace(good, displacement=d).write(project / "bad.nc")
    return project


@pytest.mark.slow
async def test_a_comparison_is_a_run_whose_findings_are_shown_and_go_out_of_date(tmp_path):
    few = measured(3, (12, 14), 0.3, 10)
    few.write(tmp_path / "a <b>.nc")
    findings = tmp_path / ".nerif" / "checks" / "a <b>.json"
    async with visiting(tmp_path) as user:
        await user.open("check", "The views have not been compared yet.")
        user.put("voxels", 8)
        user.click("Compare the views")
        await user.sees_soon("Agreement")
        assert user.work.jobs.all()[0].title == "Check a <b>.nc"
        assert read_findings(findings).measurement == "a <b>.nc"
        few.write(tmp_path / "a <b>.nc")
        await user.open("check", "has changed since this comparison")
        assert user.lines()[0][-2:] == ["--voxels", "8"]
        findings.write_text("{}")
        await user.open("check", "check the measurement again")


@pytest.mark.slow
async def test_a_mirrored_view_is_found_and_undone(folder):
    words = ["check", "bad.nc", "--findings", ".nerif/checks/bad.json"]
    async with visiting(folder) as user:
        await user.open("check", "The views have not been compared yet.")
        assert user.lines()[0] == ["nerif", *words]
        user.click("Compare the views")
        await user.until(lambda: [job.arguments for job in user.work.jobs.all()] == [tuple(words)])
        await user.sees_soon("the image is mirrored left to right")
        user.click("Correct the mistakes")
        await user.sees_soon("Go on with bad.corrected.nc")
        corrected, good = Measurement.read(folder / "bad.corrected.nc"), Measurement.read(folder / "good.nc")
        torch.testing.assert_close(corrected.displacement, good.displacement)
        user.click("Go on with bad.corrected.nc")
        await user.until(lambda: "bad.corrected.nc" in user.lines()[0])


@pytest.mark.slow
async def test_a_model_is_added(tmp_path):
    body = ball(6.0)
    measured(3, (12, 14), 0.3, 10).write(tmp_path / "m.nc")
    trimesh.Trimesh(body.vertices.numpy(), body.faces.numpy(), process=False).export(tmp_path / "ball.stl")
    async with visiting(tmp_path) as user:
        await user.open("check", "Add the model")
        user.click("Add the model")
        await user.until(lambda: user.all(alt="Outlines of the model in each view"))
        assert [b.name for b in Measurement.read(tmp_path / "m.body.nc").bodies] == ["ball"]


@pytest.mark.slow
async def test_a_mask_is_drawn_taken_back_and_put_in(folder):
    drawing = folder / "masks" / "good" / "0deg.png"  # drawn elsewhere, with another program
    drawing.parent.mkdir(parents=True)
    drawing.write_bytes(b"of the user")
    async with visiting(folder) as user:
        await user.open("displacement", "Drawn in no view.")
        if user.control("Measurement").value != "good.nc":
            user.put("Measurement", "good.nc")
        await user.sees_soon("Close the polygon")
        for column, row in ((6, 4), (30, 4), (30, 25), (6, 25)):
            user.put("Column of the next corner (px)", column)
            user.put("Row of the next corner (px)", row)
            user.click("Add a corner")
        assert user.html.count("<circle") == 4
        user.click("Close the polygon")
        for label, visible in (("Undo", True), ("Redo", False)):
            assert ("<polygon class=flow" in user.html, "--drawings" in user.lines()[-1]) == (visible, visible)
            user.click(label)
        assert "<polygon class=flow" in user.html
        user.put("threshold", 4.5)
        await user.open("displacement", "Drawn in 0deg.")  # a reload loses nothing
        assert "<polygon class=flow" in user.html
        line = user.lines()[-1]
        assert line[line.index("--threshold") + 1] == "4.5"
        user.click("Show the threshold's mask")
        await user.sees_soon("Threshold mask of view 0deg")
        user.click("Apply the masks")
        await user.sees_soon("Go on with good.masked.nc")
        mask = Measurement.read(folder / "good.masked.nc").flow_mask
        assert bool(mask[0, 4:25, 6:30].all())
        assert not bool(mask[0, :3].any())
        assert drawing.read_bytes() == b"of the user"
        user.click("Go on with good.masked.nc")
        await user.until(lambda: user.control("Measurement").value == "good.masked.nc")
        user.put("Maps of all views", True)
        await user.sees_soon("valid pixels")


@pytest.mark.parametrize(("width", "larger", "expected"), [
    (8, True, 10), (1, True, 2), (100, True, 100), (8, False, 6), (2, False, 1), (1, False, 1), (None, True, 2),
])  # fmt: skip
def test_the_brush_grows_by_a_quarter_within_the_image(width, larger, expected):
    brush = Brush(width=width)
    brush.resize(larger, 100)
    assert brush.width == expected
