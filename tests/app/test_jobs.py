"""The queue: on disk, found again by another server, runs that outlive it, stopped, paused and gone on with."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from nerif.app.project import runner
from nerif.app.project.jobs import CommandRun, Jobs
from nerif.app.views.result_volumes import film_progress
from nerif.cli.cli import main
from nerif.common.files import write_json
from nerif.common.locks import locked
from refusals import refused

HELP = ("--version",)


def until(jobs: Jobs, id: str, *states: str, seconds: float = 60.0) -> CommandRun:
    """Let the queue go on until a run is in one of the states."""
    end = time.monotonic() + seconds
    while (job := jobs.get(id)).state not in states:
        assert time.monotonic() < end, f"{job.state}: {jobs.log(id)}"
        jobs.advance()
        time.sleep(0.05)
    return job


def test_runs_are_done_one_at_a_time_and_their_words_are_kept(tmp_path):
    jobs = Jobs(tmp_path)
    first, second = jobs.add(HELP, "one"), jobs.add(("nonsense",), "two")
    jobs.advance()
    assert [job.state for job in jobs.all()] == ["running", "queued"]
    assert until(jobs, first.id, "done").code == 0
    assert jobs.log(first.id)[0].startswith("nerif ")
    assert until(jobs, second.id, "failed").code == 2
    assert "unknown command" in jobs.log(second.id)[-1]
    assert [job.title for job in jobs.all()] == ["two", "one"]
    jobs.remove(first.id)
    with refused("job"):
        jobs.get(first.id)
    with refused("at_once"):
        jobs.at_once = 0


def test_waiting_runs_change_places(tmp_path):
    jobs = Jobs(tmp_path)
    ids = [jobs.add(HELP, str(i)).id for i in range(3)]
    for moved, by, order in (
        (2, -1, "021"), (0, 1, "201"), (2, -1, "201"), (1, 1, "201"), (1, -9, "120"), (1, 9, "201")
    ):  # fmt: skip
        jobs.move(ids[moved], by)
        assert "".join(job.title for job in jobs.all()) == order
    jobs.stop(ids[0])
    assert [(job.title, job.state) for job in jobs.all()] == [("2", "queued"), ("1", "queued"), ("0", "stopped")]


def sleeping(jobs: Jobs, process: subprocess.Popen[bytes], **more: object) -> str:
    """A run whose process is one that only sleeps."""
    job = jobs.add(("reconstruct", "m.nc", "--out", "r", "--live"), "run", "r")
    where = jobs.directory / job.id
    began = runner.began(process.pid)
    write_json(where / "started.json", {"pid": process.pid, "began": began, "time": time.time(), **more})
    return job.id


@pytest.fixture
def process():
    code = "import signal, time; signal.signal(2, signal.default_int_handler); print('up', flush=True); time.sleep(60)"
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert child.stdout is not None
    child.stdout.readline()
    yield child
    child.kill()
    child.communicate()


def test_another_server_finds_what_runs_and_may_end_it(tmp_path, process):
    id = sleeping(Jobs(tmp_path), process)
    other = Jobs(tmp_path)
    assert (other.get(id).state, other.get(id).pid) == ("running", process.pid)
    reused = sleeping(other, process, began="1.0")  # the number of a process that was given again
    assert other.get(reused).state == "failed"
    with refused(f"job {id}"):
        other.remove(id)
    other.stop(id)
    process.wait(10)
    assert other.get(id).state == "stopped"


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the system keeps the time of day at the start")
def test_a_clock_that_is_set_starts_nothing_twice(tmp_path, process, monkeypatch):
    jobs = Jobs(tmp_path)
    id = sleeping(jobs, process)
    boot = psutil.boot_time()
    monkeypatch.setattr("psutil._pslinux.boot_time", lambda: boot + 3600)  # as by a clock that is an hour ahead
    assert jobs.get(id).state == "running"
    jobs.at_once = 3
    jobs.advance()
    assert not (jobs.directory / id / "log.txt").exists()


def test_what_is_paused_goes_on_from_its_checkpoint(tmp_path, process):
    jobs = Jobs(tmp_path)
    id = sleeping(jobs, process)
    jobs.pause(id)
    process.wait(10)
    where = jobs.directory / id
    write_json(where / "ended.json", {"code": 0, "time": time.time()})
    assert jobs.get(id).state == "paused"
    jobs.resume(id)
    assert jobs.get(id).attempt == ("reconstruct", "m.nc", "--out", "r", "--live")  # nothing was written yet
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "run.toml").write_text("")
    write_json(where / "started.json", {"pid": 1, "began": 0.0, "time": 1.0})
    jobs.resume(id)
    job = jobs.get(id)
    assert (job.state, job.line) == ("queued", "nerif reconstruct --resume --out r --live")
    other = jobs.add(HELP, "x")
    with refused(f"job {other.id}"):
        jobs.pause(other.id)


def test_a_stop_while_a_run_starts_is_obeyed(tmp_path):
    jobs = Jobs(tmp_path)
    job = jobs.add(["demo", "--out", "demo"], "a demo", "demo")
    where = jobs.directory / job.id
    jobs.stop(job.id)
    runner.main(where, job.attempt)
    assert jobs.get(job.id).state == "stopped"
    assert not (tmp_path / "demo").exists()


def test_a_run_outlives_the_server(tmp_path):
    code = "import sys; from nerif.app.project.jobs import Jobs; from pathlib import Path; "
    code += "jobs = Jobs(Path(sys.argv[1])); print(jobs.add(('--version',), 'x').id); jobs.advance()"
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert until(Jobs(tmp_path), done.stdout.strip(), "done").code == 0


def test_a_run_of_an_earlier_server_or_another_person_waits_until_it_is_started(tmp_path):
    id = Jobs(tmp_path).add(("reconstruct", "nowhere.nc", "--out", "r"), "x", "r").id
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "run.toml").write_text("")  # of another run
    jobs, other = Jobs(tmp_path), Jobs(tmp_path)
    jobs.advance()
    assert [jobs.get(id).state, jobs.log(id)] == ["held", []]
    jobs.start(id)
    assert (jobs.get(id).state, other.get(id).state) == ("queued", "held")
    assert until(jobs, id, "failed").code == 2
    assert "nowhere.nc" in jobs.log(id)[-1]
    other.start(id)
    assert other.get(id).state == "failed"


def test_two_processes_of_one_run_start_it_once(tmp_path):
    jobs = Jobs(tmp_path)
    job = jobs.add(HELP, "x")
    where = jobs.directory / job.id
    with locked(where, inside=True), refused(where):
        runner.main(where, HELP)
    for _ in range(2):
        runner.main(where, HELP)
    assert len(jobs.log(job.id)) == 1


def test_a_process_that_cannot_start_a_run_says_why(tmp_path, monkeypatch):
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\necho it is broken >&2\nexit 3\n")
    broken.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(broken))
    jobs = Jobs(tmp_path)
    id = jobs.add(HELP, "x").id
    assert until(jobs, id, "failed").code == 3
    assert jobs.log(id) == ["it is broken"]


@pytest.mark.parametrize("text", ["{", "[" * 100_000, "[1]", '{"id": 1}', "title", "arguments", "words"])
def test_damaged_files_are_no_runs(tmp_path, text):
    jobs = Jobs(tmp_path)
    words = ["info", "a b; rm -rf $HOME.nc"]
    assert jobs.get(jobs.add(words, "").id).line == "nerif info 'a b; rm -rf $HOME.nc'"
    jobs.remove(jobs.all()[0].id)
    entries = dict.fromkeys(("title", "out", "request"), "") | {"id": "bad", "place": 0}
    entries |= {"arguments": words, "attempt": words}
    wrong = {"title": {"title": "\ud800"}, "arguments": {"arguments": []}, "words": {"attempt": [1]}}
    bad: Path = jobs.directory / "bad"
    bad.mkdir(parents=True)
    (bad / "job.json").write_text(json.dumps({**entries, **wrong[text]}) if text in wrong else text)
    assert jobs.all() == []
    assert os.listdir(bad) == ["job.json"]


@pytest.mark.slow
def test_a_film_is_paused_and_does_only_what_is_missing(tmp_path):
    small = ["--image-size", "12", "16", "--pixel-pitch", "0.3", "--views", "4", "--truth-voxels", "8"]
    assert main(["simulate", "-o", str(tmp_path / "f.zarr"), *small, "--times", "0:3e-3:4"]) == 0
    jobs, out = Jobs(tmp_path), tmp_path / "r.zarr"
    steps = ["--max-steps", "60", "--warm-steps", "20", "--chunk", "1", "--voxels", "8", "--force"]
    words = ["sequence", "f.zarr", "--out", "r.zarr", "--workers", "1", "--threads", "1", *steps]
    id = jobs.add(words, "film", "r.zarr").id
    until(jobs, id, "running")
    end = time.monotonic() + 120
    while film_progress(out)[0] == 0:
        assert time.monotonic() < end, jobs.log(id)
        assert jobs.get(id).state in ("running", "queued"), jobs.log(id)
        time.sleep(0.05)
    jobs.pause(id)
    job = until(jobs, id, "paused", "done", seconds=120)
    before = film_progress(out)
    jobs.resume(id)
    if job.state == "paused":
        assert "--force" not in jobs.get(id).attempt
    until(jobs, id, "done", seconds=120)
    assert before[0] > 0
    assert film_progress(out) == (1.0, "4 of 4 frames")
