"""Text files hold no half-done merge, and properties of the app's elements no text of others."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_no_merge_was_left_half_done() -> None:
    folders = ("docs", "src", "tests", "examples", "benchmarks")
    files = [*(file for folder in folders for file in (ROOT / folder).rglob("*")), *ROOT.glob("*.*")]
    texts = [file for file in files if file.suffix in (".md", ".py", ".toml", ".txt", ".js", ".css")]
    assert len(texts) > 300
    left = [str(f) for f in texts if any(line.startswith(("<" * 7, ">" * 7)) for line in f.read_text().splitlines())]
    assert not left


def test_properties_of_elements_are_set_one_by_one() -> None:
    """A text within `props("...")` can end its value and begin a property `:x=...`, which the browser runs."""
    calls = [
        (file.name, call.lineno, call.args)
        for file in (ROOT / "src/nerif/app").rglob("*.py")
        for call in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and call.func.attr == "props"
    ]
    assert len(calls) > 50
    assert not [(name, line) for name, line, texts in calls if not all(isinstance(t, ast.Constant) for t in texts)]
