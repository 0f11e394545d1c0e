"""The page in a real browser: it draws, turns, responds to mouse, keys and touch, and loads nothing."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerif.cli.cli import main
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid
from nerif.report import html
from nerif.report.journal_figures import error_of
from nerif.report.packing import relation
from nerif.results.directory import Result, ResultDirectory
from report import browsing
from report.browsing import changed, choose, drag, errors, image, press, show, slide, swipe, text, wait_for
from report.page_reading import quantity_of

pytestmark = browsing.needs_browser


@pytest.fixture
def page(browser: Any, whole: Path) -> Any:
    show(browser, whole / "report.html")
    return browser


def test_no_error_and_no_request(page):
    assert errors(page) == []
    assert browsing.requests(page) == []
    assert text(page, "h1") == "balls"


def test_the_field_in_three_dimensions_is_drawn_and_turns(page):
    before = image(page, "#space")
    assert changed(before[0, 0], before) > 0.02
    orange = (before[..., 0] - before[..., 2] > 60).mean()
    assert orange > 0.005  # the isosurface itself, not only lines
    level = text(page, "#level-text")
    drag(page, "#space", 140, 40)
    dragged = image(page, "#space")
    assert changed(before, dragged) > 0.02
    press(page, "#space", "right", "right", "right")
    turned = image(page, "#space")
    assert changed(dragged, turned) > 0.01
    slide(page, "level", 800)
    assert text(page, "#level-text") != level
    assert changed(turned, image(page, "#space")) > 0.002
    choose(page, "mode", "volume")
    clouds = image(page, "#space")
    assert changed(turned, clouds) > 0.01
    assert (clouds[..., 0] - clouds[..., 2] > 60).mean() < orange
    assert errors(page) == []


def test_sliders_and_keys_change_the_slices(page):
    before, where = image(page, "#slice-z"), text(page, "#at-z-text")
    press(page, "#at-z", "right", "right", "right")
    assert text(page, "#at-z-text") != where
    assert changed(before, image(page, "#slice-z"), 5) > 0.02
    for change in (lambda: press(page, "#slice-z", "right", "up", "page up"), lambda: drag(page, "#slice-y", 60, 30)):
        readout = text(page, "#readout")
        change()
        assert text(page, "#readout") != readout


@pytest.mark.slow
def test_switching_the_quantity_changes_the_colour_bar(page):
    labels, viridis = set(), None
    for quantity, unit in (("n", "n − 1"), ("temperature", "[K]"), ("density", "kg m⁻³")):
        choose(page, "quantity", quantity)
        assert unit in text(page, "#bar-label")
        ticks = page.execute_script("return [...document.querySelectorAll('#bar-ticks span')].map(e => e.textContent)")
        assert len(ticks) >= 2
        labels.add((text(page, "#bar-label"), *ticks))
        viridis = image(page, "#bar") if quantity == "temperature" else viridis
    assert len(labels) == 3
    assert not np.array_equal(image(page, "#bar"), viridis)


def value_at_cross(driver: Any) -> float:
    """The value in the readout."""
    match = re.search(r"= (−?[\d.]+)(?: × 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?[^=]*$", text(driver, "#readout"))
    assert match is not None
    exponent = (match[2] or "0").translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    return float(match[1].replace("−", "-")) * 10.0 ** int(exponent)


def test_the_value_at_the_cross_is_that_of_the_file(page, whole):
    press(page, "#slice-z", "right", "up", "page up")
    page.execute_script("scrollTo(0, document.body.scrollHeight)")  # a stage out of sight is not drawn
    result = ResultDirectory(whole).read()
    volumes, error = result.volumes, error_of(result)
    at = tuple(n // 2 + 1 for n in error.grid.shape)
    excess = float(volumes["index_excess"].values[at])
    for quantity in ("n", "density", "temperature"):
        choose(page, "quantity", quantity)
        of = relation(quantity, volumes[quantity].attributes)
        values = np.array([excess, excess - float(error.values[at]), -2e-4, 0.0])
        field, truth, cold, hot = (float(x) for x in quantity_of(of, values))
        expected = {"value": field, "truth": truth, "error": field - truth}
        expected["std"] = float(volumes[f"{quantity}_std"].values[at])
        for variant, value in expected.items():
            choose(page, "variant", variant)
            resolution = 0 if variant == "value" else abs(hot - cold) / 4000  # 12 bits; four digits are shown
            assert value_at_cross(page) == pytest.approx(value, abs=resolution, rel=2e-3), (quantity, variant)


def test_views_are_switched(page):
    visible = "return [...document.querySelectorAll('.view')].filter(v => !v.hidden).map(v => v.dataset.view)"
    assert page.execute_script(visible) == ["170deg"]
    choose(page, "view", "0deg")
    assert page.execute_script(visible) == ["0deg"]
    broken = "return [...document.images].filter(i => i.src && !i.closest('[hidden]') && !i.naturalWidth).length"
    assert page.execute_script(broken) == 0


def test_it_fits_on_a_phone(browser, whole):
    show(browser, whole / "report.html", 390, 844)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    assert errors(browser) == []
    smallest = browser.execute_script(
        "return Math.min(...[...document.querySelectorAll('input[type=range], button, .switch label')]"
        ".filter(e => e.offsetParent).map(e => e.getBoundingClientRect().height))"
    )
    assert smallest >= 28  # px, for a thumb


@pytest.mark.slow
def test_a_finger_scrolls_past_the_stage_until_a_tap_focuses_it(browser, whole):
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    try:
        show(browser, whole / "report.html", 390, 844)
        before = image(browser, "#space")
        assert swipe(browser, "#space", 0, -150) > 100
        assert np.array_equal(image(browser, "#space"), before)
        swipe(browser, "#space", 0, 0)
        assert swipe(browser, "#space", 0, -150) == 0
        assert changed(before, image(browser, "#space")) > 0.02
        swipe(browser, "#space", 0, 0)
        assert swipe(browser, "#space", 0, -150) > 100
        assert errors(browser) == []
    finally:
        browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})


def test_a_damaged_result_opens_without_an_error(browser, copy):
    for name in ("volume.nc", "reprojection.nc", "metrics.json", "field.safetensors"):
        (copy / name).unlink()
    assert main(["report", str(copy)]) == 0
    browser.get_log("browser")
    browser.get((copy / "report.html").as_uri())
    assert errors(browser) == []
    assert "The run has not ended" in text(browser, ".statements")


@pytest.mark.slow
def test_without_webgl_the_slices_remain(whole, tmp_path):
    driver = browsing.open_browser(tmp_path / "profile", "--disable-3d-apis")
    try:
        driver.get((whole / "report.html").as_uri())
        wait_for(driver, "return !document.getElementById('space-message').hidden")
        assert "WebGL" in text(driver, "#space-message")
        assert errors(driver) == []
        assert np.abs(np.diff(image(driver, "#slice-z"), axis=0)).max() > 0
    finally:
        driver.quit()


@pytest.mark.slow
def test_a_field_that_is_no_index_is_drawn_unchanged(browser, tmp_path):
    grid = Grid(Box((-5.0, -4.0, -3.0), (5.0, 4.0, 3.0)), (8, 10, 12))
    x, y, z = grid.points().unbind(-1)
    ball = Volume(0.03 * torch.exp(-(x**2 + y**2 + z**2) / 4), grid, "extinction", "mm-1")
    html.write(html.render(Result(tmp_path, volumes={"extinction": ball})), tmp_path / "report.html")
    show(browser, tmp_path / "report.html")
    assert errors(browser) == []
    assert text(browser, "#bar-label") == "extinction coefficient [mm⁻¹]"
    assert value_at_cross(browser) == pytest.approx(float(ball.values[4, 5, 6]), rel=1e-3)
    assert (np.ptp(image(browser, "#space"), axis=-1) > 60).mean() > 0.005  # the isosurface
