"""Pages of settings and runs, as a simulated user sees them."""

from __future__ import annotations

import pytest
from nicegui import ui

import nerif
from app.projects import SIMULATE
from app.visiting import visiting
from nerif.app.project.jobs import Jobs
from nerif.cli.cli import main
from nerif.geometry import Ring
from nerif.results.live import read_live, read_snapshot
from nerif.simulation.rig_design import DesignSettings, expect

pytestmark = pytest.mark.anyio


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    result = tmp_path_factory.mktemp("project")
    assert main(["simulate", "-o", str(result / "m & <b>.nc"), *SIMULATE]) == 0
    return result


async def test_the_design_follows_what_is_typed_and_other_tabs_begin_with_it(tmp_path):
    async with visiting(tmp_path) as user:
        await user.open("design", f"{expect(Ring(), DesignSettings()).displacement:.3f} px")
        assert user.lines() == [["nerif", "design"]]
        drawing = user.html.partition("<svg")[2]
        user.put("background_distance", 900.0)
        assert user.lines() == [["nerif", "design", "--background-distance", "900"]]
        assert user.sees(f"{expect(Ring(background_distance=900), DesignSettings()).displacement:.3f} px")
        assert user.html.partition("<svg")[2] != drawing
        user.put("focal_length", -3.0)
        assert user.sees("got -3.0")
        assert user.control("focal_length").props["aria-invalid"] == "true"
        user.put("focal_length", 60.0)
        assert not user.sees("got -3.0")
        slider = user.control("F number, slider")
        user.fire(slider, "input", str(int(slider.props["value"]) + 3))
        line = user.lines()
        assert "--f-number" in line[0]
        await user.open("design")
        assert user.lines() == line
        user.click("Back to the defaults")
        assert user.lines() == [["nerif", "design"]]


async def test_too_short_a_time_limit_is_said_before_the_start(small):
    async with visiting(small) as user:
        await user.open("reconstruct")
        user.put("time_limit", 1.0)
        await user.sees_soon("--time-limit 1 is too short")
        user.put("time_limit", 0.0)
        await user.until(lambda: not user.sees("too short"))


async def test_runs_are_listed_started_moved_read_and_forgotten(tmp_path):
    Jobs(tmp_path).add(("--version",), "of <another> server")
    async with visiting(tmp_path) as user:
        await user.open("design", "Read its command line before you start it")
        user.put("At the same time", 99)
        assert user.sees("expected 1 to 64")
        user.click("Start: of <another> server")
        await user.sees_soon("done")
        user.click("Log")
        await user.sees_soon(f"nerif {nerif.__version__}")
        user.click("Forget: of <another> server")
        await user.sees_soon("No runs yet.")
        user.put("At the same time", 2)
        assert user.work.jobs.at_once == 2
        button = user.all(ui.button, aria_label="Runs")[0]
        for label, state in (("Runs", "true"), ("Close the runs", "false")):
            user.click(label)
            assert button.props["aria-expanded"] == state


@pytest.mark.slow
async def test_a_run_is_watched_paused_gone_on_with_by_another_server_and_stopped(small):
    async with visiting(small) as user:
        await user.open("reconstruct")
        assert user.lines()[0][:3] == ["nerif", "reconstruct", "m & <b>.nc"]
        user.put("time_limit", 600.0)
        user.click("Start")
        await user.until(lambda: user.html.count("<img") >= 7)
        assert user.all(ui.echart)
        await user.open("reconstruct")  # a reload loses nothing
        await user.until(lambda: user.html.count("<img") >= 7)
        out = small / "results" / "m & <b>-nerif"
        result = read_snapshot(out)
        assert result is not None
        assert result.view == read_live(out)["view"]
        user.click("Pause")
        await user.sees_soon("Paused; the checkpoint is saved.")
        assert (out / "checkpoint.safetensors").is_file() or (out / "cross_validation").is_dir()
        user.click("Go on")
        await user.sees_soon("It runs.", ": step ")
        (job,) = user.work.jobs.all()
    async with visiting(small) as user:  # the server has ended, the run goes on
        await user.open("reconstruct")
        await user.sees_soon("It runs.", ": step ")
        assert [j.pid for j in user.work.jobs.all()] == [job.pid]
        user.click("Stop")
        await user.sees_soon("Stopped")
    assert (out / "volume.nc").is_file()
