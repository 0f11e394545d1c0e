"""Draws the images of docs/drawings.py before pages are read."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def draw(app: Any) -> None:
    import drawings

    drawings.draw_all(Path(app.srcdir) / "_drawings")


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
