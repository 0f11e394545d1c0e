"""Files of any format that nest too deep, and pipes instead of files: one line, and nothing that hangs."""

from __future__ import annotations

import os

import pytest

from nerif.app.project import Contents, Project
from nerif.common.conventions import InputError
from nerif.common.files import read_json, read_toml, read_yaml
from nerif.common.image_names import SUFFIXES
from nerif.data.body_file import read_body
from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.imaging.calibration.importers.importers import import_cameras
from nerif.imaging.readers.open import open_frames
from nerif.reconstruction.files import read_tensors
from nerif.results.metrics import Metrics

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
    with pytest.raises(InputError):
        reader(tmp_path / name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
def test_a_project_ignores_pipes(tmp_path):
    for name in ("a.toml", "a.nc", "a.vti"):
        os.mkfifo(tmp_path / name)
    assert Project(tmp_path).contents() == Contents()
