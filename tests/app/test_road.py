"""The whole road of `nerif app --demo` by clicks and keys in a browser: from images to a volume for other programs."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.serving import opened, served
from nerif.app.pages import PAGES
from nerif.app.project.jobs import Jobs
from nerif.common.files import read_toml
from nerif.data.volume_file import read_volumes
from nerif.results.directory import ResultDirectory
from report.browsing import errors, needs_browser, requests, wait_for

pytestmark = [needs_browser, pytest.mark.slow]

LONGEST = 300.0  # seconds of the whole road; 122 beside other work on two cores
LONGEST_RUN = 90.0  # seconds of the reconstruction, without imports and report
STATUS = "document.querySelector('.guide .status')?.textContent"
STEPS = {
    "design": ("--views 6", "", 0, ""),
    "images": ("", "", 0, "document.querySelectorAll('.view .pair img').length === 12"),
    "calibration": ("", "Calibrate", 60, "document.querySelectorAll('.tabled tbody tr').length === 6"),
    "displacement": ("--upper 25 25 25", "Find all displacements", 60, "document.querySelector('.cropper img')"),
    "check": ("--voxels 12", "Compare the views", 90, "document.querySelectorAll('.tabled tbody tr').length === 6"),
    "reconstruct": ("--max-steps 250", "Start", 240, "document.querySelector('.curve')?.checkVisibility()"),
}
"""By page: words that the values of its hint give, the button of its run, its longest time in s, what it shows."""


def click(driver: Any, label: str) -> None:
    """Press the button with these words, once it is enabled and rests."""
    buttons = "[...document.querySelectorAll('main button')]"
    result = f"{buttons}.find(b => b.textContent.includes({label!r}) && !b.disabled)"
    wait_for(driver, f"return {result} !== undefined")
    button, place = driver.execute_script(f"return {result}"), None
    rests = "arguments[0].scrollIntoView({block: 'center'}); return arguments[0].getBoundingClientRect().toJSON()"
    while place != (place := driver.execute_script(rests, button)):  # a form that unfolds moves what is below it
        time.sleep(0.15)
    button.click()


def step(driver: Any, page: str, folder: Path) -> None:
    """Do on a page what its hint says."""
    words, button, seconds, visible = STEPS[page]
    if words:
        click(driver, "Fill in the values")
        lines = "[...document.querySelectorAll('.command code')].map(code => code.textContent)"
        filled = f"{lines}.some(line => line.includes({words!r})) && window.socket?.connected"
        wait_for(driver, f"return {filled} && {STATUS} !== undefined")
    if page == "displacement":
        click(driver, "Preview")
        wait_for(driver, "return document.querySelectorAll('.images img').length >= 3", 60)
    if button:
        click(driver, button)
    if page == "reconstruct":
        wait_for(driver, "return document.querySelector('.live-surface canvas') !== null", 90)
        driver.get("about:blank")  # drawn without a graphics card, the surface takes a core from the run, which goes on
        end = time.monotonic() + seconds
        while Jobs(folder).all()[0].state != "done":
            assert time.monotonic() < end
            time.sleep(0.2)
        return
    if button:
        wait_for(driver, f"return {STATUS} === 'Done.'", seconds)
    if page == "displacement":
        click(driver, "Go on with measurement.nc")
    if visible:
        wait_for(driver, f"return Boolean({visible})", 60)


def test_from_images_to_an_exported_volume(browser, tmp_path):
    folder, begun = tmp_path / "nerif-demo", time.monotonic()
    with served(folder, "--demo") as server:
        opened(browser, server, "design", f"{STATUS} !== undefined")
        for page, following in pairwise(PAGES):
            step(browser, page.name, folder)
            if page.name == "reconstruct":
                opened(browser, server, "reconstruct", f"{STATUS} === 'Done.'")
            wait_for(browser, "return document.querySelector('.guide a.next.ready') !== null")
            link = browser.find_element("css selector", ".guide a.next")
            assert link.text == f"Next: {following.title}"
            browser.execute_script("arguments[0].click()", link)
            there = f"document.querySelector('main h1')?.textContent === '{following.title}'"
            wait_for(browser, f"return {there} && window.socket?.connected && {STATUS} !== undefined")
        export(browser)
        assert errors(browser) == []
        here = f"http://127.0.0.1:{server.port}/", f"ws://127.0.0.1:{server.port}/"
        assert [address for address in requests(browser) if not address.startswith(here)] == []
    assert time.monotonic() - begun < LONGEST
    (out,) = (folder / "results").iterdir()
    about = read_toml(out / "run.toml")["about"]
    assert (about["outcome"], about["seconds"] < LONGEST_RUN) == ("steps", True)
    assert ResultDirectory(out).read().metrics.views
    assert (out / "report.html").stat().st_size > 100_000
    result = read_volumes(folder / "exports" / "field.nc")["index_excess"].values.numpy()
    exact = read_volumes(folder / "images" / "truth" / "volume.nc")["index_excess"].values.numpy()
    exact = exact.reshape(24, 2, 24, 2, 24, 2).mean(axis=(1, 3, 5))
    assert np.corrcoef(result[np.isfinite(result)], exact[np.isfinite(result)])[0, 1] > 0.7


def export(driver: Any) -> None:
    """The result is looked at and taken along."""
    wait_for(driver, "return document.querySelectorAll('.cuts img[src]').length === 3")
    wait_for(driver, f"return {STATUS}.startsWith('This was the last page')")
    driver.find_element("xpath", "//div[@role='tab'][contains(., 'Export')]").click()
    wait_for(driver, "return document.querySelector('input[aria-label=\"File to write\"]')?.offsetParent")
    for field, value in (("input[aria-label='File to write']", "exports/field.nc"), ("input[name=voxels]", "24")):
        driver.find_element("css selector", field).send_keys("\ue009" + "a" + "\ue000", value)
    words = "exports/field.nc --voxels 24"
    wait_for(driver, f"return document.querySelector('.command code').textContent.includes({words!r})")
    click(driver, "Export")
    driver.find_element("css selector", "button[aria-label=Runs]").click()
    over = "document.querySelectorAll('.run.done').length === 5 || document.querySelector('.run.failed')"
    wait_for(driver, f"return Boolean({over})", 90)
    assert driver.execute_script("return document.querySelectorAll('.run.failed').length") == 0
