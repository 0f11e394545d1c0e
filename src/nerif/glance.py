"""A quick look at a result directory, for a list of many."""

from __future__ import annotations

import os
from typing import Any

from nerif.data.volume import Volume
from nerif.reconstruction.files import FIELD
from nerif.results.directory import METRICS, RUN, UNREADABLE, VOLUME, Missing, Result, ResultDirectory

__all__ = ["glance"]


def glance(path: str | os.PathLike[str]) -> Result:
    """Return what a verdict rests on: settings, figures, and the volumes where there are standard deviations.

    Views and curves are left out, which makes it quick; what cannot be read is told in the Result.
    """
    directory, missing = ResultDirectory(path), []
    run: dict[str, Any] = {}
    metrics: dict[str, Any] = {}
    volumes: dict[str, Volume] = {}
    try:
        run = directory.settings()
        metrics = directory.metrics() if directory.has(METRICS) else {}
        if {"uncertainty", "ensemble"} & set(metrics) and directory.has(VOLUME):
            volumes = directory.volumes()
    except UNREADABLE as error:
        missing.append(Missing(RUN, " ".join(str(error).split())))
    if not directory.has(FIELD):
        missing.append(Missing(FIELD, f"The run has not ended: there is no {FIELD}."))
    return Result(
        directory=directory.path,
        settings={k: v for k, v in run.items() if k != "about"},
        about=run.get("about", {}),
        metrics=metrics,
        volumes=volumes,
        missing=tuple(missing),
    )
