"""The runner: records, seeds, failures, resumption, another revision; and the fastest benchmark from start to page."""

from __future__ import annotations

import contextlib
import inspect
import json
import os
import signal
import subprocess
import sys
import time
import types

import pytest

from benchmarks import runner
from benchmarks.__main__ import main
from nerif import __version__
from nerif.common.conventions import InputError


def cases(quick):
    """Cases of a benchmark that needs no time."""
    return [{"phantom": p, "size": 2 if quick else 4, "seed": s} for p in ("a", "b") for s in range(1 if quick else 3)]


def measure(folder, phantom, size, seed):
    if phantom == "b" and seed == 1:
        raise ValueError("too | bad")
    return {"l2": size * (1 + seed) if phantom == "a" else float("nan"), "outcome": "steps", "none": None}


@pytest.fixture
def fake(monkeypatch):
    """The benchmark "fake", run in this process."""
    module = types.ModuleType("benchmarks.fake", "A title.\n\nWhat is measured.")
    module.__dict__.update(
        cases=cases, measure=measure, COLUMNS={"phantom": "{phantom}", "L2": "{l2:.2f}", "ratio": "{l2_ratio:.1f}"},
        derive=lambda rows: runner.ratios(rows, "l2", ("size",), phantom="a"),
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "benchmarks.fake", module)
    monkeypatch.setattr(runner, "NAMES", ("fake", *runner.NAMES))
    monkeypatch.setattr(runner, "alone", runner.measured)
    return module


def test_records_are_lines_and_the_page_has_medians_of_seeds_and_ratios(fake, tmp_path, capsys):
    assert main(["run", "fake", "--out", str(tmp_path)]) == 1  # one case failed
    records = [json.loads(line) for line in (tmp_path / "fake.jsonl").read_text().splitlines()]
    assert len(records) == 6
    assert records[1]["settings"] == {"phantom": "a", "size": 4, "seed": 1}
    assert records[1]["metrics"] == {"l2": 8, "outcome": "steps", "none": None}
    assert {records[1][key] for key in ("nerif", "commit", "machine", "date", "torch")} >= {__version__}
    assert records[4]["failed"].startswith("ValueError: too | bad (test_runner.py, line")
    assert records[5]["metrics"]["l2"] is None  # NaN is no JSON
    page = (tmp_path / "fake.md").read_text()
    assert page.startswith("# A title\n\nWhat is measured.\n\nCommand: `python -m benchmarks run fake`\n\n| phantom |")
    assert "| a | 8.00 | 1.0 |\n| b | – | – |" in page
    assert "all 6 |" in page
    assert "| a | 8.00 | 1.0 |" in capsys.readouterr().out
    (tmp_path / "fake.md").unlink()
    assert main(["page", "fake", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "fake.md").read_text() == page


def test_cases_are_selected_and_changed(fake, tmp_path, capsys):
    words = ["run", "fake", "--quick", "--only", "a", "--set", "size=7", "--out", str(tmp_path)]
    assert main(words) == 0
    assert main(words) == 0
    records = runner.read_records(tmp_path / "fake-quick.jsonl")
    assert [r["settings"] for r in records] == [{"phantom": "a", "size": 7, "seed": 0}] * 2
    assert len(runner.rows_of(records)) == 1
    assert "run fake --quick`" in (tmp_path / "fake-quick.md").read_text()


def test_resumption_keeps_records_of_this_version_and_the_same_settings(fake, tmp_path, monkeypatch):
    words = ["run", "fake", "--out", str(tmp_path), "--resume"]
    counts = []
    for version in (__version__, __version__, "9.9"):
        monkeypatch.setattr(runner, "__version__", version)
        main(words)
        counts.append(len(runner.read_records(tmp_path / "fake.jsonl")))
    assert counts == [6, 7, 13]  # the failed one is run again; another version runs all


def test_a_failure_is_named_in_the_row_and_an_absent_peer_is_no_error(fake, tmp_path, capsys):
    fake.measure = lambda folder, **case: runner.peer("no_such_module", "Peer")
    assert main(["run", "fake", "--quick"]) == 0
    assert "| a | Peer not installed | – |" in capsys.readouterr().out


def test_an_interrupted_run_leaves_a_page(fake, tmp_path):
    def interrupted(folder, phantom, **case):
        if phantom == "b":
            raise KeyboardInterrupt
        return {"l2": 1.0}

    fake.measure = interrupted
    assert main(["run", "fake", "--out", str(tmp_path)]) == 130
    assert "| a | 1.00 |" in (tmp_path / "fake.md").read_text()


@pytest.mark.parametrize(
    ("words", "field"),
    [
        ("run nonsense", "name"),
        ("run fake --only z", "only"),
        ("run fake --set length=3", "set"),
        ("run fake --out {file}", "out"),
        ("page fake --out {file}", "fake"),
        ("run fake --against no-such-revision", "against"),
    ],
)
def test_bad_input(fake, tmp_path, capsys, words, field):
    (tmp_path / "file").touch()
    assert main(words.format(file=tmp_path / "file").split()) == 2
    assert capsys.readouterr().err.startswith(f"benchmarks: {field}: ")


def test_another_revision_runs_in_turns_and_is_compared_as_ratios(fake, tmp_path, monkeypatch, capsys):
    order = []

    def elsewhere(name, case, data, checkout):
        order.append("now" if checkout == runner.ROOT else "before")
        return {"metrics": {"l2": 3.0 if checkout == runner.ROOT else 2.0, "outcome": "x"}}

    monkeypatch.setattr(runner, "_elsewhere", elsewhere)
    monkeypatch.setattr(runner, "worktree", contextlib.nullcontext)
    assert main(["run", "fake", "--quick", "--against", "HEAD"]) == 0
    assert order[-4:] == ["before", "now", "now", "before"]
    text = capsys.readouterr().out
    assert "| phantom=a, size=2, seed=0 | l2 | 2 | 3 | 1.500 |" in text
    assert "| l2 | 1.500 | 2 |" in text


def killed(*arguments):
    os.kill(os.getpid(), signal.SIGKILL)


def asleep(*arguments):
    time.sleep(60)


@pytest.mark.slow
def test_a_process_that_is_killed_is_a_failure(monkeypatch, tmp_path):
    monkeypatch.setattr(runner, "_work", killed)
    assert "was killed" in runner.alone("study", {}, tmp_path)["failed"]


@pytest.mark.slow
def test_a_process_ends_with_its_budget(monkeypatch, tmp_path):
    monkeypatch.setattr(runner, "_work", asleep)
    assert "budget of 0.5 s" in runner.alone("study", {"budget": 0.5}, tmp_path)["failed"]


def test_the_parts_for_a_card_take_twelve_minutes_at_most():
    assert sum(case["budget"] for case in runner.benchmark("gpu").cases(quick=False)) <= 720


@pytest.mark.slow
def test_list_and_case_as_programs(tmp_path):
    command = [sys.executable, "-m", "benchmarks"]
    result = subprocess.run([*command, "list"], capture_output=True, text=True, cwd=runner.ROOT)
    assert [line.split()[0] for line in result.stdout.splitlines()] == list(runner.NAMES)
    (case, *_) = runner.select(runner.benchmark("voxel_cost"), quick=True)
    words = ["case", "voxel_cost", json.dumps(case), "--data", str(tmp_path)]
    result = subprocess.run([*command, *words], capture_output=True, text=True, cwd=runner.ROOT)
    assert json.loads(result.stdout)["metrics"]["seconds"] > 0


@pytest.mark.parametrize("name", runner.NAMES)
def test_every_benchmark_has_flat_cases_that_its_function_takes(name):
    module = runner.benchmark(name)
    signature = inspect.signature(module.measure)
    for quick in (True, False):
        settings = runner.select(module, quick)
        assert len({json.dumps(case) for case in settings}) == len(settings)
        for case in settings:
            signature.bind("folder", **case)
            assert all(isinstance(value, str | int | float) for value in case.values())
    assert hasattr(module, "blocks") or module.COLUMNS


@pytest.mark.slow
def test_the_fastest_benchmark_runs_and_renders_a_page(tmp_path):
    assert main(["run", "goals", "--quick", "--only", "Tikhonov", "--out", str(tmp_path)]) == 0
    page = (tmp_path / "goals-quick.md").read_text()
    assert page.startswith("# Error and seconds on common cases\n")
    assert "| flame | 16² | 0.05 | Tikhonov |" in page
    assert "nan" not in page


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in runner.NAMES if name not in ("goals", "study")])
def test_every_benchmark_measures(name, tmp_path, monkeypatch):
    """The first quick case of each, in this process."""
    module = runner.benchmark(name)
    case, *_ = runner.select(module, quick=True)
    record = runner.measured(name, case, tmp_path)
    if "unavailable" in record:
        pytest.skip(record["failed"])
    assert "metrics" in record, record
    assert "nan" not in "".join(runner.blocks_of(module, [{"settings": case, **record}]))


def test_unknown_benchmarks_are_refused():
    with pytest.raises(InputError):
        runner.benchmark("nonsense")
