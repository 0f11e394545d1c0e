"""How long nerif app takes to start and to show each of its pages, in headless Chromium.

    python benchmarks/app_times.py out/demo --write benchmarks/results/app-times-cpu.md

FOLDER is a project. --images 12 adds a project of its own with so many views of 2048 x 2048 px, 16 bit, in TIFF, each
with reference and flow: thumbnails are made on the first visit of Images. A page is there when nothing of it changes
any more: words, images, canvases. The first visit is that of a server that has just started.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench import Table, add_write
from nerif.app.pages import PAGES

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))
from browser_screenshots import chromium, served

EDGE = 2048  # px of a large image
STATE = """
return [window.socket?.connected, document.querySelector('main')?.textContent,
        [...document.querySelectorAll('main img')].map((i) => i.complete && i.naturalWidth),
        document.querySelectorAll('main canvas').length]
"""
QUIET, LONGEST = 1.5, 60.0  # seconds in which nothing changes any more; that are waited for them
VISITS = 4


def large_images(folder: Path, views: int) -> None:
    """Write reference and flow of so many views of noise."""
    import tifffile

    drawn = np.random.default_rng(0)
    for view in range(views):
        for kind in ("reference", "flow"):
            place = folder / "images" / f"cam{view:02d}" / kind
            place.mkdir(parents=True)
            image = drawn.integers(0, 4095, (EDGE, EDGE), dtype=np.uint16)
            tifffile.imwrite(place / "0001.tif", image)


def seconds_of(driver: Any, address: str) -> float:
    """Return how long it takes until nothing changes on a page any more."""
    begun = time.monotonic()
    driver.get(address)
    seen, changed = None, begun
    while (now := time.monotonic()) < changed + QUIET:
        if (state := driver.execute_script(STATE)) != seen:
            seen, changed = state, now
        if now > begun + LONGEST:
            sys.exit(f"{address.partition('?')[0]} does not come to rest within {LONGEST:g} s")
        time.sleep(0.02)
    return changed - begun


def measure(table: Table, name: str, folder: Path) -> None:
    """Add a row for the start of a server on a folder, and for each page."""
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as profile, served(folder) as link:
        table.row((name, "start of the server", f"{time.monotonic() - begun:.2f}", ""))
        driver = chromium(Path(profile))
        try:
            driver.get("about:blank")
            base = link.partition("/?")[0]
            token = link.partition("?")[2]
            for page in PAGES:
                taken = [seconds_of(driver, f"{base}{page.path}?{token}") for _ in range(1 + VISITS)]
                table.row((name, page.name, f"{taken[0]:.2f}", f"{statistics.median(taken[1:]):.2f}"))
        finally:
            driver.quit()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a project, such as out/demo")
    parser.add_argument("--images", type=int, default=0, help="views of a project of large images; 0 for none")
    add_write(parser)
    asked = parser.parse_args()
    columns = ("project", "page", "first visit, s", f"median of {VISITS} more, s")
    table = Table("Start and pages of nerif app", columns, asked.write)
    measure(table, asked.folder.name, asked.folder)
    if asked.images:
        with tempfile.TemporaryDirectory() as place:
            large_images(Path(place), asked.images)
            measure(table, f"{asked.images} views of {EDGE}² px", Path(place))


if __name__ == "__main__":
    main()
