"""The page of a sequence: in words, and in a real browser, where time is turned by slider and button."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zarr", reason="pip install '.[sequence]'")

from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.measurement_sequence import add_frames
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.network import NetworkShape
from nerif.fields.phantoms import Flame
from nerif.geometry import Box, Grid
from nerif.report import sequence_page
from nerif.report.sequence_page import render_sequence
from report.browsing import errors, image, needs_browser, requests, show, text, wait_for

GAS = {"composition": "air", "wavelength_nm": 532.0, "pressure_pa": 101325.0}


def store_of(path: Path, frames: int, **attributes: object) -> VolumeSequence:
    """A flame over time as nerif sequence leaves it: frame 1 failed, the last one missing."""
    box = Box((-25.0, -25.0, -20.0), (25.0, 25.0, 20.0))
    grid = Grid.of_resolution(box, 20)
    about = {"gas": GAS, "views": ["a", "b"], "withhold": ["b"], "measurement": "/x/film.zarr", **attributes}
    store = VolumeSequence.create(path, [i * 1e-4 for i in range(frames)], grid, ("index_excess",), 1.00027, about)
    add_frames(store.group, "status", frames, (), (), "int8", 0)
    add_frames(store.group, "reason", frames, (), (), "str", "")
    add_frames(store.group, "seconds", frames, (), (), "float64")
    for name, unit in (("cc", "1"), ("rms_px", "px")):
        add_frames(store.group, name, frames, (2,), ("view",), "float64", units=unit)
    for i in range(frames - 1):
        store.write(i, [Volume(Flame(box, time=store.times[i]).sample(grid), grid)])
        store.array("cc")[i], store.array("rms_px")[i] = np.array([0.99, 0.9]), np.array([0.01, 0.04])
        store.array("seconds")[i] = 2.0
        store.array("status")[i] = 1
    store.array("status")[1] = 2
    store.array("reason")[1] = "no valid pixel"
    return store


def test_the_page_tells_what_is_there_and_what_is_not(tmp_path):
    page = render_sequence(store_of(tmp_path / "r.zarr", 5, settings={"network": vars(NetworkShape())}))
    words = re.sub(r"<[^>]+>", " ", page[: page.index("<script")])
    for said in ("3 of 5", "1 frame failed", "frame 1: no valid pixel", "1 of 5 frames are missing", "film.zarr"):
        assert said in words, said
    assert "CC at least 0.99, rms error at most 0.01 px" in words
    assert "CC at least 0.9, rms error at most 0.04 px" in words
    assert "Measured and re-projected" not in words
    assert page.count('id="array-frame-') == 3


def test_a_long_film_is_thinned_out_and_the_page_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(sequence_page, "MOST", 6)
    page = render_sequence(store_of(tmp_path / "r.zarr", 16))
    assert page.count('id="array-frame-') == 6
    assert "6 of 14 frames, evenly spread" in page


def test_a_store_with_nothing_to_show_is_refused(tmp_path, capsys):
    store = store_of(tmp_path / "r.zarr", 3)
    store.array("status")[:] = 0
    with pytest.raises(InputError, match="no frame of it is done yet"):
        render_sequence(store)
    assert main(["report", str(tmp_path / "r.zarr")]) == 2
    assert main(["report", str(tmp_path / "none.zarr")]) == 2
    assert "no such store" in capsys.readouterr().err


@pytest.mark.slow
@needs_browser
def test_time_is_turned_by_slider_and_button(browser: Any, tmp_path: Path) -> None:
    store_of(tmp_path / "r.zarr", 6)
    assert main(["report", str(tmp_path / "r.zarr")]) == 0
    show(browser, tmp_path / "r.html")
    assert errors(browser) == []
    assert requests(browser) == []
    assert text(browser, "#time-text") == "0 ms, frame 0"
    first, space = image(browser, "#slice-y"), image(browser, "#space")
    label = text(browser, "#bar-ticks")
    browser.execute_script(
        "const t = document.getElementById('time'); t.value = 3; t.dispatchEvent(new Event('input'))"
    )
    wait_for(browser, "return document.getElementById('time-text').textContent === '0.4 ms, frame 4'")
    assert np.abs(image(browser, "#slice-y") - first).mean() > 0.5
    assert np.abs(image(browser, "#space") - space).mean() > 0.2
    assert text(browser, "#bar-ticks") == label  # the same colours at all times
    browser.execute_script("document.getElementById('play').click()")
    wait_for(browser, "return document.getElementById('time').value === '1'")
    browser.execute_script("document.getElementById('play').click()")
    assert text(browser, "#play") == "Play"
    assert errors(browser) == []
