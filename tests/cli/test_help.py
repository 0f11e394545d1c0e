"""The help of nerif reconstruct, --set, and options that a method brings by itself."""

from __future__ import annotations

import re

import pytest

from nerif.cli.cli import COMMANDS, main
from nerif.cli.commands.help import GROUPS
from nerif.reconstruction.methods import METHODS


@pytest.mark.parametrize("method", METHODS)
def test_help_shows_the_frequent_options_in_groups(method, capsys):
    assert main(["reconstruct", "--method", method, "--help"]) == 0
    text = capsys.readouterr().out
    flags = re.findall(r"^  (?:-o, )?--([\w-]+)", text, re.M)
    assert 14 <= len(flags) <= 20
    shown = [line[:-1] for line in text.splitlines() if re.fullmatch(r"\w+:", line)]
    assert shown == [group for group in GROUPS if group not in ("frames", "computers")]
    assert ("max-steps" in flags) == (method == "nerif")
    assert ("iterations" in flags) == (method != "nerif")
    assert max(map(len, text.splitlines())) <= 100


def test_help_of_a_film_has_all_groups(capsys):
    assert main(["sequence", "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:-1] for line in lines if line[:-1] in GROUPS] == [group for group in GROUPS if group != "uncertainty"]
    assert len(lines) < 100


@pytest.mark.parametrize("command", ["reconstruct", "sequence"])
def test_help_all_shows_every_option(command, capsys):
    assert main([command, "--help", "all"]) == 0
    assert "--network.octave-decay" in capsys.readouterr().out


def test_a_setting_by_name(measurement, tmp_path, capsys):
    measurement.write(tmp_path / "m.nc")
    words = ["reconstruct", str(tmp_path / "m.nc"), "-o", str(tmp_path / "r"), "--no-report", "--withhold", "none"]
    small = ["--set", "network.width=16", "--set", "network.depth=2", "--set", "max_steps=3", "--voxels", "8"]
    assert main([*words, *small]) == 0
    assert "width = 16" in (tmp_path / "r" / "run.toml").read_text()
    for wrong in ("network.width", "=3", "network.breadth=3"):
        assert main([*words, "--force", "--set", wrong]) == 2
    assert "did you mean" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("command", [c for c in COMMANDS if c not in ("reconstruct", "sequence")])
def test_every_option_is_explained(command, capsys):
    assert main([command, "--help"]) == 0
    text = re.sub("[│╭╮╰╯─|+]|-{5,}", " ", capsys.readouterr().out)
    options = re.split(r"\n\s+(?=-\w|--\w)", text)[1:]
    assert options
    for option in options:
        explained = re.sub(r"--?[\w.-]+|\b[A-Z]+\b|None|\{.*?\}|\(default.*|\(required.*", "", " ".join(option.split()))
        assert re.search("[a-z]{2}", explained), option
