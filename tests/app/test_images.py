"""The Images page: what is wrong is named, crops are typed, undone, kept and written; images are cached."""

from __future__ import annotations

import imageio.v3 as iio
import numpy as np
import pytest

from app.visiting import visiting
from nerif.app.project.folder import CACHED, ProjectFolder
from nerif.app.project.image_cache import ImageCache
from nerif.app.views.edits import Edits
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import find_views

pytestmark = pytest.mark.anyio


def test_steps_are_undone_and_kept():
    one, other, original = Crop(row=2), Crop(row=2, flip="both"), {"a": Crop(), "b": Crop()}
    edits = Edits(original, lambda entries: Crop(**entries))
    for view, crop in (("a", one), ("a", other), ("b", one)):
        edits.put(view, crop)
    assert [edits.step(True), edits.step(True)] == ["b", "a"]
    assert edits.now == {"a": one, "b": Crop()}
    again = Edits(original, lambda entries: Crop(**entries), edits.draft)
    assert again.step(False) == "a"
    assert again.changes == {"a": other}
    again.put("b", other)
    assert again.step(False) == ""
    assert Edits({"b": Crop()}, lambda entries: Crop(**entries), edits.draft).step(True) == ""  # its view has gone


async def test_what_is_wrong_is_named_and_a_crop_is_typed_undone_kept_and_written(folder):
    async with visiting(folder) as user:
        await user.open("images", "3 views.")
        await user.sees_soon("cam <2>/reference/p1.png: cannot be read", "view 'cam3': no flow images; expected")
        await user.until(lambda: len([e for e in user.all(loading="lazy") if e.tag == "img"]) == 5)
        assert user.html.count("class=histogram") == 5
        assert user.sees("0.00% saturated")
        user.fire(next(e for e in user.all() if "cropper" in e.classes), "pointerdown", [0.25, 0.125, 0.5, 0.375])
        await user.until(lambda: user.control("column").value == 24)
        assert [user.control(name).value for name in ("row", "width", "height")] == [8, 24, 16]
        for label, column in (("Undo", 0), ("Redo", 24)):
            user.click(label)
            await user.until(lambda column=column: user.control("column").value == column)
        user.put("width", 900)
        await user.sees_soon("Expected a crop within its 64 x 96 px")
        user.put("width", 20)
        await user.until(lambda: not user.sees("Expected a crop"))
        assert user.sees("run/views.toml is not written yet for cam1")
        assert not (folder / "run" / "views.toml").exists()
        await user.open("images", "3 views.")  # a reload loses nothing
        await user.sees_soon("is not written yet for cam1")
        assert user.control("width").value == 20
        user.click("Save to views.toml")
        await user.sees_soon("run/views.toml is written.", "The commands see the views")
        crops = {view.name: view.crop for view in find_views(folder / "run")}
        assert crops == {"cam1": Crop(row=8, column=24, height=16, width=20), "cam <2>": None, "cam3": None}
        await user.sees_soon("Look closer, crop, turn")
        for name in ("cam1", "cam <2>", "cam3"):  # the last one is shown large
            await user.until(lambda name=name: user.all(aria_label=f"Look closer at {name}, crop or turn it"))
            user.click(f"Look closer at {name}")
        await user.until(lambda: [e.props["alt"] for e in user.all(draggable="false")] == ["Whole frame of cam3"])


def test_images_are_kept_until_their_files_change(folder, monkeypatch):
    files, path = ImageCache(ProjectFolder(folder)), folder / "run" / "cam3" / "reference"
    view = next(v for v in find_views(folder / "run") if v.name == "cam3")
    monkeypatch.setitem(CACHED, "image", 2)

    def image(number: int, largest: int = 280) -> str:
        return files.image(view, "reference", number, largest, None)

    first = image(0)
    for other in ((0,), (1,), (0, 32)):  # the least recently used one goes
        image(*other)
        assert image(0) is first
    iio.imwrite(path / "p0.png", np.full((64, 96), 90, np.uint8))
    assert image(0) != first
