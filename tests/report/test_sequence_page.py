"""The page of a sequence, also in a real browser."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zarr", reason="pip install '.[sequence]'")

from nerif.cli.cli import main
from nerif.data.measurement_sequence import add_frames
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.network_shape import NetworkShape
from nerif.fields.phantoms import Flame
from nerif.geometry import Box, Grid
from nerif.report import sequence_page
from nerif.report.sequence_page import render_sequence
from refusals import refused
from report.browsing import changed, errors, image, needs_browser, requests, show, slide, text, wait_for

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
        row = {"cc": np.array([0.99, 0.9]), "rms_px": np.array([0.01, 0.04]), "seconds": 2.0, "status": 1}
        for name, value in row.items():
            store.array(name)[i] = value
    store.array("status")[1], store.array("reason")[1] = 2, "no valid pixel"
    return store


def test_the_page_lists_what_is_available_and_what_is_not(tmp_path):
    page = render_sequence(store_of(tmp_path / "r.zarr", 5, settings={"network": vars(NetworkShape())}))
    words = re.sub(r"<[^>]+>", " ", page[: page.index("<script")])
    for phrase in (
        "3 of 5", "1 frame failed", "frame 1: no valid pixel", "1 of 5 frames are missing", "film.zarr",
        "CC at least 0.99, rms residual at most 0.01 px", "CC at least 0.9, rms residual at most 0.04 px",
    ):  # fmt: skip
        assert phrase in words, phrase
    assert "Measured and re-projected" not in words
    assert page.count('id="array-frame-') == 3


def test_of_a_long_film_some_frames_are_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(sequence_page, "MAX_FRAMES", 6)
    page = render_sequence(store_of(tmp_path / "r.zarr", 16))
    assert page.count('id="array-frame-') == 6
    assert "6 of 14 frames, evenly spread" in page


def test_a_store_without_frames_is_refused(tmp_path, capsys):
    store = store_of(tmp_path / "r.zarr", 3)
    store.array("status")[:] = 0
    with refused(store.path):
        render_sequence(store)
    assert main(["report", str(tmp_path / "r.zarr")]) == 2
    assert main(["report", str(tmp_path / "none.zarr")]) == 2
    assert "none.zarr: no such directory; expected one" in capsys.readouterr().err


@pytest.mark.slow
@needs_browser
def test_time_is_changed_by_slider_and_button(browser: Any, tmp_path: Path) -> None:
    store_of(tmp_path / "r.zarr", 6)
    assert main(["report", str(tmp_path / "r.zarr")]) == 0
    show(browser, tmp_path / "r.html")
    assert errors(browser) == requests(browser) == []
    assert text(browser, "#time-text") == "0 ms, frame 0"
    images, label = {name: image(browser, name) for name in ("#slice-y", "#space")}, text(browser, "#bar-ticks")
    slide(browser, "time", 3)
    wait_for(browser, "return document.getElementById('time-text').textContent === '0.4 ms, frame 4'")
    assert all(changed(before, image(browser, name), 5) > 0.002 for name, before in images.items())
    assert text(browser, "#bar-ticks") == label  # the same colours at all times
    browser.execute_script("document.getElementById('play').click()")
    wait_for(browser, "return document.getElementById('time').value === '1'")
    browser.execute_script("document.getElementById('play').click()")
    assert text(browser, "#play") == "Play"
    assert errors(browser) == []
