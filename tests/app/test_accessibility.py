"""Every page by the rules of axe-core (WCAG 2 A and AA), light and dark, on a phone, a laptop and a large screen.

The project holds something for each page: images, a calibration, a measurement, results, and a run that is watched.
"""

from __future__ import annotations

import importlib.resources
from typing import Any

import pytest

from app.serving import opened
from nerif.app.pages import PAGES
from nerif.app.project.demo_project import MARK
from report.browsing import errors, needs_browser, requests, wait_for

pytestmark = needs_browser
PHONE, TABLET, LAPTOP, LARGE = (390, 844), (1024, 768), (1280, 800), (3840, 2160)
RULES = """
const done = arguments[arguments.length - 1];
axe.run(document, {runOnly: ["wcag2a", "wcag2aa"], resultTypes: ["violations"]}).then(
    found => done(found.violations.map(v => [v.id, v.help, v.nodes.map(n => n.html.slice(0, 160)).slice(0, 4)])));
"""


THERE = {
    "design": "document.querySelector('.drawing svg') !== null",
    "images": "document.querySelectorAll('.view button').length === 3 && document.querySelector('.cropper')",
    "calibration": "document.querySelector('.target img') !== null && document.querySelector('.tabled') !== null",
    "displacement": "document.querySelector('.cropper img') !== null",
    "check": "document.querySelector('.command code') !== null",
    "reconstruct": "document.querySelector('.live-surface canvas') !== null",
    "results": "document.querySelectorAll('.cuts img[src]').length === 3",
}
"""What a page shows once all of it is there."""
CUT = """
const edge = document.documentElement.clientWidth + 1, scrolls = e => getComputedStyle(e).overflowX !== 'visible';
const inside = e => e.parentElement !== document.body && (scrolls(e.parentElement) || inside(e.parentElement));
return [...document.querySelectorAll('main *, header *')].filter(e => e.checkVisibility() &&
  e.getBoundingClientRect().right > edge && !inside(e)).map(e => e.outerHTML.slice(0, 120)).slice(0, 4);
"""
"""Elements that reach beyond the right edge of the window: the page hides them where it does not scroll."""
LANDMARKS = ("main h1", "nav[aria-label] a[aria-current=page]", "header", "a.skip", "html[lang^=en]")
FOCUS = """
const e = document.activeElement, own = getComputedStyle(e);
const box = getComputedStyle(e.closest('.q-field__control') ?? e);
const ring = own.outlineStyle !== 'none' ? own : box;
return [e.ariaLabel, `${ring.outlineStyle} ${ring.outlineWidth}`, e.getBoundingClientRect().top];
"""


def axe() -> str:
    """The rules, as a script."""
    return importlib.resources.files("axe_core_python").joinpath("axe.min.js").read_text()


def settled(driver: Any) -> None:
    """Wait until the page stands still: nothing is animated, nothing waits."""
    wait_for(driver, "return document.getAnimations().every(a => a.playState !== 'running' || a.effect.getTiming()"
                     ".iterations === Infinity)")  # fmt: skip


def windowed(driver: Any, size: tuple[int, int], dark: bool) -> None:
    """Give the browser a window of a size, and a system that is light or dark."""
    scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def faults(driver: Any, dark: bool) -> list[Any]:
    """Rules that the open page breaks, and elements that do not fit."""
    wait_for(driver, f"return document.body.classList.contains('body--dark') === {str(dark).lower()}")
    settled(driver)
    driver.execute_script(axe())
    result = list(driver.execute_async_script(RULES))
    wide = driver.execute_script("return document.documentElement.scrollWidth - document.documentElement.clientWidth")
    return [*result, *driver.execute_script(CUT), *([f"{wide} px too wide"] if wide > 0 else [])]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_breaks_no_rule_fits_and_asks_nobody_else(browser, server, page):
    windowed(browser, LAPTOP, False)
    opened(browser, server, page.name, THERE[page.name])
    assert faults(browser, False) == []
    counts = "return arguments[0].map(e => document.querySelectorAll(e).length)"
    assert browser.execute_script(counts, LANDMARKS) == [1] * len(LANDMARKS)
    assert errors(browser) == []
    here = f"http://127.0.0.1:{server.port}/", f"ws://127.0.0.1:{server.port}/"
    assert [address for address in requests(browser) if not address.startswith(here)] == []


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_breaks_no_rule_in_any_window(browser, server, page):
    windowed(browser, PHONE, False)
    opened(browser, server, page.name, THERE[page.name])
    for size, dark in ((PHONE, False), (PHONE, True), (TABLET, True), (LAPTOP, True), (LARGE, True), (LARGE, False)):
        windowed(browser, size, dark)
        assert faults(browser, dark) == [], (size, dark)
    assert errors(browser) == []


def test_a_broken_rule_is_found(browser, server):
    opened(browser, server, "design", THERE["design"])
    browser.execute_script("document.querySelector('main').append(document.createElement('button'))")
    browser.execute_script(axe())
    assert [rule for rule, *_ in browser.execute_async_script(RULES)] == ["button-name"]


def test_a_page_is_used_without_a_mouse(browser, server):
    """The first key leads past the navigation; then controls come in their order, and are seen to have the focus."""
    from selenium.webdriver.common.keys import Keys

    windowed(browser, LAPTOP, False)
    opened(browser, server, "design", THERE["design"])
    browser.find_element("tag name", "body").send_keys(Keys.TAB)
    assert browser.execute_script("return document.activeElement.className") == "skip"
    browser.switch_to.active_element.send_keys(Keys.ENTER)
    wait_for(browser, "return document.activeElement.id === 'main'")
    names = []
    for _ in range(6):
        browser.switch_to.active_element.send_keys(Keys.TAB)
        name, outline, top = browser.execute_script(FOCUS)
        names.append(name)
        assert outline not in ("", "none 0px"), name
        assert 0 <= top <= browser.execute_script("return innerHeight"), name
    assert names == [
        "Focal length (mm)", "Focal length (mm), slider", "F number", "F number, slider", "Pixel pitch (mm)",
        "Pixel pitch (mm), slider",
    ]  # fmt: skip


def test_a_hint_breaks_no_rule_on_a_phone(browser, server):
    """The project is that of a demo for as long as the mark is there."""
    (server.folder / MARK).write_text('{"complete": true}')
    for dark in (False, True):
        windowed(browser, PHONE, dark)
        if not dark:
            opened(browser, server, "displacement", THERE["displacement"])
        assert faults(browser, dark) == []
    assert browser.execute_script("return document.querySelector('.guide').checkVisibility()")
    covered = browser.execute_script("return document.querySelector('nav').getBoundingClientRect().right")
    assert covered <= 0  # the navigation does not lie over the page
    (server.folder / MARK).unlink()
