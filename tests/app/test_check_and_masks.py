"""The pages Check and Displacement by clicks: a mirrored view found and undone, masks drawn, taken back, and put in."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from app.serving import opened
from app.test_pages import put
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.simulation.simulate import simulate
from report.browsing import errors, needs_browser, text, wait_for

pytestmark = needs_browser

BOX = Box.cube(50.0)
COMPARISON = "document.querySelector('[aria-label^=\"The same on\"] .command code').textContent"
LINE = "document.querySelector('.command code') !== null"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A measurement by six views, one of which is mirrored."""
    found = tmp_path_factory.mktemp("project")
    ring = Ring(views=6, arc=(0.0, 150.0), image_size=(30, 36), pixel_pitch=0.12)
    good = simulate(make_phantom("gaussians", BOX, 1), ring.cameras(), BOX, 1.00027, 0.05, 1, steps=30)
    good.write(found / "good.nc")
    d = good.displacements.clone()
    d[3] = d[3].flip(1) * torch.tensor([-1.0, 1.0])
    replace(good, displacement=d).write(found / "bad.nc")
    return found


def click(driver: Any, label: str) -> None:
    """Press a button by what it says."""
    wait_for(driver, f"return [...document.querySelectorAll('button')].some(b => b.textContent.includes({label!r}))")
    button = driver.find_element("xpath", f"//button[contains(., {label!r})]")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'}); arguments[0].click()", button)


def written(path: Path, seconds: float = 60.0) -> Measurement:
    """Wait for a file that a run writes, and read it."""
    end = time.monotonic() + seconds
    while not path.is_file():
        assert time.monotonic() < end, f"no {path.name}"
        time.sleep(0.1)
    return Measurement.read(path)


@pytest.mark.slow
def test_a_mirrored_view_is_found_and_undone(browser, server, folder):
    opened(browser, server, "check", LINE)
    click(browser, "Compare the views")
    wait_for(browser, "return document.querySelector('.tabled table') !== null", 120)
    assert "the image is mirrored left to right" in text(browser, ".tabled table")
    click(browser, "Correct the mistakes")
    found, good = written(folder / "bad.corrected.nc", 120), Measurement.read(folder / "good.nc")
    torch.testing.assert_close(found.displacement, good.displacement)
    click(browser, "Go on with bad.corrected.nc")
    wait_for(browser, f"return {COMPARISON}.includes('bad.corrected.nc')")
    assert errors(browser) == []


@pytest.mark.slow
def test_a_mask_is_drawn_taken_back_and_put_in(browser, server, folder):
    own = folder / "masks" / "good" / "0deg.png"  # drawn elsewhere, with another program
    own.parent.mkdir(parents=True)
    own.write_bytes(b"of the user")
    opened(browser, server, "displacement", LINE)
    wait_for(browser, "return document.querySelector('.cropper img') !== null")
    for column, row in ((6, 4), (30, 4), (30, 25), (6, 25)):
        for label, value in (("Column", column), ("Row", row)):
            box = browser.find_element("css selector", f"input[aria-label='{label} of the next corner (px)']")
            box.send_keys("\ue009" + "a" + "\ue000", str(value))
        click(browser, "Add a corner")
    wait_for(browser, "return document.querySelectorAll('.over .draft circle').length === 4")
    click(browser, "Close the polygon")
    wait_for(browser, "return document.querySelector('.over polygon.flow') !== null")
    assert "--drawn" in text(browser, ".command code")
    click(browser, "Undo")
    wait_for(browser, "return document.querySelector('.over polygon.flow') === null")
    click(browser, "Redo")
    wait_for(browser, "return document.querySelector('.over polygon.flow') !== null")
    opened(browser, server, "displacement", LINE)  # a reload loses nothing
    wait_for(browser, "return document.querySelector('.over polygon.flow') !== null")
    click(browser, "Apply the masks")
    (out,) = [word for word in text(browser, ".command code").split() if word.endswith(".masked.nc")]
    mask = written(folder / out).flow_mask
    assert bool(mask[0, 4:25, 6:30].all())
    assert not bool(mask[0, :3].any())
    assert own.read_bytes() == b"of the user"
    click(browser, f"Go on with {out}")
    wait_for(browser, f"return document.querySelector('input[aria-label=Measurement]').value === {out!r}")
    assert errors(browser) == []


@pytest.mark.slow
def test_what_is_typed_for_a_run_survives_a_reload(browser, server):
    opened(browser, server, "check", LINE)
    put(browser, "voxels", "16")
    wait_for(browser, f"return {COMPARISON}.includes('--voxels 16')")
    opened(browser, server, "displacement", LINE)
    wait_for(browser, "return document.querySelector('input[name=threshold]') !== null")
    put(browser, "threshold", "4.5")
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('--threshold 4.5')")
    opened(browser, server, "check", LINE)
    wait_for(browser, f"return {COMPARISON}.includes('--voxels 16')")
    opened(browser, server, "displacement", LINE)
    wait_for(browser, "return document.querySelector('.command code')?.textContent.includes('--threshold 4.5')")
    assert errors(browser) == []
