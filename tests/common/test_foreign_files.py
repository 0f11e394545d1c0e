"""Files of any format that nest too deep, and pipes instead of files: one line, and nothing that hangs."""

from __future__ import annotations

import dataclasses
import os

import pytest
import torch

from bodies import cuboid
from nerif.app.project.folder import Contents, ProjectFolder
from nerif.cli.arguments import INPUTS, check_arguments
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.common.files import read_json, read_toml, read_yaml, write_toml
from nerif.common.image_names import SUFFIXES
from nerif.data.body_file import read_body
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.data.vti import write_vti
from nerif.geometry import Box, Grid, Ring
from nerif.imaging.calibration.importers.importers import import_cameras
from nerif.imaging.readers.open import open_frames
from nerif.imaging.readers.views import find_views
from nerif.reconstruction.field_files import read_tensors
from nerif.results.metrics_file import Metrics

DEEP = 200_000
NESTED = {
    "json": ("[" * DEEP, read_json), "toml": (f"a = {'[' * DEEP}", read_toml), "yaml": ("[" * 1000, read_yaml),
    "cihx": (f"<cih>{'<a>' * DEEP}{'</a>' * DEEP}</cih>", open_frames),
    "vti": (f"<VTKFile>{'<a>' * DEEP}{'</a>' * DEEP}</VTKFile>", read_volume),
    "metrics.json": ('{"version": 1, "views": ' + "[" * 900 + "]" * 900 + "}", Metrics.read),
    "transforms.json": ("[" * DEEP, import_cameras), "camera.yaml": ("[" * 1000, import_cameras),
    "camera.xml": (f"<?xml version='1.0'?>{'<a>' * DEEP}", import_cameras),
}  # fmt: skip


@pytest.mark.parametrize("name", NESTED)
def test_deep_nesting_is_refused(tmp_path, name):
    text, reader = NESTED[name]
    path = tmp_path / (name if "." in name else f"a.{name}")
    path.write_text(text, encoding="utf-8")
    path.with_suffix(".mraw").touch()
    with pytest.raises(InputError):
        reader(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
@pytest.mark.parametrize(
    ("name", "reader"),
    [
        ("a.toml", read_toml), ("a.json", read_json), ("a.yaml", read_yaml), ("a.yml", import_cameras),
        ("a.toml", import_cameras), ("a.csv", import_cameras), ("a.mat", import_cameras), ("a.npz", import_cameras),
        ("a.nc", Measurement.read), ("a.vti", read_volume), ("metrics.json", Metrics.read), ("a.stl", read_body),
        ("field.safetensors", read_tensors), ("a.tif", lambda path: open_frames(path.parent)),
        *[(f"a{suffix}", open_frames) for suffix in SUFFIXES],
    ],
)  # fmt: skip
def test_pipes_are_refused(tmp_path, name, reader):
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError) as error:
        reader(tmp_path / name)
    assert "no such file;" not in str(error.value)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
@pytest.mark.parametrize("command", sorted(INPUTS))
def test_every_command_says_that_its_input_is_a_pipe(tmp_path, command):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="a pipe, socket or device; write its content to a file first") as error:
        check_arguments(command, [str(pipe)])
    assert error.value.field == str(pipe)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
def test_a_project_ignores_pipes(tmp_path):
    for name in ("a.toml", "a.nc", "a.vti"):
        os.mkfifo(tmp_path / name)
    assert ProjectFolder(tmp_path).contents() == Contents()


SEQUENCES = {"escape": "cam\x1b[31m1", "C1": "cam\x9b31m", "line": "cam\n1", "bidi": "cam\u202e1", "NUL": "a\0b"}


@pytest.mark.parametrize("name", SEQUENCES.values(), ids=SEQUENCES)
def test_names_have_no_control_characters(tmp_path, name):
    camera = Ring(views=1, image_size=(6, 8)).cameras()[0]
    one = CalibratedCamera.from_camera(camera)
    write_cameras(tmp_path / "c.toml", [dataclasses.replace(one, name=name)])
    write_toml(tmp_path / "views.toml", {"views": {name: {"flow": "a.tif"}}})
    for make in (
        lambda: dataclasses.replace(camera, name=name), lambda: import_cameras(tmp_path / "c.toml"),
        lambda: find_views(tmp_path), lambda: dataclasses.replace(cuboid(), name=name),
    ):  # fmt: skip
        with pytest.raises(InputError, match="without control characters") as error:
            make()
        assert str(error.value).isascii()
        assert str(error.value).isprintable()


def test_other_texts_reach_the_terminal_as_escapes(tmp_path, capsys):
    write_vti(tmp_path / "a.vti", {"\x9bq": torch.zeros(6, 5, 4)}, Grid(Box((0, 0, 0), (4, 5, 6)), (6, 5, 4)), {})
    assert main(["info", str(tmp_path / "a.vti")]) == 0
    assert main(["info", str(tmp_path / "\x1b[31mb.vti")]) == 2
    output = capsys.readouterr()
    assert r"\x9bq" in output.out
    assert r"\x1b[31mb.vti" in output.err
    assert not {"\x9b", "\x1b"} & {*output.out, *output.err}
