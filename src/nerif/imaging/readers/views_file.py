"""Writing views.toml: the part of its frames that is each view's own, kept for nerif calibrate and displacement."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nerif.common.files import check_known, read_toml, write_toml
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import find_views

__all__ = ["BEFORE", "write_crops"]

BEFORE = "views.before.toml"
"""What a views.toml that somebody wrote was before it was changed for the first time, comments and all."""


def write_crops(folder: Path, crops: Mapping[str, Crop]) -> Path:
    """Write the crops of views into views.toml in the folder of an experiment, and return its path.

    Views that are not named keep theirs; a folder without the file gets one that lists all views. The first time that
    a file is changed its text is kept as views.before.toml.

    Parameters
    ----------
    folder : of the experiment
    crops : by the name of the view

    Raises
    ------
    InputError
        If the folder has no views, or none of one of the names.
    """
    views, file = find_views(folder), folder / "views.toml"
    check_known(crops, [view.name for view in views], "crops", "view")
    if file.is_file():
        table = read_toml(file)
        if not (folder / BEFORE).exists():
            shutil.copyfile(file, folder / BEFORE)
    else:
        table = {"views": {view.name: dict(view.sources) for view in views}}
    shared = {key for key in asdict(Crop()) if key in table}
    for name, crop in crops.items():
        own = {k: v for k, v in table["views"][name].items() if k not in asdict(crop)}
        table["views"][name] = {**own, **_entries(crop, shared)}
    write_toml(file, table)
    return file


def _entries(crop: Crop, shared: set[str]) -> dict[str, Any]:
    """What differs from a whole frame, or from what holds for every view."""
    plain = asdict(Crop())
    return {key: value for key, value in asdict(crop).items() if value != plain[key] or key in shared}
