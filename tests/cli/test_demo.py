"""nerif demo, and the real measurements that come with nerif."""

from __future__ import annotations

import webbrowser

import nerif
from nerif.cli.cli import main
from nerif.cli.commands.demo import DEMOS
from nerif.data.samples import SAMPLES
from nerif.results.directory import REPORT, ResultDirectory
from refusals import refused


def test_every_sample_has_a_demo_its_origin_and_a_licence(tmp_path, capsys):
    assert main(["demo", "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[2] for line in lines] == [*DEMOS]
    assert {*SAMPLES} <= {*DEMOS}
    size = 0
    for name, sample in SAMPLES.items():
        folder = nerif.sample(name, tmp_path / name)
        licence = (folder / "LICENSE").read_text()
        assert {"MIT": "Permission is hereby granted", "CC0-1.0": "CC0 1.0"}[sample.licence] in licence
        assert (folder / "README.md").read_text()
        size += sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    assert size < 3e6


def test_a_sample_replaces_no_foreign_file(tmp_path):
    (tmp_path / "measurement.nc").write_text("mine")
    for _ in range(2):
        nerif.sample("spray", tmp_path)
    assert (tmp_path / "measurement.before.nc").read_text() == "mine"
    assert len(nerif.read(tmp_path / "measurement.nc").names) == 18


def test_an_unknown_sample_or_demo_is_refused(tmp_path, capsys):
    with refused("name"):
        nerif.sample("rocket", tmp_path)
    assert main(["demo", "rocket"]) == 2
    assert "flame" in capsys.readouterr().err


def test_real_absorption_becomes_a_report(tmp_path, capsys, monkeypatch):
    pages = []
    monkeypatch.setattr(webbrowser, "open", lambda page: pages.append(page) or True)
    out = tmp_path / "spray"
    assert main(["demo", "spray", "--out", str(out), "--steps", "5", "--open"]) == 0
    printed = capsys.readouterr().out
    assert "$ nerif reconstruct" in printed
    assert pages == [(out / REPORT).resolve().as_uri()]
    assert pages[0] in printed
    assert ResultDirectory(out).metrics().views
    assert main(["demo", "spray", "--out", str(out)]) == 2
    assert "--force" in capsys.readouterr().err


def test_commands_of_the_demos_have_options_that_exist(tmp_path):
    from nerif.cli.arguments import check_arguments

    for name, demo in DEMOS.items():
        out = tmp_path / name
        out.mkdir()
        for stage in demo.stages:
            words = stage.words(out, 3)
            for place in (*stage.files, "measurement.nc"):
                (out / place).touch()
            check_arguments(words[0], words[1:])
