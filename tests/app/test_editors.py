"""What scripts do in a browser: strokes and keys of the mask editor, crops drawn with the mouse, blinking, surfaces."""

from __future__ import annotations

from typing import Any

import pytest

from app.serving import opened
from report.browsing import drag, errors, needs_browser, text, wait_for

pytestmark = needs_browser

WIDTH = "Number(document.querySelector('input[aria-label=\"Width of the brush (px)\"]').value)"
STROKES = "document.querySelectorAll('.over .brush').length"
DOTS = "document.querySelectorAll('.over .draft circle').length"
EFFECT = "document.querySelector('[aria-label=\"Effect of the shape\"] [aria-pressed=true]').textContent"


def click(driver: Any, label: str, within: str = "body") -> None:
    """Press a button by what it says."""
    match = f"[...document.querySelectorAll('{within} button')].find(b => b.textContent.includes({label!r}))"
    wait_for(driver, f"return {match} !== undefined")
    driver.execute_script(f"const b = {match}; b.scrollIntoView({{block: 'center'}}); b.click()")


def keys(driver: Any, *presses: str) -> None:
    """Press keys where the focus is; Ctrl+ and Shift+ before a key hold these."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    for press in presses:
        *holds, key = press.split("+") if len(press) > 1 else [press]
        chain = ActionChains(driver)
        modifiers = [{"Ctrl": Keys.CONTROL, "Shift": Keys.SHIFT}[hold] for hold in holds]
        for modifier in modifiers:
            chain.key_down(modifier)
        chain.send_keys(key)
        for modifier in modifiers:
            chain.key_up(modifier)
        chain.perform()


def test_keys_of_the_brush_act_in_the_editor_alone_and_an_undo_shows_its_view(browser, server):
    opened(browser, server, "displacement", "document.querySelector('.cropper img') !== null")
    click(browser, "Brush")
    drag(browser, ".cropper", 30, 20)
    wait_for(browser, f"return {STROKES} === 1")
    assert browser.execute_script("return document.activeElement.className").startswith("cropper")
    keys(browser, "]", "]")
    wait_for(browser, f"return {WIDTH} === 12")
    keys(browser, *"[[[[")
    wait_for(browser, f"return {WIDTH} === 5")
    assert browser.execute_script(f"return {EFFECT}") == "Flow is here"
    keys(browser, "e")
    wait_for(browser, f"return {EFFECT} === 'No flow here'")
    drag(browser, ".cropper", -30, 20)
    wait_for(browser, "return document.querySelectorAll('.over .none.brush').length === 1")
    for press, count in (("Ctrl+z", 1), ("Ctrl+Shift+z", 2), ("Ctrl+z", 1)):  # the focus stays
        keys(browser, press)
        wait_for(browser, f"return {STROKES} === {count}")
    choice = browser.find_element("css selector", "[aria-label='View to draw in']")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", choice)
    choice.click()
    option = "[...document.querySelectorAll('.q-menu .q-item')].find(e => e.textContent.includes('60deg'))"
    wait_for(browser, f"return {option} !== undefined")
    browser.execute_script(f"{option}.click()")
    alt = "document.querySelector('.cropper img').alt.split(' ').at(-1)"
    wait_for(browser, f"return {alt} === '60deg'")
    drag(browser, ".cropper", 30, 20)  # the tool stays
    wait_for(browser, f"return {STROKES} === 1")
    keys(browser, "Ctrl+z")
    wait_for(browser, f"return {STROKES} === 0")
    keys(browser, "Ctrl+z")
    wait_for(browser, f"return {alt} === '20deg' && document.activeElement.className.startsWith('cropper')")
    keys(browser, "Ctrl+Shift+z")
    wait_for(browser, f"return {STROKES} === 1")
    keys(browser, "Ctrl+z")
    wait_for(browser, f"return {STROKES} === 0")
    click(browser, "Polygon")
    drag(browser, ".cropper", 10, 10)
    drag(browser, ".cropper", 20, 10)
    wait_for(browser, f"return {DOTS} === 2")
    keys(browser, "Ctrl+z")
    wait_for(browser, f"return {DOTS} === 1")
    browser.find_element("css selector", "input[aria-label='Column of the next corner (px)']").click()
    keys(browser, "e", "[", "Ctrl+z")  # keys of the field
    browser.execute_script("document.activeElement.blur()")
    keys(browser, "e", "]")  # outside of the editor
    browser.execute_async_script("setTimeout(arguments[0], 500)")
    assert browser.execute_script(f"return [{EFFECT}, {WIDTH}, {DOTS}]") == ["No flow here", 5, 1]
    assert errors(browser) == []


def test_a_crop_is_drawn_and_reference_and_flow_change_places_by_key_and_clock(browser, server):
    from selenium.webdriver.common.keys import Keys

    opened(browser, server, "images", "document.querySelector('.both img.flow')?.naturalWidth > 0")
    drag(browser, ".cropper", 100, 60)
    wait_for(browser, "return Number(document.querySelector('input[name=width]').value) < 96")
    both = browser.find_element("css selector", ".both")
    for title in ("Flow", "Reference"):
        both.send_keys(Keys.SPACE)
        assert text(browser, ".current") == title
    click(browser, "Blink")
    wait_for(browser, "return document.querySelector('.current').textContent === 'Flow'")
    click(browser, "Blink")
    calm = [{"name": "prefers-reduced-motion", "value": "reduce"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": calm})
    click(browser, "Blink")
    assert "Reduced motion" in text(browser, ".calm")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert errors(browser) == []


def test_a_slider_is_moved_by_keys(browser, server):
    from selenium.webdriver.common.keys import Keys

    opened(browser, server, "design", "document.querySelector('.command code') !== null")
    browser.find_element("css selector", "input[type=range][aria-label^='F number']").send_keys(Keys.RIGHT * 3)
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('--f-number')")


def test_a_report_runs_in_a_sandbox_and_a_surface_is_drawn(browser, server):
    opened(browser, server, "results", "document.querySelectorAll('.cuts img[src]').length === 3")
    for name, there in (("In 3-D", ".surface canvas"), ("Report", "iframe.report")):
        browser.find_element("xpath", f"//div[@role='tab'][contains(., '{name}')]").click()
        wait_for(browser, f"return document.querySelector('{there}') !== null")
        if name == "In 3-D":
            loaded = "performance.getEntriesByType('resource').filter(e => /surface\\?/.test(e.name))"
            wait_for(browser, f"return {loaded}.length === 1")
    browser.switch_to.frame(browser.find_element("css selector", "iframe.report"))
    wait_for(browser, "return document.querySelector('#outcome')?.textContent.split(' ').length > 2")
    assert text(browser, "#outcome") == "run barred refused"
    browser.switch_to.default_content()


@pytest.mark.slow
def test_the_command_line_is_copied(browser, server):
    opened(browser, server, "design", "document.querySelector('.command code') !== null")
    click(browser, "Copy", ".command")
    wait_for(browser, "return document.querySelector('.command button').textContent.includes('Copied')")
