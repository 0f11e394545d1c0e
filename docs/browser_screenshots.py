"""The images of the page "In the browser": `python docs/browser_screenshots.py docs/browser`.

A small experiment is rendered and taken through the whole road by the command line, in a folder that the app then
opens: what the command line made it picks up. Chromium and chromedriver are needed.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nerif.app.pages import PAGES

SIZE = (1440, 900)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--enable-unsafe-swiftshader", "--hide-scrollbars",
)  # fmt: skip
LONGEST = 180.0  # seconds that are waited for anything
SETTLES = 6.0  # seconds until images and 3-D views of a page have come
ROAD = (
    "render -o images --phantom flame --views 4 --arc 0 135 --image-size 96 96 --pixel-pitch 0.043 "
    "--background-distance 1000 --poses 12 --backgrounds 3",
    "calibrate images --config images/calibrate.toml -o calibration.toml",
    "displacement images --calibration calibration.toml --lower -25 -25 -25 --upper 25 25 25 -o measurement.nc",
    "check measurement.nc",
    "reconstruct measurement.nc -o results/flame --max-steps 300 --voxels 48 --uncertainty fast",
    "reconstruct measurement.nc -o results/flame-tv --method tv --voxels 32",
)


TYPED = {"displacement": {"lower": "-25 -25 -25", "upper": "25 25 25"}}  # by page
LOOKS = {
    "displacement": ("Preview", "document.querySelectorAll('.images img').length > 2", 4.0, False),
    "check": ("Compare the views", "document.querySelector('.tabled table')", 1.0, False),
    "reconstruct": ("Start", "document.querySelector('.live-surface canvas')", 40.0, True),
}
"""Pages on which something is done first: the button, what is waited for, seconds more, whether to scroll to it."""


def nerif(folder: Path, line: str) -> None:
    """Run a command of nerif in a folder; a verdict of check is no end."""
    done = subprocess.run([sys.executable, "-m", "nerif", *line.split()], cwd=folder, check=False)
    if done.returncode and not line.startswith("check"):
        sys.exit(done.returncode)


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Start the app on a folder, and give its address."""
    words = [sys.executable, "-m", "nerif", "app", str(folder), "--no-browser"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    try:
        yield next(found[0] for line in process.stdout if (found := re.search(r"http://\S+token=\S+", line)))
    finally:
        process.terminate()
        process.wait()


def chromium(profile: Path) -> Any:
    """A fresh browser with a window of the size of the images."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    service = webdriver.ChromeService(executable_path=shutil.which("chromedriver"))
    driver = webdriver.Chrome(options=options, service=service)
    size = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    return driver


def press(driver: Any, label: str) -> None:
    """Press the first button of a page with these words that is seen."""
    buttons = driver.find_elements("xpath", f"//main//button[contains(., '{label}')]")
    driver.execute_script("arguments[0].click()", next(button for button in buttons if button.is_displayed()))


def wait_for(driver: Any, script: str) -> None:
    """Wait until a page says yes."""
    end = time.monotonic() + LONGEST
    while not driver.execute_script(f"return Boolean({script})"):
        if time.monotonic() > end:
            sys.exit(f"waited in vain for {script}")
        time.sleep(0.2)


def do(driver: Any, button: str, there: str, seconds: float, scroll: bool) -> None:
    """Press a button and wait for what comes of it."""
    press(driver, button)
    wait_for(driver, there)
    time.sleep(seconds)
    if scroll:
        driver.execute_script("document.querySelector('section[aria-label=\"The run\"]').scrollIntoView()")
        driver.execute_script("scrollBy(0, -70)")
        time.sleep(1.0)


def draw(images: Path, project: Path) -> None:
    """Write an image of every page of a project."""
    from selenium.webdriver.common.keys import Keys

    images.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as profile, served(project) as link:
        driver = chromium(Path(profile))
        try:
            driver.get(link)
            base = link.partition("/?")[0]
            for page in PAGES:
                driver.get(base + page.path)
                time.sleep(SETTLES)
                for name, value in TYPED.get(page.name, {}).items():
                    field = driver.find_element("css selector", f"input[name='{name}']")
                    field.send_keys(Keys.CONTROL + "a")  # what was typed before is kept with the project
                    field.send_keys(value)
                    time.sleep(1.0)
                if page.name in LOOKS:
                    do(driver, *LOOKS[page.name])
                driver.save_screenshot(str(images / f"{page.name}.png"))
                if page.name == "reconstruct":
                    press(driver, "Stop")
                    wait_for(driver, "document.querySelector('.status').textContent.includes('Stopped')")
        finally:
            driver.quit()


def main() -> None:
    """Take the road, and the images."""
    images = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as folder:
        project = Path(sys.argv[2]).resolve() if len(sys.argv) > 2 else Path(folder)
        if not (project / "results").exists():
            for line in ROAD:
                nerif(project, line)
        draw(images, project)


if __name__ == "__main__":
    main()
