"""The velocity of a reconstructed film: densities improved by the displacements that the film names."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr

from commands import run
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.velocity_sequence import VelocitySequence
from nerif.flow.assimilation import VelocityFit
from nerif.geometry import Grid
from nerif.workflow.film_velocity import velocity_of_film
from nerif.workflow.sequence.chunk import reconstruct_frames
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.store import SequenceStore
from refusals import refused
from sequence_films import COLD

FIT = VelocityFit(physics="transport", resolution=8, max_iterations=3, time_limit=0, samples=1, sample_iterations=2)


@pytest.fixture(scope="module")
def result(five: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three of five frames, one view withheld."""
    out = tmp_path_factory.mktemp("result") / "result.zarr"
    sequence = MeasurementSequence.read(five)
    like = sequence.fullest()
    settings = SequenceSettings(warm_steps=15, voxels=12, quantities=("index_excess",), withhold=like.names[:1])
    plan = SequencePlan(five, out, replace(COLD, open_faces=("z+",)), settings)
    grid = Grid.of_resolution(like.box, 12)
    SequenceStore.begin(out, sequence, grid, settings.quantities, COLD.network, plan.attributes)
    reconstruct_frames(plan, 0, 5, lambda event: None)
    return out


@pytest.mark.slow
def test_the_velocity_improves_the_densities_if_the_measurement_is_there(result: Path, five: Path, tmp_path: Path):
    copy = Path(shutil.copytree(result, tmp_path / "copy.zarr"))
    zarr.open_group(copy, mode="r+").attrs["measurement"] = str(tmp_path / "gone.zarr")
    lines: list[str] = []
    film = velocity_of_film(copy, tmp_path / "film.zarr", FIT, frames=(0, 4), say=lines.append)
    assert film.attributes["density"] == "film"
    assert any("not improved" in line and "gone.zarr" in line for line in lines)
    with refused(tmp_path / "gone.zarr"):
        velocity_of_film(copy, tmp_path / "w.zarr", FIT, density="improved")
    stages: set[str] = set()
    store = velocity_of_film(
        copy, tmp_path / "v.zarr", FIT, frames=(0, 4), measurement=five, on_iterate=lambda i: stages.add(i.what)
    )
    assert stages == {"velocity", "density", "deviations"}
    assert store.attributes["density"] == "improved"
    improved, before = store.read("density", 1), film.read("density", 1)
    change = np.abs(improved - before).max()
    assert 0 < change < 0.5 * np.abs(before - before.max()).max()
    assert not {"pressure", "pressure_std"} & {*store.group}


def test_one_command_makes_film_and_velocity(result: Path, five: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    name = "nerif.workflow.sequence.reconstruct_sequence.reconstruct_sequence"
    monkeypatch.setattr(name, lambda out, *_, **__: SequenceStore(out))
    monkeypatch.setattr("nerif.report.velocity_page.image", lambda *_: "")
    settings = {"physics": "transport", "resolution": 8, "max-iterations": 2, "samples": 0}
    options = [word for name, value in settings.items() for word in (f"--flow.{name}", value)]
    assert run("sequence", five, "-o", result, "--velocity", tmp_path / "v.zarr", *options) == 0
    assert VelocitySequence(tmp_path / "v.zarr").attributes["physics"] == "transport"
    assert (tmp_path / "v.html").is_file()
    assert run("sequence", five, "-o", result, "--velocity", tmp_path / "v.zarr") == 2
    assert run("sequence", five, "-o", result, "--velocity", result, "--force") == 2
    assert run("sequence", five, "-o", result, "--velocity", tmp_path / "w.zarr", "--quantities", "density") == 2
