"""The words after a command: values, errors, former names of options, settings files, help."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from nerif.cli.arguments import check_arguments
from nerif.cli.cli import COMMANDS, main
from nerif.cli.commands.body import BodyInFlow
from nerif.cli.commands.displacement import Displacement
from nerif.cli.commands.reconstruct import command_of
from nerif.cli.help import GROUPS
from nerif.cli.settings import read_settings
from nerif.common.settings import MISSING, Developer, options
from nerif.reconstruction.methods import METHODS

DEVELOPER = str.split(
    "betas momentum matrix_rate warm_up fit_steps rate_after_fit first_cycle full_precision_from compile "
    "network.octave_decay"
)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with a few files."""
    monkeypatch.chdir(tmp_path)
    for name in ("m.nc", "taken.vti"):
        (tmp_path / name).touch()


def read(words: str, method: str = "nerif", more: str = "") -> Any:
    """Return the settings of nerif reconstruct by words; `more`: betas."""
    arguments = [*words.split(), *(["--set", f"betas={more}"] if more else [])]
    return read_settings(command_of(method)(MISSING, MISSING, method=method), arguments, "reconstruct")


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("reconstruct m.nc -o r --epoch 3", "--epoch: unknown option; did you mean --epochs"),
        ("reconstruct m.nc -o r --method tv --network.width 3", "--network.width: unknown option"),
        ("reconstruct m.nc -o r --norm=l3", "--norm: expected one of l2, squared, got 'l3'"),
        ("reconstruct m.nc -o r --set epochs=abc", "--epochs: expected a number, got 'abc'"),
        ("reconstruct m.nc -o r --set network.width", "--set: expected NAME=VALUE"),
        ("reconstruct m.nc -o r --set network.breadth=3", "--network.breadth: unknown option; did you mean"),
        ("reconstruct m.nc -o r --method sart", "method: expected one of nerif, tikhonov, landweber, tv"),
        ("reconstruct m.nc -o r --method tv --regularisation much", "expected auto or a number, got 'much'"),
        ("reconstruct m.nc -o r --method tv --uncertainty quick", "expected one of off, fast, full, got 'quick'"),
        ("reconstruct m.nc -o r --max_steps 2.5", "--max-steps: expected a whole number, got '2.5'"),
        ("reconstruct m.nc -o r --max-steps -1", "--max-steps: expected 0 or more, got '-1'"),
        ("reconstruct m.nc -o r --max-steps", "--max-steps: expected INT, got none"),
        ("reconstruct m.nc -o r --samples 1", "--samples: expected 2 values, got 1"),
        ("reconstruct m.nc -o r --known 1 2 3", "--known: expected 4 values each"),
        ("reconstruct m.nc --epochs 3", "--out: expected PATH, got none"),
        ("reconstruct m.nc -o r n.nc", "n.nc: expected the name of an option"),
        ("reconstruct m.nc -o r --betas 0.9 0.99", "--betas: expected --set betas=VALUE, or betas in a settings file"),
        ("reconstruct m.nc -o r --network.octave-decay 1", "expected --set network.octave_decay=VALUE"),
        ("export m.nc -o taken.vti", "taken.vti: exists already"),
        ("export absent -o x.vti", "absent: no such directory"),
        ("app absent", "absent: no such folder"),
        ("calibrate absent", "absent: no such file or folder"),
        ("figures m.nc --columns", "--columns: unknown option"),
        ("figures m.nc --dpi 1", "--dpi: expected 20 or more, got '1'; see nerif figures --help"),
        ("reconstrct", "unknown command 'reconstrct'; did you mean 'reconstruct'"),
    ],
)
def test_wrong_arguments(words, error, refusal):
    line = refusal(*words.split())
    assert error in line, line


@pytest.mark.parametrize(
    "words",
    ["export m.nc -o taken.vti --force", "export absent --help", "app absent --demo", "reconstruct -o r --resume"],
)
def test_files_that_are_in_order(words):
    command, *arguments = words.split()
    check_arguments(command, arguments)


def test_values_of_every_kind():
    r = read("--lower=-1e-3 m.nc -or --axis-point 0 -3 2 --withhold a b --no-report --from images")
    assert (r.measurement, r.out, r.run.withhold, r.run.report) == (Path("m.nc"), Path("r"), ("a", "b"), False)
    n = r.reconstructor
    assert (n.lower, n.axis_point, n.source) == (-1e-3, (0.0, -3.0, 2.0), "images")
    r = read("m.nc -o r --set network.octave_decay=0.5 --epochs inf --set warm_up=3 --set report=false", more="0.8 0.9")
    n = r.reconstructor
    assert (n.network.octave_decay, n.warm_up, n.betas, r.run.report) == (0.5, 3, (0.8, 0.9), False)
    r = read("m.nc --out r --known 0 0 -14 1.0003 1 2 3 1 --regularisation 0.5 --gas.composition None --no-hull", "tv")
    tv = r.reconstructor
    assert (tv.probes, tv.hull, tv.regularisation) == (((0, 0, -14, 1.0003), (1, 2, 3, 1)), False, 0.5)
    words = "x --calibration c.toml -o m --frame-offset a -2 --frame-offset b 1"
    assert Displacement.read(words.split(), "displacement").frame_offset == {"a": -2, "b": 1}
    b = BodyInFlow.read(str.split("m.nc a.stl --unit cm b.stl --rotation 1 2 -3"), "body")
    assert (b.models, b.rotation) == ((Path("a.stl"), Path("b.stl")), (1.0, 2.0, -3.0))


@pytest.mark.parametrize(
    ("former", "present", "value", "entry"),
    [
        ("source", "from", "images", '"images"'),
        ("probes", "known", "0 0 1 1.0003", "[[0, 0, 1, 1.0003]]"),
        ("grow", "extend-open-faces", "2", "2.0"),
    ],
)
def test_former_names_are_valid_with_a_note(former, present, value, entry, capsys):
    Path("s.toml").write_text(f"{former} = {entry}\n")
    results = [read(f"m.nc -o r --{former} {value}"), read("m.nc -o r --config s.toml")]
    notes = capsys.readouterr().err.splitlines()
    assert notes == [f"nerif: note: --{former} is now --{present}; the former name is valid until nerif 1.0"] * 2
    now = read(f"m.nc -o r --{present} {value}")
    assert now != read("m.nc -o r")
    assert all((r.run, r.reconstructor) == (now.run, now.reconstructor) for r in results)
    assert capsys.readouterr().err == ""


# -- settings files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("learning_rat = 1.0", "unknown key 'learning_rat'; the nearest known one is 'learning_rate'"),
        ("[network]\nwidht = 3", "unknown key 'network.widht'; the nearest known one is 'network.width'"),
        ("[network]\nwidth = 0", "network.width: expected 1 or more, got 0"),
        ('epochs = "many"', "epochs: expected a number, got 'many'"),
        ('epochs = "3"', "epochs: expected a number, got '3'"),
        ("max_steps = true", "max_steps: expected a whole number, got True"),
        ("epochs = -1.0", "epochs: expected 0 or more, got -1.0"),
        ("samples = [1, 2, 3]", "samples: expected 2 values, got [1, 2, 3]"),
        ("epochs = ", "TOML"),
    ],
)
def test_invalid_settings_files(refusal, text, error):
    Path("run.toml").write_text(text)
    line = refusal("reconstruct", "m.nc", "-o", "r", "--config", "run.toml")
    assert "run.toml: " in line
    assert error in line
    assert not Path("r").exists()


@pytest.mark.parametrize(
    ("command", "entry"),
    [
        ("sequence", 'cluster = "tcp://127.0.0.1:9"'),
        ("sequence", "dashboard = true"),
        ("simulate", "force = true"),
        ("app", 'host = "0.0.0.0"\ntoken = "0123456789abcdef"'),
        ("app", 'allowed-host = ["evil.example"]'),
        ("app", 'root_path = "/evil"'),
    ],
)
def test_what_reaches_outside_is_set_on_the_command_line_only(refusal, command, entry):
    Path("s.toml").write_text(entry + "\n")
    name = entry.split()[0]
    words = {"app": ["."], "sequence": [".", "-o", "r.zarr"], "simulate": ["-o", "r.zarr"]}[command]
    line = refusal(command, *words, "--config", "s.toml")
    assert f"s.toml: expected no '{name}' in a file; give --{name.replace('_', '-')} on the command line" in line


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_takes_a_settings_file(refusal, command):
    Path("s.toml").write_text("nothing_of_the_kind = 1\n")
    assert "unknown key 'nothing_of_the_kind'" in refusal(command, "--config", "s.toml")
    assert "no such settings file" in refusal(command, "--config=none.toml")


# -- help ------------------------------------------------------------------------------------------------------------


def help_of(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[str, list[str]]:
    """Return the help of a command and the names of its options."""
    assert main([*words]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 100
    return text, re.findall(r"^  (?:-o, )?--([\w.-]+)", text, re.M)


@pytest.mark.parametrize("method", METHODS)
def test_help_shows_the_frequent_options_in_groups_and_all_that_people_set(method, capsys):
    text, flags = help_of(capsys, "reconstruct", "--method", method, "--help")
    assert 14 <= len(flags) <= 20
    groups = [line[:-1] for line in text.splitlines() if re.fullmatch(r"\w+:", line)]
    assert groups == [group for group in GROUPS if group not in ("frames", "computers")]
    assert ("max-steps" in flags, "iterations" in flags) == (method == "nerif", method != "nerif")
    text, flags = help_of(capsys, "reconstruct", "--method", method, "--help", "all")
    assert ("learning-rate" in flags) is (method == "nerif")
    assert ("regularisation" in flags) is (method in ("tikhonov", "tv"))
    hidden = (name.replace("_", "-") for name in DEVELOPER if method == "nerif")
    assert not {"source", *hidden} & {*flags}


def test_options_of_developers_are_those_of_the_training():
    every = options(command_of("nerif")(MISSING, MISSING))
    assert {name for name, option in every.items() if Developer in option.marks} == {*DEVELOPER}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_is_explained(command, capsys):
    text, _ = help_of(capsys, command, "--help", "all")
    assert "TOML file of settings" in " ".join(text.split())
    for option in re.split(r"\n  (?=-)", text)[1:]:
        assert re.search("[a-z]{2}", re.sub(r"^.*?(?=  |\n)|\(default.*", "", option, flags=re.DOTALL)), option
