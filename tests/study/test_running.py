"""Running a study: each case in its own process, nothing done twice, what fails is recorded and the rest goes on."""

from __future__ import annotations

import json
import os
import signal
import sys
from dataclasses import replace

import pytest

from nerif.cli import main
from nerif.conventions import InputError
from nerif.fields.mlp import NetworkShape
from nerif.geometry import Ring
from nerif.reconstruction.neural import NeRIF
from nerif.reconstruction.tikhonov import Tikhonov
from nerif.study.cases import FULL, METHODS, NOISES, PHANTOMS, QUICK, SECTIONS, Case, cases
from nerif.study.running import PRELOADED, read_record, run_case, run_cases

RING = Ring(views=4, image_size=(16, 16), pixel_pitch=0.25)
SMALL = NeRIF(
    network=NetworkShape(depth=2, width=24, octaves=2), samples=(12, 16), sample_jitter=2, points_per_batch=600,
    max_steps=200, epochs=1000, device="cpu", precision="float32",
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


def test_a_record_tells_how_it_went_and_is_not_made_again(tmp_path):
    case = small("nerif", SMALL, method="NeRIF", snapshots=True)
    (record,) = run([case], tmp_path)
    assert record["method"] == "NeRIF"
    assert record["steps"] == 200
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


def test_what_fails_is_recorded_and_the_rest_goes_on(tmp_path):
    todo = [small("wrong", phantom="nonsense"), small("killed", Killed(voxels=8)), small("good")]
    wrong, killed, good = run(todo, tmp_path)
    assert "nonsense" in wrong["failed"]
    assert "killed" in killed["failed"]
    assert good["metrics"]["cc"] > 0.5
    assert "failed" in json.loads((tmp_path / "cases" / "killed.json").read_text())
    again = run([small("killed")], tmp_path)  # failed ones are tried again
    assert "failed" not in again[0]


def test_the_octahedron_tells_its_resolution_and_the_forward_models_their_distance(tmp_path):
    (tmp_path / "data").mkdir()
    record = run_case(small("o", phantom="octahedron", noise=0.0), tmp_path)
    assert record["pixels_per_unit"] == pytest.approx(12.5 / 0.25 * 50 / 700, rel=0.05)
    assert "lp_per_unit" in record["resolution"]
    model = replace(small("2-0-nerif", noise=0.0), labels={"model": "lever_arm"})
    forward = run_case(model, tmp_path)["forward"]
    assert forward["curved"]["relative"] < forward["lever_arm"]["relative"] < forward["paraxial"]["relative"] < 0.05


def test_the_command(tmp_path, capsys):
    out = tmp_path / "study"
    words = ["study", "-o", str(out), "--quick", "--pixels", "12", "--time-limit", "0.2", "--device", "cpu"]
    assert main([*words, "--only", "sampling"]) == 0
    assert "3 of 3 reconstructions" in capsys.readouterr().out
    page = (out / "study.md").read_text()
    assert "Random against regular sampling" in page
    assert (out / "study.html").read_text().startswith("<!DOCTYPE html>")
    assert main([*words, "--only", "sampling", "--page-only"]) == 0

    assert main([*words, "--only", "tabels"]) == 2
    assert "only: expected sections" in capsys.readouterr().err
    assert main(["study", "-o", str(out), "--pixels", "3"]) == 2
    assert main(["study", "-o", str(out), "--device", "cuda:9"]) == 2
    assert main(["study", "-o", str(out), "--preset", "nonsense"]) == 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked on POSIX only")
def test_what_every_case_needs_is_imported_before_its_process_begins(tmp_path):
    (record,) = run([small("looking", Looking())], tmp_path)
    assert "not there: []" in record["failed"]
