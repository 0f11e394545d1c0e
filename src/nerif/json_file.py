"""JSON files: written whole or not at all, with null for numbers that are none."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerif.common.files import atomic

__all__ = ["write_json"]


def write_json(path: Path, entries: Mapping[str, Any]) -> None:
    """Write a JSON file, atomically; NaN and infinity as null."""
    with atomic(path) as part:
        part.write_text(json.dumps(_plain(entries), indent=2, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
