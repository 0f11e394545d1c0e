"""Ctrl-C and SIGTERM: what is saved and how to continue; long work reports its progress, also without a terminal."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from nerif.cli import arguments, output
from nerif.cli.cli import COMMANDS, main
from nerif.cli.commands import info, simulate
from nerif.cli.output import MONITOR, counting_bar
from nerif.common.files import atomic, written
from nerif.common.interruption import Interrupted, if_interrupted
from nerif.reconstruction.field_files import CHECKPOINT, FIELD
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.reconstructor import Step
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import ResultDirectory
from nerif.workflow import reconstruction_run, steps
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

QUICK = Tikhonov(voxels=8, basis="linear", iterations=4, regularisation=0.1, device="cpu")


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_the_innermost_message_takes_precedence():
    with pytest.raises(Interrupted, match=r"^inner$"), if_interrupted(lambda: "outer"), if_interrupted(lambda: "inner"):
        raise KeyboardInterrupt
    with pytest.raises(ValueError, match="other"), if_interrupted(lambda: "outer"):
        raise ValueError("other")
    with pytest.raises(OSError) as full, if_interrupted(lambda: "outer"), if_interrupted(lambda: "inner"):
        raise OSError(errno.ENOSPC, "no space", "a.nc")
    assert str(full.value) == f"[Errno {errno.ENOSPC}] {os.strerror(errno.ENOSPC)}; inner: 'a.nc'"


@pytest.mark.parametrize("verb", [verb for verb in COMMANDS if verb != "app"])
def test_every_command_ends_in_one_line(verb, monkeypatch, capsys):
    module = __import__(f"nerif.cli.commands.{verb}", fromlist=["main"])
    monkeypatch.setattr(module, "main", interrupt)
    monkeypatch.setattr(arguments, "check_arguments", lambda *_: None)
    written.clear()
    assert main([verb]) == 130
    assert capsys.readouterr() == ("", "nerif: interrupted; nothing was written; run the same command again\n")


def test_complete_files_are_named(tmp_path, monkeypatch, capsys):
    def half_done(*_: object) -> None:
        for name in "abcdef":
            with atomic(tmp_path / name) as part:
                part.write_text(name)
        with atomic(tmp_path / "lost") as part:
            part.write_text("half")
            raise KeyboardInterrupt

    written.clear()
    monkeypatch.setattr(info, "main", half_done)
    assert main(["info"]) == 130
    message = capsys.readouterr().err
    assert f"{tmp_path / 'f'} and others; run the same command with --force" in message
    assert "lost" not in message


STAGES = {
    "before the first step": "with_halves",
    "sampling": "all_quantities",
    "re-projecting": "reproject",
    "scoring": "evaluate_views",
    "verdict": "verdict",
}


FIRST_STAGES = ("before the first step", "re-projecting")


@pytest.mark.parametrize("stage", [s if s in FIRST_STAGES else pytest.param(s, marks=pytest.mark.slow) for s in STAGES])
def test_a_reconstruction_reports_what_is_saved_and_continues(stage, measurement, tmp_path, monkeypatch):
    name, first = STAGES[stage], stage == "before the first step"
    path, out = tmp_path / "m.nc", tmp_path / "r"
    measurement.write(path)
    run = RunSettings(withhold=("none",), report=False)
    if first:  # an earlier result is not the one of this run
        reconstruct_into(out, measurement, QUICK, run, voxels=8)
    with monkeypatch.context() as patch:
        patch.setattr(reconstruction_run if hasattr(reconstruction_run, name) else steps, name, interrupt)
        words = "nothing was saved yet" if first else "holds the field, but not all other files"
        with pytest.raises(Interrupted, match=words) as stop:
            reconstruct_into(out, path, QUICK, run, voxels=8, force=first)
    if not first:
        assert f"nerif reconstruct --resume --out {out}" in str(stop.value)
        assert main(["reconstruct", "--resume", "--out", str(out)]) == 0
        assert ResultDirectory(out).metrics().verdict


def test_a_second_ctrl_c_in_the_training_leads_to_the_checkpoint(measurement, tmp_path):
    def stop(step: Step) -> None:
        if step.step == 3:
            raise KeyboardInterrupt

    run = RunSettings(withhold=("none",), report=False, checkpoint_every=0.0)
    with pytest.raises(Interrupted, match="holds the last checkpoint; continue with nerif reconstruct --resume"):
        reconstruct_into(tmp_path / "r", measurement, QUICK, run, on_step=stop)


def test_every_stage_of_a_reconstruction_is_reported(measurement, tmp_path):
    titles = []

    def counting(title):
        titles.append(title)
        return Monitor().counting(title)

    monitor = replace(Monitor(), counting=counting)
    reconstruct_into(tmp_path / "r", measurement, QUICK, RunSettings(withhold=("none",)), voxels=8, monitor=monitor)
    assert titles == ["sampling the field", "re-projecting", "scoring the views", "writing the report"]


def test_progress_without_a_terminal_is_in_lines_after_a_while(monkeypatch, capsys):
    with counting_bar("tracing rays", 9) as bar:
        bar(3)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(output, "FIRST_LINE", 0.01)
    deadline, lines = time.monotonic() + 20, ""
    with counting_bar("tracing rays", 9) as bar:
        bar(3)
        while "tracing rays 3/9" not in lines and time.monotonic() < deadline:
            lines += capsys.readouterr().err
            time.sleep(0.01)
    assert lines.count("\n") == 1


def test_a_note_of_a_step_is_one_line(capsys):
    step = Step(1, 0.1, 1.0, 0.1, {"loss": 1.0}, 1.0, lambda: None, lambda: None)  # type: ignore[arg-type,return-value]
    with MONITOR.training("training") as on_step:
        on_step(step)
        on_step(replace(step, note="the loss is of images from here on"))
    assert capsys.readouterr().out == "the loss is of images from here on\n"


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_ends_a_command_without_a_traceback(name, code):
    script = (
        "import signal, sys, nerif.cli.commands.info as info, nerif.cli.cli\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in background jobs
        f"info.main = lambda words: signal.raise_signal(signal.{name})\n"
        "sys.argv[1:] = ['info', '.']\n"
        "sys.exit(nerif.cli.cli.main())\n"
    )
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert process.returncode == code
    assert process.stderr.startswith("nerif: interrupted; ")
    assert process.stderr.count("\n") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="ends processes by POSIX signals")
def test_a_run_that_gets_sigterm_ends_with_a_checkpoint_to_resume_from(measurement, tmp_path):
    out, run = tmp_path / "r", [sys.executable, "-m", "nerif", "reconstruct"]
    measurement.write(tmp_path / "m.nc")
    words = ["--max-steps", "100000", "--network.depth", "2", "--network.width", "16", "--points-per-batch", "64"]
    words += ["--withhold", "none", "--voxels", "8", "--device", "cpu", "--live", "--no-report"]
    line = [*run, str(tmp_path / "m.nc"), "-o", str(out), *words]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        while not (out / "live.json").exists():
            assert process.poll() is None, process.communicate()[0]
            time.sleep(0.02)
        process.terminate()
        text, _ = process.communicate(timeout=60)
    assert process.returncode == 143, text
    assert "stopping after this step" in text
    assert {CHECKPOINT, FIELD, "metrics.json"} <= {path.name for path in out.iterdir()}
    assert not list(out.glob(".*"))
    assert ResultDirectory(out).state().scalars


def test_a_simulated_sequence_reports_how_to_continue(tmp_path, monkeypatch):
    monkeypatch.setattr(simulate.Simulation, "over_time", interrupt)
    with pytest.raises(Interrupted, match="lack frames; run the same command with --force to start again"):
        simulate.run(simulate.Simulate(out=tmp_path / "m.zarr", times="0:1e-3:3"))
