"""A result directory of another person leads to no other file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from nerif.app.project.folder import ProjectFolder
from nerif.cli.cli import main
from nerif.results.directory import ResultDirectory
from nerif.results.metrics_file import Metrics
from refusals import refused


@pytest.mark.parametrize("name", ["figures", "volume.nc", "run.toml", "written.json", "trials", "trials/01"])
def test_links_that_lead_out_of_a_result_are_refused(tmp_path, name):
    result, outside = tmp_path / "project" / "result", tmp_path / "outside"
    (result / name).parent.mkdir(parents=True)
    (result / "run.toml").write_text("")
    outside.mkdir()
    (result / name).unlink(missing_ok=True)
    (result / name).symlink_to(outside if "." not in name else outside / "x")
    (outside / "x").write_text("")
    with refused(result / name):
        ResultDirectory(result)
    contents = ProjectFolder(tmp_path / "project").contents()
    assert contents.results == ()
    assert main(["figures", str(result)]) == 2
    assert [path.name for path in outside.iterdir()] == ["x"]


def test_links_within_a_result_are_followed(tmp_path):
    (tmp_path / "run.toml").write_text("voxels = 8\n")
    (tmp_path / "old").mkdir()
    (tmp_path / "figures").symlink_to("old")
    assert ResultDirectory(tmp_path).settings() == {"voxels": 8}


def test_files_that_a_result_names_are_read_near_it_or_the_current_folder(tmp_path, monkeypatch):
    private, folder, here = tmp_path / "private", tmp_path / "project", tmp_path / "here"
    for place in (private, folder, here):
        place.mkdir()
    small = ["--image-size", "6", "8", "--views", "3", "--truth-voxels", "5"]
    assert main(["simulate", "-o", str(private / "m.nc"), *small]) == 0

    def missing(measurement: str | Path, truth: str | Path) -> tuple[bool, bool, str]:
        directory = ResultDirectory(folder / "result")
        directory.begin({"measurement": str(measurement)})
        directory.write_metrics(Metrics(truth=str(truth)))
        result = directory.read()
        sentences = [gap.sentence for gap in result.missing if gap.name == "truth"]
        return result.measurement is None, result.truth is None, " ".join(sentences)

    monkeypatch.chdir(here)
    names = private / "m.nc", private / "m.truth.nc"
    measurement, truth, sentence = missing(*names)
    assert (measurement, truth) == (True, True)
    assert "m.truth.nc: outside of the current folder" in sentence
    (here / "link.nc").symlink_to(names[0])
    (folder / "link.nc").symlink_to(names[1])
    assert missing("link.nc", folder / "link.nc")[:2] == (True, True)
    assert missing(*(os.path.relpath(name) for name in names))[:2] == (True, True)
    monkeypatch.chdir(private)
    assert missing(*names)[:2] == (False, False)
    monkeypatch.chdir(here)
    (folder / "m.truth.nc").write_bytes(names[1].read_bytes())
    assert missing(*names)[:2] == (True, False)
