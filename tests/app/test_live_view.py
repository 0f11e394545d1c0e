"""A run as it is watched: its images and its surface follow what it leaves in its directory."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from app.serving import opened
from nerif.app.project.jobs import Jobs
from nerif.app.views.live_view import status_html
from nerif.app.views.surfaces import caption_of
from nerif.common.files import write_json
from nerif.results.directory import LIVE, LIVE_FIELD
from nerif.results.live import read_snapshot
from report.browsing import errors, needs_browser, requests, text, wait_for

OUT = "results/a <b>"
LOWER, UPPER = (-20.0, -15.0, -10.0), (20.0, 15.0, 10.0)


def look(directory: Path, radius: float, seconds: float) -> None:
    """Leave a look at a warm ball of that radius, mm, as a run does."""
    directory.mkdir(parents=True, exist_ok=True)
    z, y, x = np.meshgrid(np.linspace(-9.5, 9.5, 20), np.linspace(-14.5, 14.5, 30), np.linspace(-19.5, 19.5, 40),
                          indexing="ij")  # fmt: skip
    values = -1e-4 / (1 + np.exp(2 * (np.sqrt(x**2 + y**2 + z**2) - radius)))
    about = {
        "title": "training", "seconds": seconds, "quantity": "index_excess", "lower": LOWER, "upper": UPPER,
        "withheld": True, "view": "0", "components": ["u"], "unit": "px",
    }  # fmt: skip
    view = np.linspace(0, 1, 30, dtype=np.float32).reshape(5, 6, 1)
    part = directory / "part.npz"
    np.savez(part, about=np.array(json.dumps(about)), values=values.astype(np.float32), measured=view, predicted=view)
    part.replace(directory / LIVE_FIELD)


def watched(folder: Path) -> None:
    """Leave a run that has ended after two steps."""
    look(folder / OUT, 6.0, 1.0)
    live = {"title": "training", "step": 2, "seconds": 1.0, "progress": 1.0, "losses": {"loss": 0.5}}
    live |= {"written": time.time(), "view": "0", "curve": {"seconds": [0.5, 1.0], "step": [1, 2], "loss": [1, 0.5]}}
    write_json(folder / OUT / LIVE, live)
    jobs = Jobs(folder)
    job = jobs.add(["reconstruct", "m.nc", "--out", OUT, "--live"], "m.nc", OUT)
    write_json(jobs.directory / job.id / "started.json", {"pid": 1, "began": 0.0, "time": 1.0})
    write_json(jobs.directory / job.id / "ended.json", {"code": 0, "time": 2.0})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("project")
    watched(place)
    return place


def test_a_slow_run_is_shown_to_be_one():
    job = SimpleNamespace(state="running", request="")
    live = {"title": "training", "step": 6, "seconds": 100.0, "progress": 0.1, "losses": {}, "remark": "a <b>"}
    assert status_html(job, live).endswith("<p class=note>a &lt;b&gt;</p>")
    assert "note" not in status_html(job, {**live, "remark": ""})


def test_a_surface_has_a_caption(folder, tmp_path):
    place = read_snapshot(folder / OUT)
    assert place is not None
    assert place.volume.grid.box.upper == UPPER
    title = caption_of(place)
    assert title.startswith("Isosurface of refractive index at -5e-05, x from -6 to 6, y from -6 to 6, z from -6 to 6")
    look(tmp_path, -50.0, 3.0)
    nothing = read_snapshot(tmp_path)
    assert nothing is not None
    assert caption_of(nothing).endswith("nowhere yet.")


def test_the_surface_comes_from_the_folder_alone(server):
    cookie = {"Cookie": server.cookie()}
    assert server.get("/live-surface?of=results/a%20%3Cb%3E&stamp=1", cookie)[0] == 200
    assert server.get("/live-surface?of=results/a%20%3Cb%3E&stamp=1")[0] == 403
    for name in ("../x", "results", "%00", "/etc"):
        assert server.get(f"/live-surface?of={name}", cookie)[0] == 404


@needs_browser
def test_images_and_surface_follow_the_run(browser, server, folder):
    opened(browser, server, "reconstruct", "document.querySelectorAll('.images img').length === 5")
    wait_for(browser, "return document.querySelector('.live-surface canvas') !== null")
    assert "x from -6 to 6" in text(browser, ".live-surface figcaption")
    alt = "document.querySelector('.live-surface [role=img]').ariaLabel"
    assert "x from -6 to 6" in browser.execute_script(f"return {alt}")
    look(folder / OUT, 8.0, 2.0)
    wait_for(browser, f"return {alt}.includes('x from -8 to 8')")
    name = "performance.getEntriesByType('resource').filter(e => /live-surface/.test(e.name))"
    wait_for(browser, f"return {name}.length === 2")
    surfaces = [address for address in requests(browser) if "/live-surface?" in address]
    assert len(set(surfaces)) == 2
    assert errors(browser) == []
