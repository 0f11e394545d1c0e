"""Commands of nerif, run in this process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from nerif.cli.cli import main


def run(*words: object) -> int:
    """Run a command, and return its exit code."""
    return main([str(word) for word in words])


def metrics_of(result: Path) -> dict[str, Any]:
    """Return metrics.json of a result directory."""
    return json.loads((result / "metrics.json").read_text())
