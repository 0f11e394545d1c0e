"""The pages Check and Displacement by clicks: a mirrored view found and undone, masks drawn, taken back, and put in."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh

from app.serving import opened
from app.test_pages import line, put
from app.test_results import pick
from bodies import ball
from nerif.analysis.consistency_file import read_findings
from nerif.app.project.jobs import CommandRun, Jobs
from nerif.app.views.mask_editor import Brush
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.simulation.simulate import simulate
from report.browsing import drag, errors, needs_browser, text, wait_for

pytestmark = needs_browser

BOX = Box.cube(50.0)
COMPARISON = "document.querySelector('.command code').textContent"
LINE = "document.querySelector('.command code') !== null"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A measurement by six views, one of which is mirrored."""
    directory = tmp_path_factory.mktemp("project")
    ring = Ring(views=6, arc=(0.0, 150.0), image_size=(30, 36), pixel_pitch=0.12)
    good = simulate(make_phantom("gaussians", BOX, 1), ring.cameras(), BOX, 1.00027, 0.05, 1, steps=30)
    good.write(directory / "good.nc")
    d = good.displacements.clone()
    d[3] = d[3].flip(1) * torch.tensor([-1.0, 1.0])
    replace(good, displacement=d).write(directory / "bad.nc")
    return directory


def click(driver: Any, label: str) -> None:
    """Press a button by what it says."""
    wait_for(driver, f"return [...document.querySelectorAll('button')].some(b => b.textContent.includes({label!r}))")
    button = driver.find_element("xpath", f"//button[contains(., {label!r})]")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'}); arguments[0].click()", button)


def written(path: Path, seconds: float = 60.0) -> Measurement:
    """Wait for a file that a run writes, and read it."""
    end = time.monotonic() + seconds
    while not path.is_file():
        assert time.monotonic() < end, f"no {path.name}"
        time.sleep(0.1)
    return Measurement.read(path)


def ended(jobs: Jobs, seconds: float) -> CommandRun:
    """Wait for the end of the last run."""
    end = time.monotonic() + seconds
    while (job := jobs.all()[0]).state in ("queued", "running"):
        assert time.monotonic() < end
        time.sleep(0.1)
    return job


@pytest.mark.slow
def test_a_comparison_is_a_run_whose_findings_are_shown_and_go_out_of_date(browser, server, folder):
    small = Ring(views=3, arc=(0.0, 100.0), image_size=(12, 14), pixel_pitch=0.3).cameras()
    few = simulate(make_phantom("gaussians", BOX, 1), small, BOX, 1.00027, 0.05, 1, steps=10)
    few.write(folder / "a <b>.nc")  # the first of the names
    opened(browser, server, "check", f"{LINE} && {COMPARISON}.includes('a <b>.nc')")
    put(browser, "voxels", "8")
    wait_for(browser, f"return {COMPARISON}.endsWith('--voxels 8')")
    click(browser, "Compare the views")
    wait_for(browser, "return document.querySelectorAll('.tabled tbody tr').length === 3", 60)
    assert Jobs(folder).all()[0].title == "Check a <b>.nc"
    assert read_findings(folder / ".nerif" / "checks" / "a <b>.json").measurement == "a <b>.nc"
    few.write(folder / "a <b>.nc")
    opened(browser, server, "check", "document.querySelector('.tabled table') !== null")
    assert "has changed since this comparison" in text(browser, 'section[aria-label="Findings"]')
    (folder / ".nerif" / "checks" / "a <b>.json").write_text("no findings")
    opened(browser, server, "check", LINE)
    assert "check the measurement again" in text(browser, 'section[aria-label="Findings"]')
    (folder / "a <b>.nc").unlink()
    assert errors(browser) == []


@pytest.mark.slow
def test_a_mirrored_view_is_found_and_undone(browser, server, folder):
    opened(browser, server, "check", LINE)
    assert text(browser, 'section[aria-label="Findings"]').endswith("The views have not been compared yet.")
    words = ["check", "bad.nc", "--findings", ".nerif/checks/bad.json"]
    put(browser, "voxels", "24")  # another test may have left fewer
    wait_for(browser, f"return {COMPARISON}.endsWith('bad.json')")
    assert line(browser) == ["nerif", *words]
    click(browser, "Compare the views")
    jobs = Jobs(folder)
    wait_for(browser, "return document.querySelector('.status').textContent.startsWith('It ')")
    assert jobs.all()[0].arguments == tuple(words)
    browser.get("about:blank")  # the run does not depend on the page
    ended(jobs, 120)
    opened(browser, server, "check", LINE)
    wait_for(browser, "return document.querySelector('.tabled table') !== null")
    assert "the image is mirrored left to right" in text(browser, ".tabled table")
    click(browser, "Correct the mistakes")
    directory, good = written(folder / "bad.corrected.nc", 120), Measurement.read(folder / "good.nc")
    torch.testing.assert_close(directory.displacement, good.displacement)
    click(browser, "Go on with bad.corrected.nc")
    wait_for(browser, f"return {COMPARISON}.includes('bad.corrected.nc')")
    assert errors(browser) == []


@pytest.mark.slow
def test_a_mask_is_drawn_taken_back_and_put_in(browser, server, folder):
    drawing = folder / "masks" / "good" / "0deg.png"  # drawn elsewhere, with another program
    drawing.parent.mkdir(parents=True)
    drawing.write_bytes(b"of the user")
    opened(browser, server, "displacement", LINE)
    wait_for(browser, "return document.querySelector('.cropper img') !== null")
    for column, row in ((6, 4), (30, 4), (30, 25), (6, 25)):
        for label, value in (("Column", column), ("Row", row)):
            box = browser.find_element("css selector", f"input[aria-label='{label} of the next corner (px)']")
            box.send_keys("\ue009" + "a" + "\ue000", str(value))
        click(browser, "Add a corner")
    wait_for(browser, "return document.querySelectorAll('.over .draft circle').length === 4")
    click(browser, "Close the polygon")
    wait_for(browser, "return document.querySelector('.over polygon.flow') !== null")
    assert "--drawings" in text(browser, ".command code")
    click(browser, "Undo")
    wait_for(browser, "return document.querySelector('.over polygon.flow') === null")
    click(browser, "Redo")
    wait_for(browser, "return document.querySelector('.over polygon.flow') !== null")
    opened(browser, server, "displacement", LINE)  # a reload loses nothing
    wait_for(browser, "return document.querySelector('.over polygon.flow') !== null")
    click(browser, "Apply the masks")
    (out,) = [word for word in text(browser, ".command code").split() if word.endswith(".masked.nc")]
    mask = written(folder / out).flow_mask
    assert bool(mask[0, 4:25, 6:30].all())
    assert not bool(mask[0, :3].any())
    assert drawing.read_bytes() == b"of the user"
    click(browser, f"Go on with {out}")
    wait_for(browser, f"return document.querySelector('input[aria-label=Measurement]').value === {out!r}")
    assert errors(browser) == []


@pytest.mark.slow
def test_what_is_typed_for_a_run_survives_a_reload(browser, server):
    opened(browser, server, "check", LINE)
    put(browser, "voxels", "16")
    wait_for(browser, f"return {COMPARISON}.includes('--voxels 16')")
    opened(browser, server, "displacement", LINE)
    wait_for(browser, "return document.querySelector('input[name=threshold]') !== null")
    put(browser, "threshold", "4.5")
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('--threshold 4.5')")
    opened(browser, server, "check", LINE)
    wait_for(browser, f"return {COMPARISON}.includes('--voxels 16')")
    opened(browser, server, "displacement", LINE)
    wait_for(browser, "return document.querySelector('.command code')?.textContent.includes('--threshold 4.5')")
    assert errors(browser) == []


# -- keys of the mask editor -------------------------------------------------------------------------------------

WIDTH = "Number(document.querySelector('input[aria-label=\"Width of the brush (px)\"]').value)"
STROKES = "document.querySelectorAll('.over .brush').length"
EFFECT = "document.querySelector('[aria-label=\"Effect of the shape\"] [aria-pressed=true]').textContent"


def keys(driver: Any, *presses: str) -> None:
    """Press keys where the focus is; Ctrl+ and Shift+ before a key hold these."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    for press in presses:
        *holds, key = press.split("+") if len(press) > 1 else [press]
        chain = ActionChains(driver)
        modifiers = [{"Ctrl": Keys.CONTROL, "Shift": Keys.SHIFT}[hold] for hold in holds]
        for modifier in modifiers:
            chain.key_down(modifier)
        chain.send_keys(key)
        for modifier in modifiers:
            chain.key_up(modifier)
        chain.perform()


@pytest.mark.slow
def test_keys_of_the_brush_act_in_the_editor_alone(browser, server):
    opened(browser, server, "displacement", LINE)
    wait_for(browser, "return document.querySelector('.cropper img') !== null")
    click(browser, "Brush")
    drag(browser, ".cropper", 30, 20)
    wait_for(browser, f"return {STROKES} === 1")
    assert browser.execute_script("return document.activeElement.className").startswith("cropper")
    keys(browser, "]", "]")
    wait_for(browser, f"return {WIDTH} === 12")
    keys(browser, *"[[[[")
    wait_for(browser, f"return {WIDTH} === 5")
    assert browser.execute_script(f"return {EFFECT}") == "Flow is here"
    keys(browser, "e")
    wait_for(browser, f"return {EFFECT} === 'No flow here'")
    drag(browser, ".cropper", -30, 20)
    wait_for(browser, "return document.querySelectorAll('.over .none.brush').length === 1")
    keys(browser, "Ctrl+z")
    wait_for(browser, f"return {STROKES} === 1")
    keys(browser, "Ctrl+Shift+z")
    wait_for(browser, f"return {STROKES} === 2")
    keys(browser, "Ctrl+z", "Ctrl+z")  # the focus stays
    wait_for(browser, f"return {STROKES} === 0")
    click(browser, "Polygon")
    drag(browser, ".cropper", 10, 10)
    drag(browser, ".cropper", 20, 10)
    wait_for(browser, "return document.querySelectorAll('.over .draft circle').length === 2")
    keys(browser, "Ctrl+z")
    wait_for(browser, "return document.querySelectorAll('.over .draft circle').length === 1")
    column = browser.find_element("css selector", "input[aria-label='Column of the next corner (px)']")
    column.click()
    keys(browser, "e", "[", "Ctrl+z")  # keys of the field
    browser.execute_script("document.activeElement.blur()")
    keys(browser, "e", "]")  # outside of the editor
    browser.execute_async_script("setTimeout(arguments[0], 500)")
    assert browser.execute_script(f"return [{EFFECT}, {WIDTH}]") == ["No flow here", 5]
    assert browser.execute_script("return document.querySelectorAll('.over .draft circle').length") == 1
    assert errors(browser) == []


def test_an_undo_by_key_in_another_view_shows_that_view_and_keeps_the_keys(browser, server, folder):
    opened(browser, server, "displacement", LINE)
    wait_for(browser, "return document.querySelector('.cropper img') !== null")
    click(browser, "Brush")
    drag(browser, ".cropper", 30, 20)
    wait_for(browser, f"return {STROKES} === 1")
    browser.execute_script(
        "document.querySelector('[aria-label=\"View to draw in\"]').scrollIntoView({block: 'center'})"
    )
    pick(browser, "View to draw in", "60deg")
    wait_for(browser, "return document.querySelector('.cropper img').alt.endsWith('60deg')")
    drag(browser, ".cropper", 30, 20)  # the tool stays
    wait_for(browser, f"return {STROKES} === 1")
    keys(browser, "Ctrl+z")
    wait_for(browser, f"return {STROKES} === 0")
    keys(browser, "Ctrl+z")
    wait_for(browser, "return document.querySelector('.cropper img').alt.endsWith('0deg') && "
                      "!document.querySelector('.cropper img').alt.endsWith('60deg')")  # fmt: skip
    wait_for(browser, "return document.activeElement.className.startsWith('cropper')")
    keys(browser, "Ctrl+Shift+z")
    wait_for(browser, f"return {STROKES} === 1")
    keys(browser, "Ctrl+z")
    wait_for(browser, f"return {STROKES} === 0")
    assert errors(browser) == []


@pytest.mark.parametrize(("width", "larger", "expected"), [
    (8, True, 10), (1, True, 2), (100, True, 100), (8, False, 6), (2, False, 1), (1, False, 1), (None, True, 2),
])  # fmt: skip
def test_the_brush_grows_by_a_quarter_within_the_image(width, larger, expected):
    brush = Brush(width=width)
    brush.resize(larger, 100)
    assert brush.width == expected


@pytest.mark.slow
def test_a_model_is_added(browser, server, folder):
    body = ball(6.0)
    trimesh.Trimesh(body.vertices.numpy(), body.faces.numpy(), process=False).export(folder / "ball.stl")
    opened(browser, server, "check", LINE)
    click(browser, "Add the model")
    (added,) = written(folder / "bad.body.nc").bodies
    assert ended(Jobs(folder), 60).state == "done"
    assert added.name == "ball"
    wait_for(browser, 'return document.querySelector(\'[alt^="Outlines"] img, img[alt^="Outlines"]\') !== null', 30)
    for name in ("ball.stl", "bad.body.nc", "bad.body.bodies.png"):
        (folder / name).unlink()
    assert errors(browser) == []
