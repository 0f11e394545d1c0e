"""The whole road by clicks and keys: from a folder that holds nothing but images to a volume for other programs."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.serving import served
from app.test_calibration import choose
from app.test_pages import line, put
from app.test_results import pick, tab
from nerif.cli.cli import main
from nerif.common.files import read_toml
from nerif.data.volume_file import read_volumes
from report.browsing import errors, needs_browser, requests, text, wait_for

pytestmark = [needs_browser, pytest.mark.slow]

LONGEST = 120.0  # seconds on the road
RESTS = "arguments[0].scrollIntoView({block: 'center'}); return arguments[0].getBoundingClientRect().toJSON()"
SMALL = ["--image-size", "56", "64", "--pixel-pitch", "0.075", "--background-distance", "900"]
IMAGES = ["--references", "3", "--poses", "10", "--backgrounds", "2", "--columns", "6", "--rows", "5"]


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], Path]:
    """Images of four views in a project of its own; the properties of the target; the truth, out of reach."""
    result = tmp_path_factory.mktemp("project")
    words = ["--phantom", "gaussians", "--views", "4", "--arc", "10", "120", *SMALL, *IMAGES, "--truth-voxels", "24"]
    assert main(["render", "-o", str(result / "run"), *words]) == 0
    target, truth = read_toml(result / "run" / "calibrate.toml"), tmp_path_factory.mktemp("truth") / "volume.nc"
    shutil.move(result / "run" / "truth" / "volume.nc", truth)
    shutil.rmtree(result / "run" / "truth")
    (result / "run" / "calibrate.toml").unlink()
    return result, target, truth


def go(driver: Any, title: str) -> None:
    """Follow the navigation to a page."""
    wait_for(driver, "return document.querySelector('nav a') !== null")  # the first page reloads without its token
    driver.find_element("xpath", f"//nav//a[contains(., '{title}')]").click()
    there = f"return document.querySelector('main h1')?.textContent === '{title}' && window.socket?.connected"
    wait_for(driver, there)


def fill(driver: Any, name: str, value: str) -> None:
    """Type into a field once it is there."""
    wait_for(driver, f"return document.querySelector('input[name=\"{name}\"]') !== null")
    put(driver, name, value)


def click(driver: Any, label: str) -> None:
    """Press the button with these words."""
    result = f"//main//button[contains(., '{label}')]"
    ready = "?.disabled === false"
    wait_for(driver, f"return document.evaluate({result!r}, document, null, 9, null).singleNodeValue{ready}")
    button = driver.find_element("xpath", result)
    place: Any = None
    while place != (place := driver.execute_script(RESTS, button)):  # a form that unfolds moves what is below it
        time.sleep(0.15)
    button.click()


def runs_done(driver: Any, count: int) -> None:
    """Wait, with the drawer of runs open, until this number of them has ended well."""
    if not driver.execute_script("return document.querySelector('.runs .run')?.checkVisibility() ?? false"):
        driver.find_element("css selector", "button[aria-label=Runs]").click()
    over = f"document.querySelectorAll('.run.done').length === {count} || document.querySelector('.run.failed')"
    wait_for(driver, f"return Boolean({over})", 90)
    assert driver.execute_script("return document.querySelectorAll('.run.failed').length") == 0


def test_from_images_to_an_exported_volume(browser, project):
    folder, target, truth = project
    begun = time.monotonic()
    with served(folder) as server:
        browser.get_log("browser")
        browser.get_log("performance")
        browser.get(server.link)
        design(browser)
        images(browser)
        calibration(browser, target)
        displacement(browser, folder)
        check(browser)
        reconstruct(browser)
        results(browser, folder)
        assert errors(browser) == []
        here = f"http://127.0.0.1:{server.port}/", f"ws://127.0.0.1:{server.port}/"
        assert [address for address in requests(browser) if not address.startswith(here)] == []
    assert time.monotonic() - begun < LONGEST
    result, exact = read_volumes(folder / "exports" / "field.nc")["index_excess"], read_volumes(truth)["index_excess"]
    assert result.values.shape == (24, 24, 24)
    inside = np.isfinite(result.values.numpy())
    assert np.corrcoef(result.values.numpy()[inside], exact.values.numpy()[inside])[0, 1] > 0.7


def design(driver: Any) -> None:
    """What will be seen is known before."""
    go(driver, "Design")
    fill(driver, "background_distance", "900")
    wait_for(driver, "return document.querySelector('.command code').textContent.endsWith('900')")
    assert "px" in text(driver, ".headline b")


def images(driver: Any) -> None:
    """All images can be used."""
    go(driver, "Images")
    wait_for(driver, "return document.querySelectorAll('.view .pair img').length === 8")
    wait_for(driver, "return document.querySelector('.status').textContent.startsWith('4 views. No problems found')")


def calibration(driver: Any, target: dict[str, Any]) -> None:
    """The target is described, detected in the images, and gives four cameras."""
    go(driver, "Calibration")
    wait_for(driver, "return document.querySelector('input[name=\"target.columns\"]') !== null")
    choose(driver, "Target: kind", target["target"]["kind"])
    for name in ("columns", "rows", "pitch"):
        fill(driver, f"target.{name}", f"{target['target'][name]:g}")
    fill(driver, "background_scale", f"{target['background_scale']:g}")
    fill(driver, "world", target["world"])
    more = driver.find_element("css selector", ".more .q-item")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", more)
    more.click()
    wait_for(driver, "return document.querySelector('input[name=axes]')?.checkVisibility() && "
                     "document.getAnimations().length === 0")  # fmt: skip
    fill(driver, "axes", " ".join(target["axes"]))
    wait_for(driver, "return document.querySelectorAll('.target circle').length > 50")
    click(driver, "Calibrate")
    wait_for(driver, "return /^It (is done|failed)/.test(document.querySelector('.status')?.textContent)", 60)
    assert text(driver, ".status") == "It is done."
    wait_for(driver, "return document.querySelectorAll('.tabled tbody tr').length === 4")


def displacement(driver: Any, folder: Path) -> None:
    """One view first, then all."""
    go(driver, "Displacement")
    fill(driver, "lower", "-25 -25 -25")
    fill(driver, "upper", "25 25 25")
    wait_for(driver, "return document.querySelector('.command code').textContent.includes('--upper 25')")
    click(driver, "Preview")
    wait_for(driver, "return document.querySelectorAll('.images img').length >= 3", 60)
    click(driver, "Find all displacements")
    runs_done(driver, 2)
    assert (folder / "measurement.nc").is_file()
    click(driver, "Go on with measurement.nc")
    wait_for(driver, "return document.querySelector('.cropper img') !== null", 30)
    value = "return document.querySelector('input[aria-label={}]').value"
    assert driver.execute_script(value.format("Measurement")) == "measurement.nc"
    assert driver.execute_script(value.format('"Measurement to write"')) != "measurement.nc"  # of the next


def check(driver: Any) -> None:
    """Nothing is mirrored, swapped or exchanged."""
    go(driver, "Check")
    fill(driver, "voxels", "8")
    lines = "[...document.querySelectorAll('.command code')].map(code => code.textContent)"
    wait_for(driver, f"return {lines}.some(line => line.endsWith('--voxels 8'))")
    click(driver, "Compare the views")
    wait_for(driver, "return document.querySelectorAll('.tabled tbody tr').length === 4", 90)
    assert "No problems found" in text(driver, 'section[aria-label="Findings"]')
    driver.find_element("xpath", "//main//a[contains(., 'Go on to Reconstruct')]").click()


def reconstruct(driver: Any) -> None:
    """A run is started and watched to its end."""
    wait_for(driver, "return document.querySelector('main h1')?.textContent === 'Reconstruct'")
    wait_for(driver, "return window.socket?.connected && document.querySelector('input[name=voxels]') !== null")
    pick(driver, "Method", "Tikhonov")
    wait_for(driver, "return document.querySelector('.command code').textContent.includes('tikhonov')")
    fill(driver, "voxels", "24")
    wait_for(driver, "return document.querySelector('.command code').textContent.includes('--voxels 24')")
    words = line(driver)
    assert words[:3] == ["nerif", "reconstruct", "measurement.nc"]
    click(driver, "Start")
    wait_for(driver, "return document.querySelector('.status').textContent.includes('It has ended')", 90)


def results(driver: Any, folder: Path) -> None:
    """The result is looked at and taken along."""
    go(driver, "Results")
    wait_for(driver, "return document.querySelectorAll('.cuts img[src]').length === 3")
    tab(driver, "Export")
    wait_for(driver, "return document.querySelector('input[aria-label=\"File to write\"]')?.offsetParent")
    pick(driver, "Format", "NetCDF")
    fill(driver, "voxels", "24")
    name = driver.find_element("css selector", "input[aria-label='File to write']")
    name.send_keys("\ue009" + "a" + "\ue000", "exports/field.nc")
    wait_for(driver, "return document.querySelector('.command code').textContent.includes('exports/field.nc')")
    click(driver, "Export")
    runs_done(driver, 5)
