"""The page in a real browser: it draws, turns, answers to mouse and keys, and asks nothing of the network."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerif.cli.cli import main
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid
from nerif.report import html
from nerif.report.packing import relation
from nerif.report.pages import error_of
from nerif.results.directory import Result, ResultDirectory
from report.browsing import (
    choose,
    drag,
    errors,
    image,
    needs_browser,
    open_browser,
    press,
    requests,
    show,
    swipe,
    tap,
    text,
    wait_for,
)
from report.page_reading import quantity_of

pytestmark = needs_browser


@pytest.fixture
def page(browser: Any, whole: Path) -> Any:
    """The report of a whole result, freshly opened."""
    show(browser, whole / "report.html")
    return browser


def test_no_error_and_no_request(page):
    assert errors(page) == []
    assert requests(page) == []
    assert text(page, "h1") == "balls"


def test_the_field_in_three_dimensions_is_drawn_and_turns(page):
    before = image(page, "#space")
    coloured = np.abs(before - before[0, 0]).max(axis=-1) > 12
    assert coloured.mean() > 0.02
    orange = (before[..., 0] - before[..., 2] > 60).mean()
    assert orange > 0.005  # the isosurface itself, not only lines
    drag(page, "#space", 140, 40)
    after = image(page, "#space")
    assert (np.abs(after - before).max(axis=-1) > 12).mean() > 0.02
    press(page, "#space", "right", "right", "right")
    turned = image(page, "#space")
    assert (np.abs(turned - after).max(axis=-1) > 12).mean() > 0.01
    choose(page, "mode", "volume")
    clouds = image(page, "#space")
    assert (np.abs(clouds - turned).max(axis=-1) > 12).mean() > 0.01
    assert (clouds[..., 0] - clouds[..., 2] > 60).mean() < orange
    assert errors(page) == []


def test_the_level_moves_the_surface(page):
    before, said = image(page, "#space"), text(page, "#level-text")
    page.execute_script(
        "const s = document.getElementById('level'); s.value = 800; s.dispatchEvent(new Event('input'))"
    )
    assert text(page, "#level-text") != said
    assert (np.abs(image(page, "#space") - before).max(axis=-1) > 12).mean() > 0.002


def test_sliders_and_keys_change_the_slices(page):
    before, where = image(page, "#slice-z"), text(page, "#at-z-text")
    press(page, "#at-z", "right", "right", "right")
    assert text(page, "#at-z-text") != where
    moved = image(page, "#slice-z")
    assert (np.abs(moved - before).max(axis=-1) > 5).mean() > 0.02
    readout = text(page, "#readout")
    press(page, "#slice-z", "right", "right", "up", "page up")
    assert text(page, "#readout") != readout
    drag(page, "#slice-y", 60, 30)
    assert text(page, "#readout") != readout


def test_switching_the_quantity_changes_the_colour_bar(page):
    seen = set()
    for quantity, unit in (("n", "n − 1"), ("density", "kg m⁻³"), ("temperature", "[K]")):
        choose(page, "quantity", quantity)
        assert unit in text(page, "#bar-label")
        ticks = page.execute_script("return [...document.querySelectorAll('#bar-ticks span')].map(e => e.textContent)")
        assert len(ticks) >= 2
        seen.add((text(page, "#bar-label"), *ticks))
    assert len(seen) == 3
    viridis = image(page, "#bar")
    choose(page, "quantity", "density")
    assert not np.array_equal(image(page, "#bar"), viridis)


def value_at_cross(driver: Any) -> float:
    """The number that is read out."""
    said = re.search(r"= (?:(−?[\d.]+)(?: × 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?|masked)[^=]*$", text(driver, "#readout"))
    assert said is not None
    exponent = (said[2] or "0").translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    return float(said[1].replace("−", "-")) * 10.0 ** int(exponent)


def test_the_value_at_the_cross_is_that_of_the_file(page, whole):
    press(page, "#slice-z", "right", "up", "page up")
    page.execute_script("scrollTo(0, document.body.scrollHeight)")  # a stage out of sight is not drawn
    result = ResultDirectory(whole).read()
    volumes, error = result.volumes, error_of(result)
    assert error is not None
    at = tuple(n // 2 + 1 for n in error.grid.shape)
    excess = float(volumes["index_excess"].values[at])
    for quantity in ("n", "density", "temperature"):
        choose(page, "quantity", quantity)
        formula = partial(quantity_of, relation(quantity, volumes[quantity].attributes))
        field, true = (float(formula(np.array(x))) for x in (excess, excess - float(error.values[at])))
        expected = {"value": field, "truth": true, "error": field - true}
        expected["std"] = float(volumes[f"{quantity}_std"].values[at])
        for variant, value in expected.items():
            choose(page, "variant", variant)
            # what stands beside the field has 12 bits, and four digits are read out
            coarse = 0 if variant == "value" else 1 / 4000
            reach = float(np.ptp(formula(np.array([-2e-4, 0.0]))))
            assert value_at_cross(page) == pytest.approx(value, abs=coarse * reach, rel=2e-3), (quantity, variant)


def test_views_are_switched(page):
    from_withheld = "return [...document.querySelectorAll('.view')].filter(v => !v.hidden).map(v => v.dataset.view)"
    assert page.execute_script(from_withheld) == ["170deg"]
    page.execute_script("document.querySelector('input[name=view][value=\"0deg\"]').click()")
    assert page.execute_script(from_withheld) == ["0deg"]
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
def test_a_finger_scrolls_past_the_stage_until_a_tap_gives_it_the_finger(browser, whole):
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    try:
        show(browser, whole / "report.html", 390, 844)
        before = image(browser, "#space")
        assert swipe(browser, "#space", 0, -150) > 100
        assert np.array_equal(image(browser, "#space"), before)
        tap(browser, "#space")
        assert swipe(browser, "#space", 0, -150) == 0
        assert (np.abs(image(browser, "#space") - before).max(axis=-1) > 12).mean() > 0.02
        tap(browser, "#space")
        assert swipe(browser, "#space", 0, -150) > 100
        assert errors(browser) == []
    finally:
        browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})


def test_a_broken_result_opens_without_an_error(browser, copy):
    for name in ("volume.nc", "reprojection.nc", "metrics.json", "field.safetensors"):
        (copy / name).unlink()
    assert main(["report", str(copy)]) == 0
    browser.get_log("browser")
    browser.get((copy / "report.html").as_uri())
    assert errors(browser) == []
    assert "The run has not ended" in text(browser, ".statements")


@pytest.mark.slow
def test_without_webgl_it_says_so_and_the_slices_stay(whole, tmp_path):
    driver = open_browser(tmp_path / "profile", "--disable-3d-apis")
    try:
        driver.get((whole / "report.html").as_uri())
        wait_for(driver, "return !document.getElementById('space-message').hidden")
        assert "WebGL" in text(driver, "#space-message")
        assert errors(driver) == []
        assert (np.abs(np.diff(image(driver, "#slice-z"), axis=0)).max() > 0).any()
    finally:
        driver.quit()


@pytest.mark.slow
def test_a_field_that_is_no_index_is_drawn_as_it_is(browser, tmp_path):
    grid = Grid(Box((-5.0, -4.0, -3.0), (5.0, 4.0, 3.0)), (8, 10, 12))
    x, y, z = grid.points().unbind(-1)
    ball = Volume(0.03 * torch.exp(-(x**2 + y**2 + z**2) / 4), grid, "extinction", "mm-1")
    html.write(html.render(Result(tmp_path, volumes={"extinction": ball})), tmp_path / "report.html")
    show(browser, tmp_path / "report.html")
    assert errors(browser) == []
    assert text(browser, "#bar-label") == "extinction coefficient [mm⁻¹]"
    said = re.search(r"coefficient = ([\d.]+) mm⁻¹", text(browser, "#readout"))
    assert said is not None
    assert float(said[1]) == pytest.approx(float(ball.values[4, 5, 6]), rel=1e-3)
    assert (np.ptp(image(browser, "#space"), axis=-1) > 60).mean() > 0.005  # the isosurface
