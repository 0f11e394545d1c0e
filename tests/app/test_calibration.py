"""The Calibration page in a real browser: corners, errors, images left out by a click, the rig, a ruler."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from app.serving import Served, opened, served
from app.test_pages import line, put
from calibration_images import target_images
from nerif.app.pages.calibration import form_of
from nerif.cli.cli import main
from nerif.data.cameras_file import read_cameras
from nerif.geometry import Ring
from nerif.imaging.calibration.calibrate import calibrate
from nerif.imaging.calibration.targets import CalibrationTarget
from report.browsing import errors, needs_browser, wait_for

TARGET = CalibrationTarget("chessboard", 8, 5, pitch=12.0)
NAMES = ("cam1", "cam2", "cam3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three views with images of an upright target, one without; a calibration from the command line's library."""
    project = tmp_path_factory.mktemp("project")
    board = (40 + 170 * TARGET.raster(TARGET.pitch / 8)).astype(np.uint8)
    for name in NAMES:
        for source, count in (("target", 3), ("background", 1), ("reference", 1)):
            (project / "run" / name / source).mkdir(parents=True)
            for i in range(count):
                image = np.full((64, 96), 210, np.uint8)
                if (source, i) != ("target", 2):
                    image[4 : 4 + board.shape[0], 6 + i : 6 + i + board.shape[1]] = board
                iio.imwrite(project / "run" / name / source / f"p{i}.png", image)
    cameras = Ring(views=3, arc=(20.0, 100.0), image_size=(64, 96), pixel_pitch=0.17).cameras()
    calibrate(target_images(cameras, TARGET, noise=0.01, poses=8)).write(project / "made.toml")
    return project


def visit(driver: Any, server: Served) -> None:
    """Open the page and wait until all is drawn."""
    opened(driver, server, "calibration", "document.querySelectorAll('.target').length >= 1")


def choose(driver: Any, label: str, option: str) -> None:
    """Choose from a list."""
    driver.find_element("css selector", f"[aria-label='{label}']").click()
    wait_for(driver, "return document.querySelector('.q-menu .q-item') !== null")
    item = f"//div[contains(@class, 'q-menu')]//div[contains(@class, 'q-item')][contains(., '{option}')]"
    driver.find_element("xpath", item).click()
    wait_for(driver, "return document.querySelector('.q-menu') === null")


def test_settings_beside_the_images_are_the_defaults():
    form = form_of(False, {"target": {"columns": 8, "rows": 5}, "world": "0"})
    assert form.field("target.columns").default == 8
    assert form.field("world").default == "0"
    assert form.arguments({"target.columns": 9}) == ["--target.columns", "9"]
    assert not {"simple", "leave_out", "distance"} & {f.name for f in form.fields}
    assert {"distance", "background_distance"} <= {f.name for f in form_of(True).fields}


@pytest.mark.slow
@needs_browser
def test_corners_are_found_and_a_image_is_left_out_by_a_click(browser, server):
    visit(browser, server)
    assert browser.execute_script("return document.querySelectorAll('.target circle').length") == 0
    choose(browser, "Target: kind", "chessboard")
    put(browser, "target.columns", "8")
    put(browser, "target.rows", "5")
    points = TARGET.shape[0] * TARGET.shape[1]
    wait_for(browser, f"return document.querySelectorAll('.target circle').length === {3 * points}")
    texts = browser.execute_script("return [...document.querySelectorAll('.target img')].map(e => e.alt)")
    assert texts[0] == f"cam1/target/0, {points} points found"
    assert texts[2] == "cam1/target/2, no target found"
    browser.find_element("css selector", "button[aria-label='Exclude: cam1/target/1']").click()
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('--leave-out')")
    words = line(browser)
    assert words[:4] == ["nerif", "calibrate", "run", "-o"]
    assert words[words.index("--leave-out") + 1] == "cam1/target/1"
    visit(browser, server)  # a reload loses nothing
    wait_for(browser, "return document.querySelectorAll('.target.left-out').length === 1")
    assert line(browser) == words
    browser.find_element("css selector", "button[aria-label='Include: cam1/target/1']").click()
    wait_for(browser, "return !document.querySelector('.command code').textContent.includes('--leave-out')")
    assert errors(browser) == []


@needs_browser
def test_the_rig_of_a_calibration_that_is_there(browser, server, folder):
    visit(browser, server)
    wait_for(browser, "return document.querySelector('canvas') !== null")
    rows = browser.execute_script("return [...document.querySelectorAll('.tabled tbody th')].map(e => e.textContent)")
    assert rows == [camera.name for camera in read_cameras(folder / "made.toml")]


@pytest.mark.slow
@needs_browser
def test_a_camera_from_a_ruler(browser, server, folder):
    visit(browser, server)
    choose(browser, "From", "A ruler")
    wait_for(browser, "return document.querySelector('input[name=distance]') !== null")
    for name, value in (("distance", "900"), ("mm_per_px", "0.5"), ("background_distance", "400")):
        put(browser, name, value)
    browser.find_element("css selector", ".more .q-item").click()
    wait_for(browser, "return document.querySelector('input[name=views]')?.checkVisibility() && "
                      "document.getAnimations().length === 0")  # fmt: skip
    put(browser, "views", "cam2")
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('--views cam2')")
    browser.find_element("xpath", "//button[contains(., 'Calibrate')]").click()
    wait_for(browser, "return document.querySelector('.status')?.textContent === 'It is done.'", 60)
    (camera,) = read_cameras(folder / "calibration.toml")
    assert camera.name == "cam2"
    wait_for(browser, "return document.querySelector('.tabled tbody th').textContent === 'cam2'")
    assert line(browser)[-1] == "--force"
    assert errors(browser) == []


@needs_browser
@pytest.mark.slow
def test_a_calibration_by_its_settings_file(browser, tmp_path):
    words = ["--phantom", "gaussians", "--views", "4", "--arc", "10", "120", "--image-size", "96", "112"]
    words += ["--pixel-pitch", "0.0425", "--background-distance", "900", "--references", "1", "--poses", "10"]
    assert main(["render", "-o", str(tmp_path / "run"), *words, "--backgrounds", "2", "--truth-voxels", "8"]) == 0
    with served(tmp_path) as server:
        visit(browser, server)
        assert "--config" in line(browser)
        wait_for(browser, "return document.querySelector('[aria-label=\"Exclude: 10deg/target/3\"]') !== null")
        browser.find_element("css selector", "button[aria-label='Exclude: 10deg/target/3']").click()
        wait_for(browser, "return document.querySelector('.command code').textContent.includes('--leave-out')")
        browser.find_element("xpath", "//button[contains(., 'Calibrate')]").click()
        wait_for(browser, "return document.querySelector('.status')?.textContent === 'It is done.'", 60)
        wait_for(browser, "return document.querySelector('.tabled')?.textContent.includes('7 of 7')")
        assert browser.execute_script("return document.querySelectorAll('.tabled tbody tr').length") == 4
        wait_for(browser, "return document.querySelector('.target.left-out')?.textContent.includes('not used')")
    assert len(read_cameras(tmp_path / "calibration.toml")) == 4
