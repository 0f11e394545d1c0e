"""A real browser, and what tests read from a page in it."""

from __future__ import annotations

import base64
import io
import json
import shutil
import time
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
needs_browser = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="no chromium and chromedriver here; .ci/run installs them"
)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--enable-unsafe-swiftshader", "--hide-scrollbars",
)  # fmt: skip
KEYS = {"right": "\ue014", "up": "\ue013", "page up": "\ue00e", "space": " "}


def open_browser(profile: Path, *more: str) -> Any:
    """Start a Chromium that logs console and network."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for flag in (*FLAGS, f"--user-data-dir={profile}", *more):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(executable_path=DRIVER))


def show(driver: Any, page: Path, width: int = 960, height: int = 640) -> None:
    """Open a page in a window of this size and wait until it is ready."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    driver.get_log("browser")
    driver.get_log("performance")
    driver.get(page.as_uri())
    wait_for(driver, "return document.documentElement.dataset.ready !== undefined")


def wait_for(driver: Any, script: str, seconds: float = 30.0) -> None:
    """Repeat a script until it returns true."""
    end = time.monotonic() + seconds
    while not driver.execute_script(script):
        assert time.monotonic() < end, f"waited in vain for: {script}"
        time.sleep(0.05)


def errors(driver: Any) -> list[str]:
    """Errors in the console."""
    return [e["message"] for e in driver.get_log("browser") if e["level"] == "SEVERE"]


def requests(driver: Any) -> list[str]:
    """Requested addresses, except the page, its own data and the browser's pages."""
    messages = [json.loads(e["message"])["message"] for e in driver.get_log("performance")]
    urls = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    return [u for u in urls if not u.startswith(("data:", "blob:", "file:", "chrome:"))]


def image(driver: Any, selector: str) -> np.ndarray:
    """Red, green, blue of a canvas."""
    driver.execute_script(f"document.querySelector('{selector}').scrollIntoView({{block: 'center'}})")
    time.sleep(0.4)  # the view sharpens once it rests
    address = driver.execute_script(f"return document.querySelector('{selector}').toDataURL('image/png')")
    return np.asarray(iio.imread(io.BytesIO(base64.b64decode(address.split(",")[1]))))[..., :3].astype(int)


def changed(before: np.ndarray, after: np.ndarray, threshold: int = 12) -> float:
    """Share of pixels that differ."""
    return float((np.abs(after - before).max(axis=-1) > threshold).mean())


def press(driver: Any, selector: str, *keys: str) -> None:
    """Focus an element and type."""
    element = driver.find_element("css selector", selector)
    driver.execute_script("arguments[0].focus()", element)
    element.send_keys("".join(KEYS.get(k, k) for k in keys))


def choose(driver: Any, name: str, value: str) -> None:
    """Choose a radio button."""
    driver.execute_script(f"document.querySelector('input[name={name}][value=\"{value}\"]').click()")


def slide(driver: Any, name: str, value: int) -> None:
    """Set a slider."""
    driver.execute_script(
        f"const s = document.getElementById('{name}'); s.value = {value}; s.dispatchEvent(new Event('input'))"
    )


def text(driver: Any, selector: str) -> str:
    """Text of an element."""
    return str(driver.execute_script(f"return document.querySelector('{selector}').textContent"))


def drag(driver: Any, selector: str, x: int, y: int) -> None:
    """Drag from the centre of an element."""
    from selenium.webdriver.common.action_chains import ActionChains

    element = driver.find_element("css selector", selector)
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    ActionChains(driver).move_to_element(element).click_and_hold().move_by_offset(x, y).release().perform()


def swipe(driver: Any, selector: str, x: int, y: int) -> float:
    """Move a finger by (x, y) px from the centre of an element, or tap; return by how much the page scrolls, px."""

    def touch(kind: str, *points: dict[str, float]) -> None:
        driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

    driver.execute_script(f"document.querySelector('{selector}').scrollIntoView({{block: 'center'}})")
    box = driver.execute_script(f"return document.querySelector('{selector}').getBoundingClientRect().toJSON()")
    u, v = round(box["x"] + box["width"] / 2), round(box["y"] + box["height"] / 2)
    before = driver.execute_script("return scrollY")
    touch("touchStart", {"x": u, "y": v})
    for i in range(1, 11) if x or y else ():
        touch("touchMove", {"x": u + x * i / 10, "y": v + y * i / 10})
        time.sleep(0.02)
    touch("touchEnd")
    time.sleep(0.3)
    return float(driver.execute_script("return scrollY")) - before
