"""The page in a real browser: it draws, turns, answers to mouse and keys, and asks nothing of the network."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerif.cli import main
from nerif.report.packing import relation
from nerif.report.pages import error_of
from nerif.report.result import read_result

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="no chromium and chromedriver here; .ci/run installs them"
)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--enable-unsafe-swiftshader", "--hide-scrollbars",
)  # fmt: skip
KEYS = {"right": "\ue014", "up": "\ue013", "page up": "\ue00e", "space": " "}


def open_browser(profile: Path, *more: str) -> Any:
    """A fresh Chromium that keeps what the page says and asks for."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for flag in (*FLAGS, f"--user-data-dir={profile}", *more):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(executable_path=DRIVER))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """One browser for this file."""
    driver = open_browser(tmp_path_factory.mktemp("profile"))
    yield driver
    driver.quit()


def show(driver: Any, page: Path, width: int = 1440, height: int = 900) -> None:
    """Open a page at a window's size and wait until it says that it is ready."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    driver.get_log("browser")
    driver.get_log("performance")
    driver.get(page.as_uri())
    wait_for(driver, "return document.documentElement.dataset.ready !== undefined")


def wait_for(driver: Any, script: str, seconds: float = 30.0) -> None:
    """Ask again and again until the page says yes."""
    end = time.monotonic() + seconds
    while not driver.execute_script(script):
        assert time.monotonic() < end, f"waited in vain for: {script}"
        time.sleep(0.05)


@pytest.fixture
def page(browser: Any, whole: Path) -> Any:
    """The report of a whole result, freshly opened."""
    show(browser, whole / "report.html")
    return browser


def errors(driver: Any) -> list[str]:
    """What the console calls errors."""
    return [e["message"] for e in driver.get_log("browser") if e["level"] == "SEVERE"]


def requests(driver: Any) -> list[str]:
    """Addresses that the page asked for, its own and those inside it left out."""
    asked = [json.loads(e["message"])["message"] for e in driver.get_log("performance")]
    urls = [m["params"]["request"]["url"] for m in asked if m["method"] == "Network.requestWillBeSent"]
    return [u for u in urls if not u.startswith(("data:", "blob:", "file:"))]


def picture(driver: Any, selector: str) -> np.ndarray:
    """Red, green, blue of a canvas, as it is seen."""
    import base64
    import io

    import imageio.v3 as iio

    driver.execute_script(f"document.querySelector('{selector}').scrollIntoView({{block: 'center'}})")
    time.sleep(0.4)  # the view sharpens once it rests
    address = driver.execute_script(f"return document.querySelector('{selector}').toDataURL('image/png')")
    return np.asarray(iio.imread(io.BytesIO(base64.b64decode(address.split(",")[1]))))[..., :3].astype(int)


def press(driver: Any, selector: str, *keys: str) -> None:
    """Give an element the focus and type."""
    element = driver.find_element("css selector", selector)
    driver.execute_script("arguments[0].focus()", element)
    element.send_keys("".join(KEYS.get(k, k) for k in keys))


def choose(driver: Any, name: str, value: str) -> None:
    """Choose one of a switch."""
    driver.execute_script(f"document.querySelector('input[name={name}][value={value}]').click()")


def text(driver: Any, selector: str) -> str:
    """Text of an element."""
    return str(driver.execute_script(f"return document.querySelector('{selector}').textContent"))


def drag(driver: Any, selector: str, x: int, y: int) -> None:
    """Press in the middle of an element, move, let go."""
    from selenium.webdriver.common.action_chains import ActionChains

    element = driver.find_element("css selector", selector)
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    ActionChains(driver).move_to_element(element).click_and_hold().move_by_offset(x, y).release().perform()


def test_no_error_and_no_request(page):
    assert errors(page) == []
    assert requests(page) == []
    assert text(page, "h1") == "balls"


def test_the_field_in_three_dimensions_is_drawn_and_turns(page):
    before = picture(page, "#space")
    coloured = np.abs(before - before[0, 0]).max(axis=-1) > 12
    assert coloured.mean() > 0.02
    orange = (before[..., 0] - before[..., 2] > 60).mean()
    assert orange > 0.005  # the isosurface itself, not only lines
    drag(page, "#space", 140, 40)
    after = picture(page, "#space")
    assert (np.abs(after - before).max(axis=-1) > 12).mean() > 0.02
    press(page, "#space", "right", "right", "right")
    turned = picture(page, "#space")
    assert (np.abs(turned - after).max(axis=-1) > 12).mean() > 0.01
    choose(page, "mode", "volume")
    clouds = picture(page, "#space")
    assert (np.abs(clouds - turned).max(axis=-1) > 12).mean() > 0.01
    assert (clouds[..., 0] - clouds[..., 2] > 60).mean() < orange
    assert errors(page) == []


def test_the_level_moves_the_surface(page):
    before, said = picture(page, "#space"), text(page, "#level-text")
    page.execute_script(
        "const s = document.getElementById('level'); s.value = 800; s.dispatchEvent(new Event('input'))"
    )
    assert text(page, "#level-text") != said
    assert (np.abs(picture(page, "#space") - before).max(axis=-1) > 12).mean() > 0.002


def test_sliders_and_keys_change_the_slices(page):
    before, where = picture(page, "#slice-z"), text(page, "#at-z-text")
    press(page, "#at-z", "right", "right", "right")
    assert text(page, "#at-z-text") != where
    moved = picture(page, "#slice-z")
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
    viridis = picture(page, "#bar")
    choose(page, "quantity", "density")
    assert not np.array_equal(picture(page, "#bar"), viridis)


def value_at_cross(driver: Any) -> float:
    """The number that is read out."""
    said = re.search(r"= (?:(−?[\d.]+)(?: × 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?|masked)[^=]*$", text(driver, "#readout"))
    assert said is not None
    exponent = (said[2] or "0").translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    return float(said[1].replace("−", "-")) * 10.0 ** int(exponent)


def test_the_value_at_the_cross_is_that_of_the_file(page, whole):
    press(page, "#slice-z", "right", "up", "page up")
    result = read_result(whole)
    volumes, error = result.volumes, error_of(result)
    assert error is not None
    at = tuple(n // 2 + 1 for n in error.grid.shape)
    excess = float(volumes["index_excess"].values[at])
    for quantity in ("n", "density", "temperature"):
        choose(page, "quantity", quantity)
        formula = relation(quantity, volumes[quantity].attributes)
        field, true = (float(formula(np.array(x))) for x in (excess, excess - float(error.values[at])))
        expected = {"value": field, "truth": true, "error": field - true}
        for statistic in ("mean", "std"):
            expected[statistic] = float(volumes[f"{quantity}_{statistic}"].values[at]) - (
                quantity == "n" and statistic == "mean"
            )
        for variant, value in expected.items():
            choose(page, "variant", variant)
            # what stands beside the field has 12 bits, and four digits are read out
            coarse = 0 if variant == "value" else 1 / 4000
            reach = float(np.ptp(formula(np.array([-2e-4, 0.0]))))
            assert value_at_cross(page) == pytest.approx(value, abs=coarse * reach, rel=2e-3), (quantity, variant)


def test_views_are_switched(page):
    from_held_out = "return [...document.querySelectorAll('.view')].filter(v => !v.hidden).map(v => v.dataset.view)"
    assert page.execute_script(from_held_out) == ["170deg"]
    page.execute_script("document.querySelector('input[name=view][value=\"0deg\"]').click()")
    assert page.execute_script(from_held_out) == ["0deg"]
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


def test_a_broken_result_opens_without_an_error(browser, copy):
    for name in ("volume.nc", "reprojection.nc", "metrics.json", "field.safetensors"):
        (copy / name).unlink()
    assert main(["report", str(copy)]) == 0
    browser.get_log("browser")
    browser.get((copy / "report.html").as_uri())
    assert errors(browser) == []
    assert "The run has not ended" in text(browser, ".statements")


def test_without_webgl_it_says_so_and_the_slices_stay(whole, tmp_path):
    driver = open_browser(tmp_path / "profile", "--disable-3d-apis")
    try:
        driver.get((whole / "report.html").as_uri())
        wait_for(driver, "return !document.getElementById('space-message').hidden")
        assert "WebGL" in text(driver, "#space-message")
        assert errors(driver) == []
        assert (np.abs(np.diff(picture(driver, "#slice-z"), axis=0)).max() > 0).any()
    finally:
        driver.quit()
