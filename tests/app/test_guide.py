"""The demo project and its guide: what is rendered, which hint is shown when, and the whole walk by clicks."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from app.serving import Served, opened, served
from app.test_accessibility import CUT, PHONE, RULES, axe, metrics, settled
from app.test_check_and_masks import click, ended
from app.test_results import result, tab
from nerif.app.forms.form import Form
from nerif.app.pages import PAGES
from nerif.app.pages.check import VIEW_SETTINGS, findings_file
from nerif.app.pages.displacement import BY_PAGE
from nerif.app.pages.guide import state
from nerif.app.pages.page import Page
from nerif.app.pages.reconstruct import form_of
from nerif.app.project import demo_project as demo
from nerif.app.project.folder import ProjectFolder
from nerif.app.project.jobs import Jobs
from nerif.app.project.workspace import Workspace
from nerif.cli.cli import main
from nerif.cli.commands.check import Check
from nerif.cli.commands.design import Design
from nerif.cli.commands.displacement import Displacement
from nerif.common.files import read_toml
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.geometry import Ring
from nerif.geometry.camera import Camera
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulation import Simulation
from refusals import refused
from report.browsing import errors, needs_browser, text, wait_for

HINTS = [page.hint for page in PAGES]
LONGEST = 300.0  # seconds of the whole walk; 122 beside other work on two cores
LONGEST_RUN = 90.0  # seconds of the reconstruction, without imports and report
STATUS = "document.querySelector('.guide .status')?.textContent"


def marked(folder: Path) -> Path:
    """A demo project without images."""
    (folder / ".nerif").mkdir(parents=True)
    (folder / demo.MARK).write_text('{"complete": true}')
    return folder


def cameras() -> list[Camera]:
    """Three small cameras."""
    return Ring(views=3, arc=(20.0, 100.0), image_size=(12, 16), pixel_pitch=0.3).cameras()


# -- the project -------------------------------------------------------------------------------------------------


@pytest.fixture
def renders(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Folders that would have been rendered into."""
    folders: list[Path] = []

    def render(folder: Path) -> None:
        (folder / "truth").mkdir(parents=True, exist_ok=True)
        (folder / "truth" / "calibration.toml").write_text("")
        folders.append(folder)

    monkeypatch.setattr(demo, "render", render)
    return folders


def test_a_new_folder_is_filled_once(tmp_path, renders, capsys):
    demo.fill(tmp_path / "a" / "b")
    assert renders == [tmp_path / "a" / "b" / "images"]
    assert demo.is_demo(tmp_path / "a" / "b")
    assert not (tmp_path / "a" / "b" / "images" / "truth" / "calibration.toml").exists()
    assert "rendering" in capsys.readouterr().out
    demo.fill(tmp_path / "a" / "b")
    assert len(renders) == 1
    assert "earlier start" in capsys.readouterr().out


def test_a_start_that_was_interrupted_is_repeated(tmp_path, renders, monkeypatch):
    def interrupted(folder: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(demo, "render", interrupted)
        with pytest.raises(KeyboardInterrupt):
            demo.fill(tmp_path)
    demo.fill(tmp_path)
    assert len(renders) == 1
    assert json.loads((tmp_path / demo.MARK).read_text()) == {"complete": True}


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path, renders, capsys):
    (tmp_path / "thesis.tex").write_text("x")
    with refused(tmp_path) as error:
        demo.fill(tmp_path)
    assert "thesis.tex" in str(error.value)
    with refused(tmp_path / "thesis.tex"):
        demo.fill(tmp_path / "thesis.tex")
    assert main(["app", str(tmp_path), "--demo", "--no-browser"]) == 2
    assert "new or an empty folder" in capsys.readouterr().err
    assert renders == []
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_the_default_folder_is_a_new_one(tmp_path, renders, monkeypatch):
    calls = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("nerif.app.server.server.serve", lambda folder, *_: calls.append(folder))
    assert main(["app", "--demo", "--no-browser"]) == 0
    assert main(["app", "--no-browser"]) == 0
    assert main(["app", "mine", "--demo", "--no-browser"]) == 0  # it need not exist
    assert calls == [Path("nerif-demo"), Path("."), Path("mine")]
    assert renders == [Path("nerif-demo/images"), Path("mine/images")]


# -- the hints ---------------------------------------------------------------------------------------------------


def test_hints_are_plain_sentences_and_name_steps_with_an_output():
    for hint in HINTS:
        assert not hint.before or next(page.hint.done for page in PAGES if page.name == hint.before)
        assert all(words.endswith(".") for words in (hint.purpose, hint.click, hint.look))
        assert ("Fill in the values" in hint.click) == bool(hint.values)


def test_values_of_the_hints_are_valid_in_their_forms():
    forms = {
        "design": Form(Design(), ("design",), without=("config", "out", "force")),
        "displacement.run": Form(Displacement(Path("."), Path("."), Path("m.nc")), without=BY_PAGE),
        "check.views": Form(Check(Path("m.nc")), only=VIEW_SETTINGS),
    }
    entries = {key: dict(values) for hint in HINTS for key, values in hint.values.items()}
    run = entries.pop("reconstruct")
    forms["run"], entries["run"] = form_of(run["method"], run["preset"]), run["values"]
    assert set(forms) == set(entries)
    for key, values in entries.items():
        assert forms[key].errors(values) == {}, key
        assert forms[key].changed(values) == values, key
    assert "max_steps" in run["values"]  # it ends by steps


def test_states_follow_the_files(tmp_path):
    folder = marked(tmp_path / "demo")
    work, pages = Workspace(ProjectFolder(folder)), {page.name: page for page in PAGES}

    def sentence(name: str) -> str:
        return state(work, pages[name], PAGES)[0]

    def after(name: str) -> tuple[str, str]:
        _, word, page = state(work, pages[name], PAGES)
        return word, page.name if page else ""

    assert sentence("design") == sentence("images") == ""
    assert sentence("calibration") == "Not done yet."
    assert sentence("displacement") == "First complete the step Calibration."
    assert after("displacement") == ("Back to", "calibration")
    assert sentence("results") == "First complete the step Reconstruct."
    write_cameras(folder / "calibration.toml", [CalibratedCamera.from_camera(camera) for camera in cameras()])
    assert sentence("calibration") == "Done."
    assert sentence("displacement") == "Not done yet."
    assert after("displacement") == ("Next:", "check")
    Simulation(phantom="gaussians", truth_voxels=6)(cameras())[0].write(folder / "measurement.nc")
    assert sentence("displacement") == "Done."
    assert sentence("check") == sentence("reconstruct") == "Not done yet."
    (folder / ".nerif" / "checks").mkdir()
    (folder / findings_file("measurement.nc")).write_text("{}")
    assert sentence("check") == "Done."
    ResultDirectory(folder / "results" / "a").begin({"method": "nerif"})
    assert sentence("reconstruct") == "Not done yet."
    result(folder / "results" / "b", 8, 0.0)
    assert sentence("reconstruct") == "Done."
    assert sentence("results").startswith("This was the last page")
    more = Page("more", "More", "/more", "A page without a hint.", lambda work: None)
    assert state(work, PAGES[0], (*PAGES, more))[2] is PAGES[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return marked(tmp_path_factory.mktemp("projects") / "demo")


@needs_browser
def test_hints_are_hidden_recalled_and_fill_in_values(browser, server):
    for page in PAGES:
        opened(browser, server, page.path.lstrip("/"), f"{STATUS} !== undefined")
        assert text(browser, ".guide h2").endswith(f"of 7: {page.title}")
    opened(browser, server, "displacement", f"{STATUS} === 'First complete the step Calibration.'")
    assert text(browser, ".guide a.next") == "Back to Calibration"
    opened(browser, server, "design", f"{STATUS} !== undefined")
    click(browser, "Fill in the values")
    wait_for(browser, "return document.querySelector('.command code')?.textContent.includes('--views 6')")
    wait_for(browser, "return window.socket?.connected && document.querySelector('.guide a.next') !== null")
    click(browser, "Hide the guide")
    gone = "!document.querySelector('.guide').checkVisibility()"
    wait_for(browser, f"return {gone}")
    opened(browser, server, "check", gone)  # on all pages
    click(browser, "Show the guide")
    wait_for(browser, "return document.querySelector('.guide').checkVisibility()")
    assert errors(browser) == []


@needs_browser
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_a_hint_breaks_no_rule_on_a_phone(browser, server, dark):
    scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics(*PHONE))
    opened(browser, server, "displacement", f"{STATUS} === 'First complete the step Calibration.'")
    settled(browser)
    browser.execute_script(axe())
    assert list(browser.execute_async_script(RULES)) == []
    assert browser.execute_script(CUT) == []
    covered = browser.execute_script("return document.querySelector('nav').getBoundingClientRect().right")
    assert covered <= 0  # the navigation does not lie over the page
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@needs_browser
def test_other_projects_have_no_guide(browser, tmp_path):
    with served(tmp_path) as server:
        opened(browser, server, "design", "document.querySelector('.command code') !== null")
        assert "Guide" not in text(browser, "main")
        assert browser.execute_script("return document.querySelector('.guide-place')") is None


# -- the walk ----------------------------------------------------------------------------------------------------


def follow(driver: Any, title: str) -> None:
    """Follow the link of the guide to the next page."""
    wait_for(driver, "return document.querySelector('.guide a.next.ready') !== null")
    link = driver.find_element("css selector", ".guide a.next")
    assert link.text == f"Next: {title}"
    driver.execute_script("arguments[0].click()", link)
    there = f"document.querySelector('main h1')?.textContent === '{title}' && window.socket?.connected"
    wait_for(driver, f"return {there} && {STATUS} !== undefined")


def fill_in(driver: Any, words: str) -> None:
    """Press the button that fills in values, and wait for them in a command line."""
    click(driver, "Fill in the values")
    lines = "[...document.querySelectorAll('.command code')].map(code => code.textContent)"
    wait_for(driver, f"return {lines}.some(line => line.includes({words!r})) && window.socket?.connected")
    wait_for(driver, f"return {STATUS} !== undefined")


def done(driver: Any, seconds: float) -> None:
    """Wait until the guide says that the step is done."""
    wait_for(driver, f"return {STATUS} === 'Done.'", seconds)


@pytest.mark.slow
@needs_browser
def test_the_walk_leads_from_images_to_a_report(browser, tmp_path, capsys, record_property):
    folder, seconds, begun = tmp_path / "nerif-demo", {}, time.monotonic()

    def note(step: str) -> None:
        seconds[step] = round(time.monotonic() - begun - sum(seconds.values()), 1)

    with served(folder, "--demo") as server:
        note("images rendered")
        walk(browser, server, folder, note)
        assert errors(browser) == []
    total = time.monotonic() - begun
    record_property("seconds", {**seconds, "total": round(total, 1)})
    with capsys.disabled():
        print(f"\nthe walk: {total:.0f} s ({', '.join(f'{step} {s:.0f}' for step, s in seconds.items())})")
    (out,) = (folder / "results").iterdir()
    about = read_toml(out / "run.toml")["about"]
    assert about["outcome"] == "steps"
    assert ResultDirectory(out).read().metrics.views
    assert (out / "report.html").stat().st_size > 100_000
    assert about["seconds"] < LONGEST_RUN
    assert total < LONGEST


def walk(driver: Any, server: Served, folder: Path, note: Any) -> None:
    """Do on every page what its hint says."""
    opened(driver, server, "design", f"{STATUS} !== undefined")
    fill_in(driver, "--views 6")
    note("Design")
    follow(driver, "Images")
    wait_for(driver, "return document.querySelectorAll('.view .pair img').length === 12")
    note("Images")
    follow(driver, "Calibration")
    wait_for(driver, "return document.querySelectorAll('.target circle').length > 50")
    click(driver, "Calibrate")
    done(driver, 60)
    wait_for(driver, "return document.querySelectorAll('.tabled tbody tr').length === 6")
    note("Calibration")
    follow(driver, "Displacement")
    fill_in(driver, "--upper 25 25 25")
    click(driver, "Preview")
    wait_for(driver, "return document.querySelectorAll('.images img').length >= 3", 60)
    click(driver, "Find all displacements")
    done(driver, 60)
    note("Displacement")
    follow(driver, "Check")
    fill_in(driver, "--voxels 12")
    click(driver, "Compare the views")
    wait_for(driver, "return document.querySelectorAll('.tabled tbody tr').length === 6", 90)
    assert "No problems found" in text(driver, 'section[aria-label="Findings"]')
    done(driver, 10)
    note("Check")
    follow(driver, "Reconstruct")
    fill_in(driver, "--max-steps 250")
    click(driver, "Start")
    wait_for(driver, "return document.querySelector('.live-surface canvas') !== null", 90)
    driver.get("about:blank")  # drawn without a graphics card, the surface takes a core from the run, which goes on
    assert ended(Jobs(folder), 240).state == "done"
    opened(driver, server, "reconstruct", f"{STATUS} === 'Done.'")
    wait_for(driver, "return document.querySelector('section[aria-label=\"The run\"] .status').textContent"
                     ".includes('It has ended')", 60)  # fmt: skip
    note("Reconstruct")
    follow(driver, "Results")
    wait_for(driver, "return document.querySelectorAll('.cuts img[src]').length === 3")
    tab(driver, "Report")
    wait_for(driver, "return document.querySelector('iframe.report') !== null")
    wait_for(driver, f"return {STATUS}.startsWith('This was the last page')")
    note("Results")
