"""Running a study: each case in its own process, nothing done twice, what fails is recorded and the rest goes on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from dataclasses import field as dataclass_field
from datetime import date
from pathlib import Path

import pytest
import torch

import study
from benchmarks.study_records import record
from nerif import __version__
from nerif.common.conventions import InputError
from nerif.fields.base import Field
from nerif.fields.network import NetworkShape
from nerif.geometry import Box, Ring
from nerif.reconstruction.base import Outcome, Reconstruction
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from study.cases import FULL, METHODS, NOISES, PHANTOMS, QUICK, SECTIONS, Case, cases
from study.command import main, parser
from study.records import of_other_versions, read_record, write_record
from study.running import PRELOADED, run_case, run_cases

RING = Ring(views=4, image_size=(16, 16), pixel_pitch=0.25)
SMALL = NeRIF(
    network=NetworkShape(depth=2, width=24, octaves=2), samples=(12, 16), sample_jitter=2, points_per_batch=600,
    max_steps=200, device="cpu", precision="float32",
)  # fmt: skip
TIKHONOV = Tikhonov(voxels=8, basis="linear", iterations=3, device="cpu")


class Killed(Tikhonov):
    """Stands for a reconstruction that the system kills."""

    def __call__(self, *arguments, **more):
        os.kill(os.getpid(), signal.SIGKILL)


class Looking(Tikhonov):
    """Tells which modules its process had to import itself, had it needed them."""

    def __call__(self, *arguments, **more):
        raise ValueError(f"not there: {sorted(set(PRELOADED) - set(sys.modules))}")


def small(key: str, reconstructor=TIKHONOV, **more) -> Case:
    values = {"phantom": "1", "noise": 0.1, "method": "Tikhonov", "ring": RING, "truth_voxels": 12, **more}
    return Case(key=key, labels={"tables": key}, reconstructor=reconstructor, **values)


def run(todo, folder):
    return list(run_cases(todo, folder, lambda done, what, share: None))


def test_the_study_holds_all_that_the_paper_shows():
    for scale in (FULL, QUICK):
        todo = cases(scale)
        assert len({c.key for c in todo}) == len(todo)
        shown = {section for c in todo for section in c.labels}
        assert shown == set(SECTIONS)
        tables = {(c.phantom, c.noise, c.method) for c in todo if "tables" in c.labels}
        assert tables == {(p, n, m) for p in PHANTOMS for n in NOISES for m in METHODS}
        labels = {s: {c.labels[s] for c in todo if s in c.labels} for s in SECTIONS}
        assert labels["model"] == {"lever_arm", "paraxial", "curved"}
        assert {"random", "regular"} < labels["sampling"]
        assert len(labels["differentiation"]) == 2
        assert len(labels["network"]) == 3
        assert "no encoding" in labels["encoding"]
        assert {"3", "9", "18"} <= labels["views"]
    assert {c.ring.image_size for c in cases(FULL)} == {(200, 200)}
    assert len(cases(QUICK, ("views",))) == len(QUICK.views)
    with pytest.raises(InputError, match="only: expected sections"):
        cases(QUICK, ("tabels",))


@pytest.mark.slow
def test_a_record_tells_how_it_went_and_is_not_made_again(tmp_path):
    case = small("nerif", SMALL, method="NeRIF", snapshots=True)
    (record,) = run([case], tmp_path)
    assert record["method"] == "NeRIF"
    assert record["steps"] == 200
    assert record["made"]["nerif"] == __version__
    assert record["outcome"] == "steps"
    assert record["peak_memory_bytes"] > 1e7
    assert len(record["metrics"]["slices"]) == 10
    curve = record["curve"]
    assert [p["step"] for p in curve] == sorted(p["step"] for p in curve)
    assert curve[-1]["step"] == 200
    assert curve[-1]["l2"] == pytest.approx(record["metrics"]["l2"])
    assert curve[-1]["l2"] < 0.9 * curve[0]["l2"]
    assert curve[0]["seconds"] < curve[-1]["seconds"] <= record["seconds"]

    path = tmp_path / "cases" / "nerif.json"
    before = path.stat().st_mtime_ns
    assert run([case], tmp_path) == [record]
    assert path.stat().st_mtime_ns == before
    run([replace(case, noise=0.0)], tmp_path)  # asked otherwise
    assert path.stat().st_mtime_ns != before
    assert read_record(tmp_path, case) is None


@pytest.mark.parametrize("field", [f.name for f in fields(Ring)])
def test_another_rig_is_another_measurement(field):
    """Whatever differs of the ring, the simulated measurement on disk is not taken for it."""
    case = small("a")
    changed = {
        "views": 5, "arc": (5.0, 170.0), "extra_angles": (33.0,), "elevation": 3.0, "focal_length": 40.0,
        "pixel_pitch": 0.3, "image_size": (16, 20), "distance": 600.0, "background_distance": 400.0,
        "projection": "telecentric", "magnification": 0.3,
    }  # fmt: skip
    also = {"projection": "telecentric"} if field == "magnification" else {}
    other = replace(case, ring=replace(RING, **also, **{field: changed[field]}))
    assert other.data_key != case.data_key
    assert other.request() != case.request()


def test_what_the_measurement_depends_on_is_asked_for(monkeypatch):
    case = small("a")
    key, request = case.data_key, case.request()
    assert replace(case, noise=0.0).data_key == key  # noise is added to what is on disk
    for name, other in (("BOX", Box.cube(40.0)), ("N_AMBIENT", 1.0003), ("NOISE_SEED", 2)):
        with monkeypatch.context() as patch:
            patch.setattr(f"study.cases.{name}", other)
            assert case.request() != request, name
            assert (case.data_key != key) == (name != "NOISE_SEED"), name
    monkeypatch.setattr("study.cases.__version__", "9.9")
    assert case.data_key != key


def test_a_record_tells_its_origin_and_another_version_does_not_use_it(tmp_path, monkeypatch):
    case = small("a")
    (tmp_path / "cases").mkdir()
    record = write_record(tmp_path, case, {"metrics": {}, "device": "cpu"})
    assert record["made"]["nerif"] == __version__
    assert record["made"]["torch"] == torch.__version__
    assert record["made"]["machine"]
    assert date.fromisoformat(record["made"]["date"])
    assert read_record(tmp_path, case) == record
    assert not of_other_versions(tmp_path, [case])
    monkeypatch.setattr("study.records.__version__", "9.9")
    assert read_record(tmp_path, case) is None
    assert of_other_versions(tmp_path, [case]) == {"a": __version__}


def test_a_record_without_an_origin_is_of_an_unknown_version(tmp_path):
    case = small("a")
    (tmp_path / "cases").mkdir()
    (tmp_path / "cases" / "a.json").write_text(json.dumps({"request": case.request(), "metrics": {}}))
    assert read_record(tmp_path, case) is None
    assert of_other_versions(tmp_path, [case]) == {"a": "unknown"}


@pytest.mark.slow
def test_what_fails_is_recorded_and_the_rest_goes_on(tmp_path):
    todo = [small("wrong", phantom="nonsense"), small("killed", Killed(voxels=8)), small("good")]
    wrong, killed, good = run(todo, tmp_path)
    assert "nonsense" in wrong["failed"]
    assert "killed" in killed["failed"]
    assert good["metrics"]["cc"] > 0.5
    assert "failed" in json.loads((tmp_path / "cases" / "killed.json").read_text())
    again = run([small("killed")], tmp_path)  # failed ones are tried again
    assert "failed" not in again[0]


@pytest.mark.slow
def test_the_octahedron_tells_its_resolution_and_the_forward_models_their_distance(tmp_path):
    (tmp_path / "data").mkdir()
    record = run_case(small("o", phantom="octahedron", noise=0.0), tmp_path)
    assert record["pixels_per_unit"] == pytest.approx(12.5 / 0.25 * 50 / 700, rel=0.05)
    assert "lp_per_unit" in record["resolution"]
    model = replace(small("2-0-nerif", noise=0.0), labels={"model": "lever_arm"})
    forward = run_case(model, tmp_path)["forward"]
    assert forward["curved"]["relative"] < forward["lever_arm"]["relative"] < forward["paraxial"]["relative"] < 0.05


class Elsewhere(Field):
    """The octahedron on a device that is not here: it takes note where it is asked."""

    def __init__(self) -> None:
        self.asked: set[str] = set()

    def value_and_gradient(self, points):
        self.asked.add(points.device.type)
        return torch.zeros(points.shape[:-1]), torch.zeros(points.shape)


@dataclass(frozen=True)
class OnMeta(Tikhonov):
    """A method whose field is on the device "meta"."""

    field: Elsewhere = dataclass_field(default_factory=Elsewhere)
    steps: int = 1

    def __call__(self, measurement, *arguments, **more):
        return Reconstruction(
            self.field, measurement.box, measurement.n_ambient, [{}] * self.steps, Outcome("steps", "too soon"), {},
            device="meta",
        )  # fmt: skip


def test_everything_asks_the_field_where_it_is(tmp_path):
    (tmp_path / "data").mkdir()
    method = OnMeta(voxels=8)
    run_case(small("o", method, phantom="octahedron", noise=0.0), tmp_path)
    assert method.field.asked == {"meta"}


def test_a_run_without_a_step_is_no_result(tmp_path):
    (tmp_path / "data").mkdir()
    with pytest.raises(InputError, match="not a single step was made: too soon"):
        run_case(small("none", OnMeta(voxels=8, steps=0)), tmp_path)


def test_help_tells_the_values_that_are_used():
    text = " ".join(parser().format_help().split())
    assert f"views of {QUICK.pixels} x {QUICK.pixels} px" in text
    assert f"{QUICK.steps} steps, at most {QUICK.seconds:g} s" in text
    assert f"default: {FULL.seconds:g}, with --quick {QUICK.seconds:g}" in text
    assert f"default: {FULL.pixels} as in the paper, with --quick {QUICK.pixels}" in text


def test_the_folder_runs_as_a_program():
    command = [sys.executable, str(Path(study.__file__).parent), "--only", "tabels", "-o", os.devnull]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("study: only: expected sections out of tables")


WORDS = ("--quick", "--pixels", "12", "--device", "cpu", "--only", "sampling")


@pytest.mark.slow
def test_the_command_reconstructs(tmp_path, capsys):
    assert main(["-o", str(tmp_path), *WORDS, "--time-limit", "5"]) == 0
    assert "3 of 3 reconstructions" in capsys.readouterr().out
    assert f"| {__version__} | " in (tmp_path / "study.md").read_text()


@pytest.fixture
def made(monkeypatch):
    """Records are made up instead of computed, but for those whose keys are in the list: "fails" or "interrupted"."""
    special: dict[str, str] = {}

    def run_cases(todo, folder, tell):
        (folder / "cases").mkdir(parents=True, exist_ok=True)
        for i, case in enumerate(todo):
            if special.get(case.key) == "interrupted":
                raise KeyboardInterrupt
            found = {"failed": "no memory"} if special.get(case.key) == "fails" else record(case)
            tell(i + 1, case.key, 0.0)
            yield write_record(folder, case, found)

    monkeypatch.setattr("study.command.run_cases", run_cases)
    return special


def test_the_command_writes_the_page(made, tmp_path, capsys):
    out = tmp_path / "study"
    assert main(["-o", str(out), *WORDS]) == 0
    assert "3 of 3 reconstructions" in capsys.readouterr().out
    page = (out / "study.md").read_text()
    assert "Random against regular sampling" in page
    assert f"| {__version__} | " in page
    assert (out / "study.html").read_text().startswith("<!DOCTYPE html>")
    (out / "study.md").unlink()
    assert main(["-o", str(out), *WORDS, "--page-only"]) == 0
    assert (out / "study.md").read_text() == page


def test_the_command_tells_what_failed_and_what_is_of_another_version(made, tmp_path, capsys, monkeypatch):
    made["sampling-random"] = "fails"
    assert main(["-o", str(tmp_path), *WORDS]) == 1
    said = capsys.readouterr().out
    assert "2 of 3 reconstructions" in said
    assert "failed: sampling-random: no memory" in said
    monkeypatch.setattr("study.records.__version__", "9.9")
    monkeypatch.setattr("study.cases.__version__", "9.9")
    assert main(["-o", str(tmp_path), *WORDS, "--page-only"]) == 0
    assert f"another version of nerif ({__version__})" in (tmp_path / "study.md").read_text()
    made.clear()
    assert main(["-o", str(tmp_path), *WORDS]) == 0
    assert f"made by another version of nerif ({__version__}), and so made again: " in capsys.readouterr().out


def test_an_interrupted_command_leaves_a_page(made, tmp_path, capsys):
    made["sampling-regular"] = "interrupted"
    assert main(["-o", str(tmp_path), *WORDS]) == 130
    assert "the same command goes on from here" in capsys.readouterr().out
    assert "**2 of 3 reconstructions are done; 1 are still to come" in (tmp_path / "study.md").read_text()


def test_bad_input_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "file").touch()
    for words, said in (
        (["--only", "tabels"], "only: expected sections"),
        (["--pixels", "3"], "pixels: expected at least 8, got 3"),
        (["--time-limit", "0"], "time_limit: expected seconds above 0"),
        (["--device", "cuda:9"], "cuda:9"),
        (["--preset", "nonsense"], "nonsense"),
        (["-o", str(tmp_path / "file")], "expected a directory for --out"),
    ):
        assert main(["-o", str(tmp_path / "out"), *words]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked on POSIX only")
def test_what_every_case_needs_is_imported_before_its_process_begins(tmp_path):
    (record,) = run([small("looking", Looking())], tmp_path)
    assert "not there: []" in record["failed"]
