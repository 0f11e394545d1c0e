"""Lint and types, beside the other tests: they take as long as many of those."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("command", [["ruff", "check", "."], ["mypy"]], ids=["ruff", "mypy"])
def test_nothing_is_found(command: list[str]) -> None:
    done = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_merge_was_left_half_done() -> None:
    folders = ("docs", "src", "tests", "examples", "benchmarks")
    files = [*(file for folder in folders for file in (ROOT / folder).rglob("*")), *ROOT.glob("*.*")]
    texts = [file for file in files if file.suffix in (".md", ".py", ".toml", ".txt", ".js", ".css")]
    assert len(texts) > 300
    left = [str(f) for f in texts if any(line.startswith(("<" * 7, ">" * 7)) for line in f.read_text().splitlines())]
    assert not left
