"""The contents of a folder, and that nothing outside of it is touched."""

from __future__ import annotations

from contextlib import chdir
from pathlib import Path
from unittest.mock import Mock

import pytest

from nerif.app.project.folder import Contents, ProjectFolder
from nerif.app.project.workspace import Workspace
from nerif.cli.cli import main
from refusals import refused


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "secret").write_text("x")
    inside = tmp_path / "project"
    inside.mkdir()
    return inside


def test_paths_and_links_that_lead_outside_are_refused(folder):
    (folder / "out").symlink_to(folder.parent)
    (folder / "in").symlink_to(folder)
    project = ProjectFolder(folder)
    for name in ("../secret", "/etc/passwd", "a/../../secret", "x\0y", "out/secret"):
        with refused("path"):
            project.path(name)
    assert project.path("") == folder
    assert project.path("in/new.nc") == folder / "new.nc"
    assert project.relative(folder / "in" / "a b.nc") == "a b.nc"


def test_no_name_in_a_folder_is_an_option(folder, capsys):
    (folder / "--out=..").mkdir()
    (folder / "--out=.." / "run.toml").write_text("")
    (folder / "--config=x.nc").write_bytes(b"CDF no")
    (folder / "-ox.toml").write_text('format = "nerif-calibration-1"\n')
    project = ProjectFolder(folder)
    contents = project.contents()
    assert contents.measurements == ("./--config=x.nc",)
    assert contents.calibrations == ("./-ox.toml",)
    assert contents.results == ("./--out=..",)
    assert project.relative(folder / "--config=x.nc") == "./--config=x.nc"
    assert project.path("./--config=x.nc") == folder / "--config=x.nc"
    with chdir(folder):
        assert main(["info", *contents.measurements]) == 2
    assert "x.nc" in capsys.readouterr().err.partition(":")[2]


def test_what_is_in_a_folder(folder):
    small = ["--image-size", "6", "8", "--views", "3", "--truth-voxels", "5"]
    assert main(["simulate", "-o", str(folder / "<b>&.nc"), *small]) == 0
    (folder / "cal.toml").write_text('format = "nerif-calibration-1"\n')
    (folder / "notes.toml").write_text("a = 1\n")
    (folder / "broken.nc").write_bytes(b"CDF no")
    (folder / "closed").mkdir(mode=0)  # root may read it nonetheless
    (folder / "runs" / "one").mkdir(parents=True)
    (folder / "runs" / "one" / "run.toml").write_text("")
    (folder / "film.zarr").mkdir()
    for source in ("reference", "flow"):
        (folder / "images" / "cam1" / source).mkdir(parents=True)
    (folder / "away").symlink_to(folder.parent)
    (folder / "away.nc").symlink_to(folder.parent / "secret")
    project = ProjectFolder(folder)
    files = project.contents()
    assert files == Contents(
        experiments=("images",), calibrations=("cal.toml",), measurements=("<b>&.nc", "broken.nc"),
        results=("runs/one",), films=("film.zarr",),
    )  # fmt: skip
    assert [view.name for view in project.views("images")] == ["cam1"]


def test_what_is_kept_of_files_is_bounded(folder, monkeypatch):
    monkeypatch.setattr("nerif.app.project.folder.LIMIT", 3)
    project = ProjectFolder(folder)
    for i in range(5):
        (folder / str(i)).touch()
        for what in ("measurement", "kind"):
            project.from_cache(str(i), what, lambda path: path.name)
    assert {what: [path.name for path in cache] for what, cache in project._cache.items()} == {
        "measurement": ["3", "4"],
        "kind": ["2", "3", "4"],
    }


def test_two_servers_keep_the_drafts_of_each_other(folder):
    first, second = Workspace(ProjectFolder(folder)), Workspace(ProjectFolder(folder))
    for work in (first, second):
        assert work.draft("design") == {}
    first.keep("design", {"views": 5})
    second.keep("check", {"view": "a"})
    third = Workspace(ProjectFolder(folder))
    assert (third.draft("design"), third.draft("check")) == ({"views": 5}, {"view": "a"})
    assert [path.name for path in (folder / ".nerif").iterdir()] == ["drafts.json"]


def test_what_is_kept_of_a_file_is_as_new_as_the_file(folder):
    project, read = ProjectFolder(folder), Mock(side_effect=Path.read_text)
    for text in ("1", "22"):
        (folder / "a").write_text(text)
        assert [project.from_cache("a", "text", read) for _ in range(3)] == [text] * 3
    assert read.call_count == 2


def test_names_that_are_free(folder):
    (folder / "x").mkdir()
    assert ProjectFolder(folder).free_name("x") == "x-2"
    assert ProjectFolder(folder).free_name("y.nc") == "y.nc"
