"""Text files hold no half-done merge."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_no_merge_was_left_half_done() -> None:
    folders = ("docs", "src", "tests", "examples", "benchmarks")
    files = [*(file for folder in folders for file in (ROOT / folder).rglob("*")), *ROOT.glob("*.*")]
    texts = [file for file in files if file.suffix in (".md", ".py", ".toml", ".txt", ".js", ".css")]
    assert len(texts) > 300
    left = [str(f) for f in texts if any(line.startswith(("<" * 7, ">" * 7)) for line in f.read_text().splitlines())]
    assert not left
