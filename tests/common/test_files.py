"""Files appear whole or not at all, and nothing is left behind."""

from __future__ import annotations

import pytest

from nerif.common.files import atomic


def test_a_file_takes_its_name_at_the_end_and_keeps_its_ending(tmp_path):
    path = tmp_path / "a.nc"
    path.write_text("old")
    with atomic(path) as part:
        assert part.suffix == ".nc"
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.nc"]


def test_an_error_leaves_what_was_there_and_no_part(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("old")

    def fails() -> None:
        with atomic(path) as part:
            part.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fails()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.toml"]


def test_a_directory_replaces_a_directory_but_a_file_does_not_and_what_a_killed_run_left_is_gone(tmp_path):
    path = tmp_path / "s.zarr"
    path.mkdir()
    (path / "old").write_text("1")
    left = tmp_path / ".s.part.zarr"
    left.mkdir()
    (left / "half").write_text("1")
    with atomic(path) as part:
        assert not part.exists()
        part.mkdir()
        (part / "new").write_text("1")
    assert [p.name for p in path.iterdir()] == ["new"]
    with pytest.raises(OSError), atomic(path) as part:
        part.write_text("a file")
    assert [p.name for p in path.iterdir()] == ["new"]
    assert [p.name for p in tmp_path.iterdir()] == ["s.zarr"]
