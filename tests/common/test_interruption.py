"""Ctrl-C says what is saved and how to go on; work of some seconds is told, also where there is no terminal."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace

import pytest

from nerif.cli.cli import COMMANDS, main
from nerif.cli.commands import info, output, simulate
from nerif.cli.commands.output import MONITOR, counting_bar
from nerif.common.files import atomic, written
from nerif.common.interruption import Interrupted, if_interrupted
from nerif.reconstruction.base import Step
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import ResultDirectory
from nerif.workflow import job, steps
from nerif.workflow.job import Run
from nerif.workflow.pipeline import reconstruct_into

QUICK = Tikhonov(voxels=8, basis="linear", iterations=4, regularisation=0.1, device="cpu")


def broken_off(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_what_is_nearest_to_the_work_speaks():
    with pytest.raises(Interrupted, match=r"^inner$"), if_interrupted(lambda: "outer"), if_interrupted(lambda: "inner"):
        raise KeyboardInterrupt
    with pytest.raises(ValueError, match="other"), if_interrupted(lambda: "outer"):
        raise ValueError("other")


@pytest.mark.parametrize("verb", [verb for verb in COMMANDS if verb != "app"])
def test_every_command_ends_in_one_line(verb, monkeypatch, capsys):
    module = __import__(f"nerif.cli.commands.{verb}", fromlist=["main"])
    monkeypatch.setattr(module, "main", broken_off)
    written.clear()
    assert main([verb]) == 130
    said = capsys.readouterr()
    assert said.err == "nerif: interrupted; nothing was written; run the same command again\n"
    assert said.out == ""


def test_files_that_are_whole_are_named(tmp_path, monkeypatch, capsys):
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
    said = capsys.readouterr().err
    assert f"{tmp_path / 'f'} and 2 more; run the same command with --force" in said
    assert "lost" not in said


STAGES = {
    "before the first step": ("with_halves", "nothing was saved yet"),
    "sampling": ("all_quantities", "holds the field, but not all other files"),
    "re-projecting": ("reproject", "holds the field, but not all other files"),
    "scoring": ("evaluate_views", "holds the field, but not all other files"),
    "verdict": ("verdict", "holds the field, but not all other files"),
}


@pytest.mark.parametrize("stage", STAGES)
def test_a_reconstruction_says_what_is_saved_and_goes_on(stage, measurement, tmp_path, monkeypatch, capsys):
    name, words = STAGES[stage]
    path, out = tmp_path / "m.nc", tmp_path / "r"
    measurement.write(path)
    run = Run(withhold=("none",), report=False)
    with monkeypatch.context() as patch:
        patch.setattr(job if hasattr(job, name) else steps, name, broken_off)
        with pytest.raises(Interrupted, match=words) as stop:
            reconstruct_into(out, path, QUICK, run, voxels=8)
    if words.startswith("holds"):
        assert f"nerif reconstruct --resume --out {out}" in str(stop.value)
        assert main(["reconstruct", "--resume", "--out", str(out)]) == 0
        assert ResultDirectory(out).metrics()["verdict"]


def test_a_result_that_was_there_is_not_taken_for_the_run_s_own(measurement, tmp_path, monkeypatch):
    run = Run(withhold=("none",), report=False)
    reconstruct_into(tmp_path / "r", measurement, QUICK, run, voxels=8)
    monkeypatch.setattr(job, "with_halves", broken_off)
    with pytest.raises(Interrupted, match="nothing was saved yet"):
        reconstruct_into(tmp_path / "r", measurement, QUICK, run, voxels=8, force=True)


def test_a_second_ctrl_c_in_the_training_leads_to_the_checkpoint(measurement, tmp_path):
    def stop(step: Step) -> None:
        if step.step == 3:
            raise KeyboardInterrupt

    run = Run(withhold=("none",), report=False, checkpoint_every=0.0)
    with pytest.raises(Interrupted, match="holds the last checkpoint; continue with nerif reconstruct --resume"):
        reconstruct_into(tmp_path / "r", measurement, QUICK, run, on_step=stop)


def test_every_stage_of_a_reconstruction_is_told(measurement, tmp_path):
    told = []

    def counting(title):
        told.append(title)
        return Monitor().counting(title)

    monitor = replace(Monitor(), counting=counting)
    reconstruct_into(tmp_path / "r", measurement, QUICK, Run(withhold=("none",)), voxels=8, monitor=monitor)
    assert told == ["sampling the field", "re-projecting", "scoring the views", "writing the report"]


def test_work_without_a_terminal_is_told_in_lines(monkeypatch, capsys):
    monkeypatch.setattr(output, "FIRST_LINE", 0.01)
    deadline, lines = time.monotonic() + 20, ""
    with counting_bar("tracing rays", 9) as bar:
        bar(3)
        while "tracing rays 3/9" not in lines and time.monotonic() < deadline:
            lines += capsys.readouterr().err
    assert lines.count("\n") == 1


def test_work_that_is_done_soon_is_not_told(capsys):
    with counting_bar("tracing rays", 9) as bar:
        bar(3)
    assert capsys.readouterr().err == ""


def test_a_note_of_a_step_is_one_line(capsys):
    step = Step(1, 0.1, 1.0, 0.1, {"loss": 1.0}, 1.0, lambda: None, lambda: None)  # type: ignore[arg-type,return-value]
    with MONITOR.training("training") as told:
        told(step)
        told(replace(step, note="the loss is of images from here on, of displacements before: it jumps"))
    assert capsys.readouterr().out == "the loss is of images from here on, of displacements before: it jumps\n"


def test_a_signal_ends_a_command_without_a_traceback(tmp_path):
    code = (
        "import os, signal, sys, nerif.cli.commands.info as info, nerif.cli.cli\n"
        "info.main = lambda words: os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.exit(nerif.cli.cli.main(['info', 'x']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 130
    assert done.stderr.startswith("nerif: interrupted; ")
    assert done.stderr.count("\n") == 1


def test_a_film_that_is_simulated_says_how_to_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(simulate.Simulation, "over_time", broken_off)
    with pytest.raises(Interrupted, match="lack frames; run the same command with --force to start again"):
        simulate.run(simulate.Simulate(out=tmp_path / "m.zarr", times="0:1e-3:3"))
