"""Pages in a real browser: by clicks and keys, without a request that leaves the machine."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.serving import Served, opened
from nerif.cli.cli import main
from nerif.geometry import Ring
from nerif.results.live import read_live, read_snapshot
from nerif.simulation.design import DesignSettings, expect
from report.browsing import errors, needs_browser, requests, text, wait_for

pytestmark = needs_browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    project = tmp_path_factory.mktemp("project")
    small = ["--image-size", "20", "24", "--pixel-pitch", "0.18", "--views", "4", "--arc", "0", "135"]
    assert main(["simulate", "-o", str(project / "m & <b>.nc"), *small, "--truth-voxels", "8"]) == 0
    return project


LINE = "document.querySelector('.command code') !== null"


def visit(driver: Any, server: Served, page: str) -> None:
    """Open a page and wait until the server answers what is done on it."""
    opened(driver, server, page, LINE)


def put(driver: Any, name: str, value: str) -> None:
    """Type a value into a field."""
    from selenium.webdriver.common.keys import Keys

    box = driver.find_element("css selector", f"input[name='{name}']")
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys(value)


def line(driver: Any) -> list[str]:
    """Words of the command line that is shown."""
    return shlex.split(text(driver, ".command code"))


def test_the_design_follows_what_is_typed_and_is_kept_over_a_reload(browser, server, folder):
    visit(browser, server, "design")
    assert "token" not in browser.current_url
    before = text(browser, ".headline b")
    assert before == f"{expect(Ring(), DesignSettings()).displacement:.3f} px"
    assert line(browser) == ["nerif", "design"]
    drawing = text(browser, ".drawing") + browser.execute_script("return document.querySelector('.drawing').innerHTML")
    put(browser, "background_distance", "900")
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('900')")
    wait_for(browser, f"return document.querySelector('.headline b').textContent !== '{before}'")
    expected = expect(Ring(background_distance=900), DesignSettings()).displacement
    assert text(browser, ".headline b") == f"{expected:.3f} px"
    assert line(browser) == ["nerif", "design", "--background-distance", "900"]
    assert browser.execute_script("return document.querySelector('.drawing').innerHTML") not in drawing
    put(browser, "focal_length", "-3")
    wait_for(browser, "return document.querySelector('.error span') !== null")
    assert "got -3.0" in text(browser, ".error span")
    assert browser.execute_script("return document.querySelector('input[name=focal_length]').ariaInvalid") == "true"
    put(browser, "focal_length", "60")
    wait_for(browser, "return document.querySelector('.error span') === null")
    visit(browser, server, "design")
    assert line(browser) == ["nerif", "design", "--focal-length", "60", "--background-distance", "900"]
    assert errors(browser) == []
    here = f"http://127.0.0.1:{server.port}/", f"ws://127.0.0.1:{server.port}/"
    assert [address for address in requests(browser) if not address.startswith(here)] == []


def test_a_slider_is_moved_by_keys(browser, server):
    from selenium.webdriver.common.keys import Keys

    visit(browser, server, "design")
    before = text(browser, ".command code")
    browser.find_element("css selector", "input[type=range][aria-label^='F number']").send_keys(Keys.RIGHT * 3)
    wait_for(browser, f"return document.querySelector('.command code').textContent !== {before!r}")
    assert "--f-number" in line(browser)


def test_every_control_has_a_name_and_the_page_its_landmarks(browser, server):
    for page in ("design", "reconstruct"):
        visit(browser, server, page)
        nameless = browser.execute_script(
            "return [...document.querySelectorAll('button, input, [role=combobox], a')]"
            ".filter(e => e.offsetParent && !e.ariaLabel && !e.textContent.trim() && !e.labels?.length)"
            ".map(e => e.outerHTML.slice(0, 200))"
        )
        assert nameless == []
        for landmark in ("main h1", "nav[aria-label] a[aria-current=page]", "header", "a.skip"):
            assert browser.execute_script(f"return document.querySelectorAll('{landmark}').length") == 1, landmark
        assert browser.execute_script("return document.documentElement.lang").startswith("en")


def test_too_short_a_time_limit_is_said_before_the_start(browser, server):
    visit(browser, server, "reconstruct")
    put(browser, "time_limit", "1")
    notes = "[...document.querySelectorAll('[role=status] .note')].map(e => e.textContent).join()"
    wait_for(browser, f"return {notes}.includes('--time-limit 1 is too short')", 60)
    put(browser, "time_limit", "0")
    wait_for(browser, f"return {notes} === ''", 60)


@pytest.mark.slow
def test_a_run_is_started_watched_and_stopped(browser, server, folder):
    visit(browser, server, "reconstruct")
    assert line(browser)[:3] == ["nerif", "reconstruct", "m & <b>.nc"]
    put(browser, "time_limit", "600")
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('600')")
    browser.find_element("xpath", "//button[contains(., 'Start')]").click()
    wait_for(browser, "return document.querySelectorAll('.images img').length >= 7", 120)
    wait_for(browser, "return document.querySelector('.curve canvas') !== null")
    notes = browser.execute_script("return [...document.querySelectorAll('.images img')].map(e => e.alt)")
    assert "measured" in notes[0]
    assert "predicted" in notes[1]
    out = folder / "results" / "m & <b>-nerif"
    look, live = read_snapshot(out), read_live(out)
    assert look is not None
    assert look.view == live["view"]
    assert np.isfinite(look.predicted).all()
    visit(browser, server, "reconstruct")  # a reload loses nothing
    wait_for(browser, "return document.querySelectorAll('.images img').length >= 7")
    browser.find_element("xpath", "//section[@aria-label='The run']//button[contains(., 'Pause')]").click()
    wait_for(browser, "return document.querySelector('.status').textContent.includes('Paused')", 120)
    assert (out / "checkpoint.safetensors").is_file() or (out / "cross_validation").is_dir()
    browser.find_element("xpath", "//section[@aria-label='The run']//button[contains(., 'Go on')]").click()
    wait_for(browser, "return /It runs.*step/.test(document.querySelector('.status').textContent)", 120)
    browser.find_element("xpath", "//section[@aria-label='The run']//button[contains(., 'Stop')]").click()
    wait_for(browser, "return document.querySelector('.status').textContent.includes('Stopped')", 120)
    assert (out / "volume.nc").is_file()
    assert errors(browser) == []


def test_the_runs_are_closed_where_they_cover_the_page(browser, server):
    """On a phone the drawer is as wide as the window: it has a button of its own."""
    visit(browser, server, "design")
    button = "document.querySelector('button[aria-label=Runs]')"
    browser.find_element("css selector", "button[aria-label=Runs]").click()
    wait_for(browser, f"return {button}.ariaExpanded === 'true'")
    wait_for(
        browser, "return document.querySelector('.runs').checkVisibility() && document.getAnimations().length === 0"
    )
    browser.find_element("css selector", "button[aria-label='Close the runs']").click()
    wait_for(browser, f"return {button}.ariaExpanded === 'false'")
    assert errors(browser) == []
