"""The Images page in a real browser: what is wrong is named; crops by mouse and numbers, undone, kept, written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from app.serving import Served, opened
from nerif.app.project.folder import ProjectFolder
from nerif.app.project.image_cache import ImageCache
from nerif.app.views.edits import Edits
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import find_views
from report.browsing import errors, needs_browser, requests, text, wait_for

HEIGHT, WIDTH = 48, 64
NAMES = ("cam1", "cam <2>", "cam3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three views: one in order, one with a broken image, one without flow."""
    directory = tmp_path_factory.mktemp("project")
    rng = np.random.default_rng(3)
    for name in NAMES:
        for source in ("reference", "flow"):
            if (name, source) == ("cam3", "flow"):
                continue
            where = directory / "run" / name / source
            where.mkdir(parents=True)
            scene = rng.integers(20, 220, (HEIGHT, WIDTH), dtype=np.uint8)
            for i in range(2):
                iio.imwrite(where / f"p{i}.png", scene)
    (directory / "run" / "cam <2>" / "reference" / "p1.png").write_bytes(b"broken")
    return directory


def test_steps_are_undone_and_kept():
    one, other = Crop(row=2), Crop(row=2, flip="both")

    def read(entries: dict[str, Any]) -> Crop:
        return Crop(**entries)

    edits = Edits({"a": Crop(), "b": Crop()}, read)
    edits.put("a", one)
    edits.put("a", other)
    edits.put("b", one)
    assert edits.undo() == "b"
    assert edits.undo() == "a"
    assert edits.now == {"a": one, "b": Crop()}
    again = Edits({"a": Crop(), "b": Crop()}, read, edits.draft)
    assert again.redo() == "a"
    assert again.changes == {"a": other}
    again.put("b", other)
    assert again.redo() == ""
    assert Edits({"b": Crop()}, read, edits.draft).undo() == ""  # its view has gone


def visit(driver: Any, server: Served) -> None:
    """Open the page and wait until all views have been looked at."""
    opened(driver, server, "images", "document.querySelectorAll('.view button').length === 3")
    wait_for(driver, "return document.querySelector('.both img.flow')?.complete")


def value(driver: Any, name: str) -> str:
    """What stands in a number."""
    return str(driver.execute_script(f"return document.querySelector('input[name={name}]').value"))


def click(driver: Any, label: str) -> None:
    """Click a button of the view that is shown large."""
    driver.find_element("xpath", f"//*[contains(@class, 'crop-card')]//button[contains(., '{label}')]").click()


@needs_browser
def test_what_is_there_and_what_is_wrong(browser, server):
    visit(browser, server)
    listed = "[...document.querySelectorAll('.notes[aria-label] li')]"
    wrong = browser.execute_script(f"return {listed}.map(e => e.textContent)")
    assert len(wrong) == 2
    assert wrong[0].startswith("cam <2>/reference/p1.png: cannot be read")
    assert wrong[1].startswith("view 'cam3': no flow images; expected")
    assert browser.execute_script("return document.querySelectorAll('.pair img').length") == 5
    assert browser.execute_script("return document.querySelectorAll('.histogram svg[aria-label]').length") == 5
    assert "0.00% saturated" in text(browser, ".share")
    assert errors(browser) == []
    here = f"http://127.0.0.1:{server.port}/", f"ws://127.0.0.1:{server.port}/"
    assert [a for a in requests(browser) if not a.startswith((*here, "data:"))] == []


@pytest.mark.slow
@needs_browser
def test_reference_and_flow_change_places_by_key_and_clock(browser, server):
    from selenium.webdriver.common.keys import Keys

    visit(browser, server)
    both = browser.find_element("css selector", ".both")
    both.send_keys(Keys.SPACE)
    assert text(browser, ".current") == "Flow"
    both.send_keys(Keys.SPACE)
    assert text(browser, ".current") == "Reference"
    click(browser, "Blink")
    wait_for(browser, "return document.querySelector('.current').textContent === 'Flow'")
    click(browser, "Blink")
    calm = [{"name": "prefers-reduced-motion", "value": "reduce"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": calm})
    click(browser, "Blink")
    assert "Reduced motion" in text(browser, ".calm")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@needs_browser
def test_a_crop_is_drawn_undone_typed_kept_and_written(browser, server, folder):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    visit(browser, server)
    place = browser.find_element("css selector", ".cropper")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", place)
    width, height = place.size["width"], place.size["height"]
    drag = ActionChains(browser).move_to_element_with_offset(place, -width // 4, -height // 4).click_and_hold()
    drag.move_by_offset(width // 4, height // 4).release().perform()
    wait_for(browser, "return document.querySelector('input[name=column]').value === '16'")
    assert [value(browser, name) for name in ("row", "width", "height")] == ["12", "16", "12"]
    click(browser, "Undo")
    wait_for(browser, "return document.querySelector('input[name=column]').value === '0'")
    click(browser, "Redo")
    wait_for(browser, "return document.querySelector('input[name=column]').value === '16'")
    box = browser.find_element("css selector", "input[name=width]")
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("900")
    wait_for(browser, "return document.querySelector('.crop-card .error span') !== null")
    assert "Expected a crop within its 48 x 64 px" in text(browser, ".crop-card .error span")
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("20")
    wait_for(browser, "return document.querySelector('.crop-card .error span') === null")
    assert not (folder / "run" / "views.toml").exists()
    visit(browser, server)  # a reload loses nothing
    assert value(browser, "width") == "20"
    click(browser, "Save to views.toml")
    saved = "document.querySelector('.crop-card p[role=status]')?.textContent.startsWith('The commands')"
    wait_for(browser, f"return {saved}")
    crops = {view.name: view.crop for view in find_views(folder / "run")}
    assert crops["cam1"] == Crop(row=12, column=16, height=12, width=20)
    assert crops["cam <2>"] is None
    assert errors(browser) == []


def test_images_are_kept_until_their_files_change(folder, monkeypatch):
    files = ImageCache(ProjectFolder(folder))
    view = next(v for v in find_views(folder / "run") if v.name == "cam1")
    monkeypatch.setattr("nerif.app.project.image_cache.LIMIT", 2)
    first = files.image(view, "flow", 0, 280, None)
    assert files.image(view, "flow", 0, 280, None) is first
    files.image(view, "flow", 1, 280, None)
    assert files.image(view, "flow", 0, 280, None) is first  # it is the other one that was asked for longer ago
    files.image(view, "flow", 0, 32, None)
    assert files.image(view, "flow", 0, 280, None) is first
    iio.imwrite(folder / "run" / "cam1" / "flow" / "p0.png", np.full((HEIGHT, WIDTH), 90, np.uint8))
    assert files.image(view, "flow", 0, 280, None) != first


@needs_browser
def test_the_view_that_is_chosen_last_is_the_one_shown_large(browser, server):
    visit(browser, server)
    script = "document.querySelectorAll('.view button').forEach(b => b.click())"
    browser.execute_script(script)
    wait_for(browser, "return document.querySelector('.crop-card h2')?.textContent === 'cam3'")
    wait_for(browser, "return document.querySelectorAll('.crop-card .cropper').length === 1")
    box = browser.execute_script("return document.querySelector('.cropper').getBoundingClientRect().toJSON()")
    assert box["width"] / box["height"] == pytest.approx(WIDTH / HEIGHT, rel=0.02)
    assert errors(browser) == []
