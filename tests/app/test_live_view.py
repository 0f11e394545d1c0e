"""A run as it is watched: its images and its surface follow what it leaves in its directory."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from app.projects import OUT, UPPER, snapshot
from app.visiting import visiting
from nerif.app.views.live_view import status_html
from nerif.app.views.surfaces import caption_of
from nerif.results.live import read_snapshot

pytestmark = pytest.mark.anyio


def test_a_slow_run_is_shown_to_be_one():
    job = SimpleNamespace(state="running", request="")
    live = {"title": "training", "step": 6, "seconds": 100.0, "progress": 0.1, "losses": {}, "remark": "a <b>"}
    assert status_html(job, live).endswith("<p class=note>a &lt;b&gt;</p>")
    assert "900 s left" in status_html(job, live)
    assert "note" not in status_html(job, {**live, "remark": ""})


def test_a_surface_has_a_caption(folder, tmp_path):
    place = read_snapshot(folder / OUT)
    assert place is not None
    assert place.volume.grid.box.upper == UPPER
    title = "Isosurface of refractive index at -5e-05, x from -6 to 6, y from -6 to 6, z from -6 to 6"
    assert caption_of(place).startswith(title)
    snapshot(tmp_path, -50.0, 3.0)
    nothing = read_snapshot(tmp_path)
    assert nothing is not None
    assert caption_of(nothing).endswith("nowhere yet.")


async def test_images_and_surface_follow_the_run(folder):
    def surfaces() -> list[str]:
        return [o.args[0] for o in user.scene_objects() if o.type == "stl"]

    async with visiting(folder) as user:
        await user.open("reconstruct", "x from -6 to 6")
        assert user.sees("It has ended. · Training: step 2, 1 s · loss 0.5")
        assert user.html.count("<img") == 5
        assert len(surfaces()) == 1
        snapshot(folder / OUT, 8.0, 2.0)
        await user.sees_soon("x from -8 to 8")
        assert any("x from -8 to 8" in e.props.get("aria-label", "") for e in user.all(role="img"))
        assert len(set(surfaces())) == 2
