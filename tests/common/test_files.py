"""Files are written completely or not at all, and no temporary file remains; TOML and its errors."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from nerif.common import files
from nerif.common.files import atomic, check_known, local_path, read_toml, write_toml
from refusals import refused


def names(folder):
    return [p.name for p in folder.iterdir()]


def test_a_file_takes_its_name_at_the_end_and_keeps_its_suffix(tmp_path):
    path = tmp_path / "a.nc"
    path.write_text("old")
    with atomic(path) as part:
        assert part.suffix == ".nc"
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    with pytest.raises(RuntimeError), atomic(path) as part:  # noqa: PT012
        part.write_text("half")
        raise RuntimeError
    assert path.read_text() == "new"
    assert names(tmp_path) == ["a.nc"]


def test_a_directory_is_replaced_by_a_directory_only(tmp_path):
    path = tmp_path / "s.zarr"
    path.mkdir()
    (path / "old").write_text("1")
    with atomic(path) as part:
        assert not part.exists()
        part.mkdir()
        (part / "new").write_text("1")
    assert names(path) == ["new"]
    with pytest.raises(OSError), atomic(path) as part:
        part.write_text("a file")
    assert names(path) == ["new"]
    assert names(tmp_path) == ["s.zarr"]


def test_two_writers_of_one_file_keep_apart(tmp_path):
    path = tmp_path / "a.nc"
    with atomic(path) as first:
        first.write_text("first")
        with atomic(path) as second:
            second.write_text("second")
        assert path.read_text() == "second"
    assert path.read_text() == "first"
    assert names(tmp_path) == ["a.nc"]


@pytest.mark.parametrize("remains", [False, True])
def test_the_rest_of_a_killed_process_is_removed(tmp_path, remains):
    pid = os.getpid() if remains else 99_999_999
    with atomic(tmp_path / "b.zarr") as part:
        part.mkdir()
        rest = tmp_path / part.name.replace(f"-{os.getpid()}-", f"-{pid}-").replace("b.", "s.")
    rest.mkdir()
    (rest / "old").touch()
    foreign = tmp_path / ".s.00000000-99999999-0.part.zarr"  # of another machine
    foreign.mkdir()
    files._remove_rests.cache_clear()  # as in another process
    with atomic(tmp_path / "a.nc") as part:
        part.touch()
    assert (rest.exists(), foreign.exists()) == (remains, True)


def test_the_error_of_a_full_disk_names_the_file(tmp_path):
    with pytest.raises(OSError) as error, atomic(tmp_path / "a.nc") as part:
        raise OSError(errno.ENOSPC, "cannot write to a part\nat 12:00", str(part))
    assert error.value.filename == str(tmp_path / "a.nc")
    assert error.value.strerror == os.strerror(errno.ENOSPC)


def test_toml_is_read_as_written_below_a_comment(tmp_path):
    table = {"a": 1.5, "b": {"c": ["x", "y"]}}
    write_toml(tmp_path / "t.toml", table, "# about\n")
    assert (tmp_path / "t.toml").read_text().startswith("# about\na = 1.5\n")
    assert read_toml(tmp_path / "t.toml") == table
    check_known({"width": 1}, ("width", "height"), "x.toml")
    with refused("x.toml"):
        check_known({"widht": 1}, ("width", "height"), "x.toml", more="; see there")


@pytest.mark.parametrize("content", [b"[a", b"\xff", "folder", "none"])
def test_invalid_toml(content, tmp_path):
    path = tmp_path / "t.toml"
    if content == "folder":
        path.mkdir()
    elif content != "none":
        path.write_bytes(content)
    with refused(path):
        read_toml(path, "file; expected a calibration")


@pytest.mark.parametrize("path", [r"C:\data\new", r"cam1\reference\*.tif", r"D:\users\x"])
def test_backslashes_in_double_quotes_are_explained(tmp_path, path):
    file = tmp_path / "t.toml"
    file.write_text(f'a = "{path}"\n')
    with refused(file) as error:
        read_toml(file)
    assert "write paths with /, or in single quotes" in str(error.value)
    file.write_text(f"a = '{path}'\n")
    assert read_toml(file) == {"a": path}


@pytest.mark.skipif(os.name == "nt", reason="paths of Windows elsewhere")
def test_paths_of_windows_on_another_system(tmp_path):
    assert local_path(r"cam1\reference\*.tif", tmp_path, "x") == Path("cam1/reference/*.tif")
    (tmp_path / r"odd\name.tif").touch()
    assert local_path(r"odd\name.tif", tmp_path, "x") == Path(r"odd\name.tif")
    tab_and_form_feed = ("C:\tmp\new", "run\flow")
    for path in (r"C:\data\new", "C:/data/new", r"\\server\data", *tab_and_form_feed):
        with refused("x"):
            local_path(path, tmp_path, "x")
