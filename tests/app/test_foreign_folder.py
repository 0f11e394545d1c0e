"""A folder of another person: nothing in it is run, and no run that is found in it is started."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from nicegui import Client, ui

from app.serving import outside, served
from app.visiting import visiting
from nerif.app.forms.elements import card
from nerif.app.forms.sliders import RangeSlider
from nerif.app.pages import PAGES
from nerif.app.project.folder import ProjectFolder
from nerif.app.project.jobs import Jobs
from nerif.app.project.workspace import Workspace
from nerif.app.server.server import _handler
from refusals import refused

MODULES = ("numpy", "psutil", "torch", "types", "lazy_loader", "multiprocessing", "selectors", "nicegui", "zarr")
PLANTED = {
    "id": "planted", "title": "<b>planted</b>", "arguments": ["--version"], "attempt": ["--version"], "folder": "/",
    "out": "../../elsewhere", "request": "", "place": -1.0,
}  # fmt: skip


def plant(folder: Path, modules: Sequence[str] = MODULES) -> None:
    """Modules that leave a mark when they are imported, and a run that waits."""
    for name in modules:
        (folder / f"{name}.py").write_text(f"open({str(folder / 'mark')!r}, 'a').write({name!r})\n")
    (folder / ".numba_config.yaml").write_text("CACHE_DIR: compiled\n")  # which Numba unpickles
    where = folder / ".nerif" / "jobs" / "planted"
    where.mkdir(parents=True)
    (where / "job.json").write_text(json.dumps(PLANTED))


def ended(jobs: Jobs, id: str) -> str:
    """Wait for the end of a run, and return its state."""
    until = time.monotonic() + 60
    while (state := jobs.get(id).state) in ("queued", "running"):
        jobs.advance()
        assert time.monotonic() < until
        time.sleep(0.05)
    return state


@pytest.mark.slow
def test_the_app_runs_nothing_of_a_folder_and_its_users_run_nonetheless(tmp_path):
    plant(tmp_path)
    jobs = Jobs(tmp_path)
    own_job = jobs.add(("info", "m.nc"), "own").id
    with served(Path("."), cwd=tmp_path):
        assert ended(jobs, own_job) == "failed"  # there is no m.nc
    assert "m.nc" in jobs.log(own_job)[-1]
    assert jobs.get("planted").state == "held"
    assert not (jobs.directory / "planted" / "log.txt").exists()
    assert not (tmp_path / "mark").exists()


@pytest.mark.parametrize("link", [".nerif", ".nerif/jobs", ".nerif/checks", ".nerif/masks"])
def test_a_folder_whose_links_lead_what_the_app_writes_elsewhere_is_refused(tmp_path, link):
    folder, elsewhere = tmp_path / "project", tmp_path / "elsewhere"
    (folder / link).parent.mkdir(parents=True)
    elsewhere.mkdir()
    (folder / link).symlink_to(elsewhere)
    with refused("path"):
        Workspace(ProjectFolder(folder))
    assert not any(elsewhere.iterdir())


@pytest.mark.parametrize("text", ["[1]", '"x"', '{"design": 1}', "{"])
def test_settings_and_drafts_that_are_none_break_nothing(tmp_path, text):
    jobs = tmp_path / ".nerif" / "jobs"
    jobs.mkdir(parents=True)
    (tmp_path / ".nerif" / "drafts.json").write_text(text)
    (jobs / "settings.json").write_text(text.replace("design", "at_once").replace("1", '"many"'))
    work = Workspace(ProjectFolder(tmp_path))
    assert work.draft("design") == {}
    assert work.jobs.at_once == 1


def test_drafts_name_no_cluster(tmp_path):
    (tmp_path / ".nerif").mkdir()
    values = {"cluster": "tcp://10.0.0.1:8786", "voxels": 40}
    (tmp_path / ".nerif" / "drafts.json").write_text(json.dumps({"reconstruct": {"film_values": values}}))
    assert Workspace(ProjectFolder(tmp_path)).draft("reconstruct") == {"film_values": {"voxels": 40}}


@pytest.mark.parametrize("title", ["a :title=location.href \\", 'of "cam" & <b>', "plain"])
def test_a_name_gives_an_element_no_property_of_its_own(title):
    with Client(ui.page("/")):
        with card(title) as section:
            slider = RangeSlider(title, 3, 1, lambda step: title, on_change=lambda step: None)  # type: ignore[arg-type]
        assert dict(section.props) == {"aria-label": title}
        names = {"type", "min", "max", "step", "value", "aria-label", "aria-valuetext"}
        assert {*slider._input.props} == names
        assert slider._input.props["aria-valuetext"] == title


def test_a_run_that_was_found_is_shown_and_starts_only_by_hand(tmp_path):
    plant(tmp_path, ())
    jobs = Jobs(tmp_path)
    jobs.advance()
    assert [(job.id, job.state, job.line) for job in jobs.all()] == [("planted", "held", "nerif --version")]
    jobs.move("planted", -1)
    jobs.advance()
    assert not (jobs.directory / "planted" / "log.txt").exists()
    jobs.stop("planted")
    assert jobs.all()[0].state == "stopped"
    jobs.remove("planted")
    assert jobs.all() == []


def run(words: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder."""
    return subprocess.run([sys.executable, *words], cwd=folder, capture_output=True, text=True, env=outside())


def test_the_command_imports_nothing_of_a_folder_nor_do_its_workers(tmp_path):
    """As the script `nerif` starts it: its own folder is first on sys.path, and workers start with python -c."""
    command, folder = tmp_path / "bin" / "nerif", tmp_path / "project"
    command.parent.mkdir()
    folder.mkdir()
    plant(folder)
    command.write_text(
        "from nerif.cli.cli import main\n"
        "if __name__ == '__main__':\n"
        "    assert main() == 0\n"
        "    import numba\n"
        "    from nerif.imaging.workers import work\n"
        "    print(dict(sorted(work(divmod, 7, [2, 3], 2))), repr(numba.config.CACHE_DIR))\n"
    )
    done = run([str(command), "--version"], folder)
    assert done.stdout.splitlines()[1:] == ["{0: (3, 1), 1: (2, 1)} ''"], done.stderr
    assert not (folder / "mark").exists()


def test_matplotlib_obeys_the_file_in_the_home_of_the_user_and_none_of_a_folder(tmp_path, monkeypatch):
    home, folder = tmp_path / "home" / "matplotlib", tmp_path / "project"
    home.mkdir(parents=True)
    folder.mkdir()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home.parent))
    monkeypatch.delenv("MPLCONFIGDIR", raising=False)
    (home / "matplotlibrc").write_text("lines.linewidth: 7\n")
    (folder / "matplotlibrc").write_text("text.usetex: True\ntext.latex.preamble: \\input{/etc/passwd}\n")
    code = "from nerif.cli.cli import main; main(); import matplotlib as m, os; print(os.getcwd());"
    done = run(["-c", code + "print([m.rcParams[n] for n in ('text.usetex', 'lines.linewidth')])", "--version"], folder)
    assert done.stdout.splitlines()[1:] == [str(folder), "[False, 7.0]"], done.stderr


def test_python_m_nerif_imports_no_package_of_a_folder(tmp_path):
    plant(tmp_path, ("numpy", "psutil", "torch"))
    done = run(["-m", "nerif", "info", "m.nc"], tmp_path)
    assert (done.returncode, "m.nc" in done.stderr) == (2, True), done.stderr
    assert not (tmp_path / "mark").exists()


@pytest.mark.anyio
async def test_pages_open_with_the_defaults_where_drafts_have_wrong_types(tmp_path):
    (tmp_path / ".nerif").mkdir()
    for wrong in (5, [1], {"a": 1}):
        drafts = dict.fromkeys((page.name for page in PAGES), dict.fromkeys(("leave_out", "values", "target"), wrong))
        (tmp_path / ".nerif" / "drafts.json").write_text(json.dumps(drafts))
        async with visiting(tmp_path) as user:
            for page in PAGES:
                await user.user.open(page.path)  # which demands status 200


def test_drafts_are_dropped_once(tmp_path, monkeypatch):
    reloads = []
    monkeypatch.setattr("nerif.app.server.server.ui.navigate.reload", lambda: reloads.append(1))
    work = Workspace(ProjectFolder(tmp_path))
    work.keep("design", {"views": 4})
    page = SimpleNamespace(build=lambda work: {}["no draft is the cause"])
    monkeypatch.setattr("nerif.app.server.server.frame", lambda *arguments: nullcontext())
    asyncio.run(_handler(work, page)())
    assert (work.draft("design"), reloads) == ({}, [1])
    with pytest.raises(KeyError):
        asyncio.run(_handler(work, page)())
