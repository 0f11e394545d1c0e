"""The Calibration page: corners, images left out by a click, the rig, a ruler, settings beside the images."""

from __future__ import annotations

import pytest

from app.projects import TARGET
from app.visiting import visiting
from nerif.app.pages.calibration import form_of
from nerif.data.cameras_file import read_cameras

pytestmark = pytest.mark.anyio


def test_settings_beside_the_images_are_the_defaults():
    form = form_of(False, {"target": {"columns": 8, "rows": 5}, "world": "0"})
    assert form.field("target.columns").default == 8
    assert form.field("world").default == "0"
    assert form.arguments({"target.columns": 9}) == ["--target.columns", "9"]
    assert not {"simple", "leave_out", "distance"} & {f.name for f in form.fields}
    assert {"distance", "background_distance"} <= {f.name for f in form_of(True).fields}


async def test_corners_are_found_and_an_image_is_left_out_by_a_click(folder):
    cameras = read_cameras(folder / "made.toml")
    points = TARGET.shape[0] * TARGET.shape[1]
    async with visiting(folder) as user:
        await user.open("calibration", "cam1/target/2")
        await user.sees_soon(*(camera.name for camera in cameras))
        assert user.html.count("<circle") == 0
        for name, value in (("target.kind", "chessboard"), ("target.columns", 8.0), ("target.rows", 5.0)):
            user.put(name, value)
        await user.until(lambda: user.html.count("<circle") == 3 * points)
        assert f'alt="cam1/target/0, {points} points found"' in user.html
        assert 'alt="cam1/target/2, no target found"' in user.html
        user.click("Exclude: cam1/target/1")
        words = user.lines()[0]
        assert words[:4] == ["nerif", "calibrate", "run", "-o"]
        assert words[words.index("--leave-out") + 1] == "cam1/target/1"
        await user.open("calibration", "cam1/target/2")  # a reload loses nothing
        await user.sees_soon("Include")
        assert user.lines()[0] == words
        user.click("Include: cam1/target/1")
        assert "--leave-out" not in user.lines()[0]


async def test_a_camera_from_a_ruler(folder):
    async with visiting(folder) as user:
        await user.open("calibration", "The rig")
        await user.sees_soon("Calibrate")
        user.put("From", True)
        await user.until(lambda: user.all(name="mm_per_px"))
        for name, value in (("distance", 900.0), ("mm_per_px", 0.5), ("background_distance", 400.0)):
            user.put(name, value)
        user.put("More settings", True)
        user.put("views", "cam3")
        assert user.lines()[0][-2:] == ["--views", "cam3"]
        user.click("Calibrate")
        await user.sees_soon("It is done.", "calibration.toml is there; it is replaced.")
        assert [camera.name for camera in read_cameras(folder / "calibration.toml")] == ["cam3"]
        await user.sees_soon("cam3", "96 × 64")
        assert "--force" in user.lines()[0]
