"""Every page by the rules of axe-core (WCAG 2 A and AA), light and dark, on a laptop and on a large screen."""

from __future__ import annotations

import importlib.resources
from typing import Any

import pytest

from app.serving import opened
from app.test_pages import folder, visit
from nerif.app.pages import PAGES
from report.browsing import errors, needs_browser, requests, wait_for

pytestmark = needs_browser
__all__ = ["folder"]

LAPTOP, LARGE = (1280, 800), (3840, 2160)
RULES = """
const done = arguments[arguments.length - 1];
axe.run(document, {runOnly: ["wcag2a", "wcag2aa"], resultTypes: ["violations"]}).then(
    found => done(found.violations.map(v => [v.id, v.help, v.nodes.map(n => n.html.slice(0, 160)).slice(0, 4)])));
"""


def axe() -> str:
    """The rules, as a script."""
    return importlib.resources.files("axe_core_python").joinpath("axe.min.js").read_text()


def settled(driver: Any) -> None:
    """Wait until the page stands still: nothing is animated, nothing waits."""
    wait_for(driver, "return document.getAnimations().every(a => a.playState !== 'running' || a.effect.getTiming()"
                     ".iterations === Infinity)")  # fmt: skip


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_breaks_no_rule(browser, server, page, dark):
    scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics(*LAPTOP))
    opened(browser, server, page.path.lstrip("/"), "document.querySelector('main h1') !== null")
    wait_for(browser, f"return document.body.classList.contains('body--dark') === {str(dark).lower()}")
    settled(browser)
    browser.execute_script(axe())
    found = browser.execute_async_script(RULES)
    assert found == []
    assert errors(browser) == []
    here = f"http://127.0.0.1:{server.port}/", f"ws://127.0.0.1:{server.port}/"
    assert [address for address in requests(browser) if not address.startswith(here)] == []
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@pytest.mark.parametrize("size", [LAPTOP, LARGE], ids=["laptop", "4K"])
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_fits_the_screen(browser, server, page, size):
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics(*size))
    opened(browser, server, page.path.lstrip("/"), "document.querySelector('main h1') !== null")
    wide = browser.execute_script("return document.documentElement.scrollWidth - document.documentElement.clientWidth")
    assert wide <= 0
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def metrics(width: int, height: int) -> dict[str, Any]:
    """A window of that size."""
    return {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}


def test_the_first_key_leads_past_the_navigation(browser, server):
    from selenium.webdriver.common.keys import Keys

    visit(browser, server, "design")
    body = browser.find_element("tag name", "body")
    body.send_keys(Keys.TAB)
    assert browser.execute_script("return document.activeElement.className") == "skip"
    browser.switch_to.active_element.send_keys(Keys.ENTER)
    wait_for(browser, "return document.activeElement.id === 'main'")
