"""What befalls a lab: two tabs, a reload and a killed server in the middle of training, a folder of another user."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from app.serving import Served, served
from app.test_pages import line, put, visit
from nerif.app.pages import PAGES
from nerif.app.project.jobs import Jobs
from nerif.app.project.workspace import READ_ONLY
from nerif.cli.cli import main
from report.browsing import errors, needs_browser, text, wait_for

pytestmark = needs_browser

BOUND = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")  # root that rights of files hold for, too
SMALL = ["--image-size", "20", "24", "--pixel-pitch", "0.18", "--views", "4", "--arc", "0", "135"]
GOES_ON = "return /It runs.*step [1-9]/.test(document.querySelector('.status')?.textContent)"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("project")
    assert main(["simulate", "-o", str(directory / "m.nc"), *SMALL, "--truth-voxels", "8"]) == 0
    return directory


def press(driver: Any, label: str) -> None:
    """Press a button of the run that is watched."""
    driver.find_element("xpath", f"//section[@aria-label='The run']//button[contains(., '{label}')]").click()


@pytest.mark.slow
def test_what_is_typed_in_one_tab_is_there_in_the_next(browser, server):
    visit(browser, server, "design")
    put(browser, "focal_length", "85")
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('85')")
    first = browser.current_window_handle
    browser.switch_to.new_window("tab")
    visit(browser, server, "design")
    assert line(browser) == ["nerif", "design", "--focal-length", "85"]
    put(browser, "distance", "800")
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('800')")
    browser.close()
    browser.switch_to.window(first)
    assert line(browser) == ["nerif", "design", "--focal-length", "85"]  # a tab is not changed under the hands
    visit(browser, server, "design")
    assert line(browser) == ["nerif", "design", "--focal-length", "85", "--distance", "800"]
    assert errors(browser) == []


@pytest.mark.slow
def test_a_run_goes_on_when_its_server_is_killed(browser, folder):
    with served(folder) as server:
        visit(browser, server, "reconstruct")
        put(browser, "time_limit", "600")
        wait_for(browser, "return document.querySelector('.command code').textContent.includes('600')")
        browser.find_element("xpath", "//button[contains(., 'Start')]").click()
        wait_for(browser, GOES_ON, 120)
        visit(browser, server, "reconstruct")  # a reload in the middle of training
        wait_for(browser, GOES_ON)
        first = browser.current_window_handle
        browser.switch_to.new_window("tab")
        visit(browser, server, "reconstruct")
        wait_for(browser, GOES_ON)
        os.kill(server.pid, signal.SIGKILL)
        browser.close()
        browser.switch_to.window(first)
    (job,) = Jobs(folder).all()
    assert job.state == "running"
    assert psutil.pid_exists(job.pid)
    with served(folder) as server:
        visit(browser, server, "reconstruct")
        wait_for(browser, GOES_ON)
        wait_for(browser, "return document.querySelectorAll('.images img').length >= 7", 60)
        assert [j.pid for j in Jobs(folder).all()] == [job.pid]  # the same one
        press(browser, "Stop")
        wait_for(browser, "return document.querySelector('.status').textContent.includes('Stopped')", 120)
    assert (folder / job.out / "volume.nc").is_file()


@pytest.fixture
def closed(tmp_path: Path) -> Iterator[Path]:
    """A folder that may be read and not written to."""
    assert main(["simulate", "-o", str(tmp_path / "m.nc"), *SMALL, "--truth-voxels", "8"]) == 0
    tmp_path.chmod(0o555)
    yield tmp_path
    tmp_path.chmod(0o755)


def notice(driver: Any, server: Served, page: str) -> str:
    """What a page of the folder says of it."""
    driver.get(f"http://127.0.0.1:{server.port}/{page}?token={server.token}")
    wait_for(driver, "return document.querySelector('main [role=status]') !== null && window.socket?.connected")
    return text(driver, "main [role=status]")


@pytest.mark.slow
def test_a_folder_without_rights_is_one_line_and_can_be_read(browser, closed):
    root = os.geteuid() == 0
    if root and shutil.which("setpriv") is None:
        pytest.skip("root may write everywhere, and setpriv, by which it may not, is not there")
    with served(closed, by=BOUND if root else ()) as server:
        assert f"note: {READ_ONLY}" in server.output
        browser.get_log("browser")
        for page in PAGES:
            assert notice(browser, server, page.name) == READ_ONLY
        visit(browser, server, "reconstruct")
        assert line(browser)[:3] == ["nerif", "reconstruct", "m.nc"]
        browser.find_element("xpath", "//button[contains(., 'Start')]").click()
        wait_for(browser, "return document.querySelector('.q-notification') !== null")
        assert "Permission denied" in text(browser, ".q-notification")
        assert errors(browser) == []
    assert sorted(path.name for path in closed.iterdir()) == ["m.nc", "m.truth.nc"]
