"""TOML files there and back, and the words for those that are none."""

from __future__ import annotations

import pytest

from nerif.common.conventions import InputError
from nerif.common.files import check_known, read_toml, write_toml
from refusals import refused


def test_there_and_back_below_a_comment(tmp_path):
    table = {"a": 1.5, "b": {"c": ["x", "y"]}}
    write_toml(tmp_path / "t.toml", table, "# about\n")
    assert (tmp_path / "t.toml").read_text().startswith("# about\na = 1.5\n")
    assert read_toml(tmp_path / "t.toml") == table


@pytest.mark.parametrize("content", [b"[a", b"\xff", None], ids=["half", "bytes", "folder"])
def test_what_is_no_toml_is_refused_by_name(content, tmp_path):
    path = tmp_path / "t.toml"
    path.mkdir() if content is None else path.write_bytes(content)
    with pytest.raises(InputError, match=r"t\.toml: not a TOML file"):
        read_toml(path)
    with pytest.raises(InputError, match=r"none\.toml: no such file; expected a calibration"):
        read_toml(tmp_path / "none.toml", "file; expected a calibration")


def test_a_mistyped_key_is_told_with_the_nearest_known_one():
    check_known({"width": 1}, ("width", "height"), "x.toml")
    with refused("x.toml"):
        check_known({"widht": 1}, ("width", "height"), "x.toml", more="; see there")
