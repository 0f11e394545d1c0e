"""Arguments that are refused before anything heavy is imported."""

from __future__ import annotations

import json

import pytest

from nerif.cli.arguments import OPTIONS, check_arguments, table
from nerif.cli.cli import main
from tests.test_imports import HEAVY, loaded_by


def test_the_table_has_the_options_of_all_commands():
    """If settings have changed: python -m nerif.cli.arguments."""
    assert json.loads(OPTIONS.read_text()) == json.loads(json.dumps(table()))


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("reconstruct m.nc -o r --epoch 3", "--epoch: unknown option; did you mean --epochs"),
        ("reconstruct m.nc -o r --method tv --network.width 3", "--network.width: unknown option"),
        ("reconstruct m.nc -o r --norm=l3", "--norm: expected one of l2, squared, got 'l3'"),
        ("reconstruct m.nc -o r --set epochs=abc", "--epochs: expected a number, got 'abc'"),
        ("reconstruct m.nc -o r --max_steps 2.5", "--max-steps: expected a whole number, got '2.5'"),
        ("reconstruct m.nc --epochs 3", "--out: expected PATH, got none"),
        ("export m.nc -o taken.vti", "taken.vti: exists already"),
        ("export absent -o x.vti", "absent: no such directory"),
        ("app absent", "absent: no such folder"),
        ("calibrate absent", "absent: no such file or folder"),
        ("figures m.nc --columns", "--columns: unknown option"),
    ],
)
def test_wrong_arguments(words, error, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("m.nc", "taken.vti"):
        (tmp_path / name).touch()
    command, *arguments = words.split()
    with pytest.raises(InputError, match=error):
        check_arguments(command, arguments)


@pytest.mark.parametrize(
    "words",
    [
        "reconstruct m.nc -o r --lower -1e-3 --axis-point 0 -3 2 --no-hull --from images --method tv",
        "reconstruct m.nc --out=r --preset best --epochs inf --gas.composition None",
        "reconstruct -o r --resume --whatever the file says",
        "pattern --kind chessboard -o x.pdf --columns 7",
        "export m.nc -o taken.vti --force",
        "export absent --help",
        "app absent --demo",
        "design",
    ],
)
def test_right_arguments(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("m.nc", "taken.vti"):
        (tmp_path / name).touch()
    command, *arguments = words.split()
    check_arguments(command, arguments)


def test_nothing_heavy_is_loaded(tmp_path):
    (tmp_path / "m.nc").touch()
    words = ["reconstruct", str(tmp_path / "m.nc"), "-o", "r", "--epoch", "3"]
    loaded = loaded_by(f"from nerif.cli.cli import main; assert main({words}) == 2; print()")
    assert not loaded & {"torch", "numpy", "tyro", *HEAVY}


def test_the_exit_code(tmp_path, capsys):
    assert main(["info", str(tmp_path / "absent.nc")]) == 2
    assert "no such file" in capsys.readouterr().err
