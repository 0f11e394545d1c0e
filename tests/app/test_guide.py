"""The demo project and its guide: what is rendered, and which hint is shown when."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from app.visiting import visiting
from nerif.app.forms.form import Form
from nerif.app.pages import PAGES
from nerif.app.pages.check import VIEW_SETTINGS, findings_file
from nerif.app.pages.displacement import BY_PAGE
from nerif.app.pages.guide import state
from nerif.app.pages.page import Page
from nerif.app.pages.reconstruct import form_of
from nerif.app.project import demo_project as demo
from nerif.app.project.folder import ProjectFolder
from nerif.app.project.workspace import Workspace
from nerif.cli.cli import main
from nerif.cli.commands.check import Check
from nerif.cli.commands.design import Design
from nerif.cli.commands.displacement import Displacement
from nerif.results.directory import ResultDirectory
from refusals import refused

pytestmark = pytest.mark.anyio
HINTS = [page.hint for page in PAGES]


def marked(folder: Path) -> Path:
    """A demo project without images."""
    (folder / ".nerif").mkdir(parents=True)
    (folder / demo.MARK).write_text('{"complete": true}')
    return folder


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


def test_a_new_folder_is_filled_once_also_after_an_interruption(tmp_path, renders, monkeypatch, capsys):
    folder = tmp_path / "a" / "b"

    def interrupted(folder: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(demo, "render", interrupted)
        with pytest.raises(KeyboardInterrupt):
            demo.fill(folder)
    for phrase in ("rendering", "earlier start"):
        demo.fill(folder)
        assert phrase in capsys.readouterr().out
    assert renders == [folder / "images"]
    assert demo.is_demo(folder)
    assert json.loads((folder / demo.MARK).read_text()) == {"complete": True}
    assert not (folder / "images" / "truth" / "calibration.toml").exists()


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path, renders, capsys):
    (tmp_path / "thesis.tex").write_text("x")
    for folder in (tmp_path, tmp_path / "thesis.tex"):
        with refused(folder):
            demo.fill(folder)
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


def test_states_follow_the_files(tmp_path, project):
    folder = marked(tmp_path / "demo")
    work, pages = Workspace(ProjectFolder(folder)), {page.name: page for page in PAGES}

    def states(*names: str) -> list[str]:
        """What the guide says on pages, and where its link leads."""
        states = [state(work, pages[name], PAGES) for name in names]
        return [f"{sentence} {word} {page.name if page else ''}".strip() for sentence, word, page in states]

    assert states("design", "images") == ["Next: images", "Next: calibration"]
    assert states("calibration", "displacement", "results") == [
        "Not done yet. Next: displacement", "First complete the step Calibration. Back to calibration",
        "First complete the step Reconstruct. Back to reconstruct",
    ]  # fmt: skip
    shutil.copy(project / "made.toml", folder / "calibration.toml")
    assert states("calibration", "displacement") == ["Done. Next: displacement", "Not done yet. Next: check"]
    shutil.copy(project / "m.nc", folder / "measurement.nc")
    assert states("displacement", "check") == ["Done. Next: check", "Not done yet. Next: reconstruct"]
    (folder / ".nerif" / "checks").mkdir()
    (folder / findings_file("measurement.nc")).write_text("{}")
    ResultDirectory(folder / "results" / "a").begin({"method": "nerif"})
    assert states("check", "reconstruct") == ["Done. Next: reconstruct", "Not done yet. Next: results"]
    shutil.copytree(project / "results" / "other", folder / "results" / "b")
    assert states("reconstruct", "results")[0] == "Done. Next: results"
    assert states("results")[0].startswith("This was the last page")
    more = Page("more", "More", "A page without a hint.", lambda work: None)
    assert state(work, PAGES[0], (*PAGES, more))[2] is PAGES[1]


async def test_hints_are_hidden_recalled_and_fill_in_values(tmp_path):
    async with visiting(marked(tmp_path / "demo")) as user:
        for i, page in enumerate(PAGES, start=1):
            await user.open(page.name, f"Guide, step {i} of 7: {page.title}")
        await user.open("displacement", "First complete the step Calibration.")
        assert user.sees("Back to Calibration")
        await user.open("design", "Fill in the values")
        user.click("Fill in the values")
        await user.until(lambda: "--views" in user.lines()[0])
        await user.sees_soon("Next: Images")
        user.click("Hide the guide")
        assert not user.sees("Guide, step")
        await user.open("check", "Show the guide")  # on all pages
        user.click("Show the guide")
        assert user.sees("Guide, step 5 of 7: Check")


async def test_other_projects_have_no_guide(tmp_path):
    async with visiting(tmp_path) as user:
        await user.open("design")
        assert not user.sees("Guide")
