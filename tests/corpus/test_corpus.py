"""Files of earlier versions (NAME.tar.gz, written by write.py) are read, and hold what they held."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import pytest
import torch

import nerif
from nerif.analysis.consistency_file import read_findings
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume_sequence import VolumeSequence
from nerif.reconstruction import field_files as files
from refusals import refused

ARCHIVES = sorted(Path(__file__).parent.glob("*.tar.gz"))


@pytest.fixture(scope="module", params=ARCHIVES, ids=lambda path: path.name)
def folder(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("corpus")
    with tarfile.open(request.param) as archive:
        archive.extractall(path, filter="data")
    return path


@pytest.fixture(scope="module")
def expected(folder):
    return json.loads((folder / "expected.json").read_text())


def test_measurements(folder, expected):
    for version, rms in expected["rms"].items():
        measurement = nerif.read(folder / f"measurement-{version}.nc")
        assert float(measurement.displacements.nan_to_num().square().mean().sqrt()) == pytest.approx(rms)
        assert (measurement.cameras[0].lens is not None) == (version == "1.1")


def test_calibration_and_volume(folder):
    cameras = nerif.read(folder / "calibration.toml")
    assert [c.name for c in cameras] == list(nerif.read(folder / "measurement-1.0.nc").names)
    assert nerif.read(folder / "volume.vti").grid.shape == (4, 5, 6)


def test_results(folder, expected):
    for name, values in expected["fields"].items():
        result = nerif.read(folder / name)
        assert not [gap for gap in result.missing if gap.name != "measurement"], name
        assert len(result.metrics.views) == 4
        field = nerif.ResultDirectory(folder / name).field()[0]
        torch.testing.assert_close(field(expected["points"]), torch.tensor(values), rtol=1e-4, atol=1e-9)


def test_films(folder):
    pytest.importorskip("zarr")
    film, truth, result = (nerif.read(folder / f"film{name}.zarr") for name in ("", ".truth", "_result"))
    assert isinstance(film, MeasurementSequence)
    assert (len(film), film.frame(1).shape) == (2, (4, 12, 14))
    for volumes in (truth, result):
        assert isinstance(volumes, VolumeSequence)
        assert bool(volumes.volume(1, "index_excess").values.isfinite().all())


def test_the_project_of_the_app(folder, expected, tmp_path, monkeypatch):
    """Its runs are listed, but not started: they were queued by another user elsewhere."""
    if "project" not in expected:
        pytest.skip("written before the app had one")
    pytest.importorskip("nicegui")
    from nerif.app.project.folder import OWN, ProjectFolder
    from nerif.app.project.workspace import Workspace

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    workspace = Workspace(ProjectFolder(folder / "project"))
    assert workspace.draft("design") == expected["project"]["design"]
    assert workspace.jobs.at_once == expected["project"]["at_once"]
    (job,) = workspace.jobs.all()
    assert (job.state, list(job.arguments)) == ("held", expected["project"]["run"])
    findings = read_findings(folder / "project" / OWN / "checks" / "m.json")
    assert [view.name for view in findings.views] == list(nerif.read(folder / "measurement-1.0.nc").names)


def test_a_field_of_a_later_version_is_refused(folder, monkeypatch):
    monkeypatch.setattr(files, "VERSION", 0)
    with refused(folder / "voxels" / "field.safetensors"):
        nerif.ResultDirectory(folder / "voxels").field()
