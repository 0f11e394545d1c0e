"""Settings of a reconstruction into a directory, in addition to those of the method."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerif.common.settings import Natural, NonNegative
from nerif.physics.media import MediumSettings

__all__ = ["AUTO", "NONE", "Run", "RunSettings"]

AUTO: tuple[str, ...] = ("auto",)
NONE: tuple[str, ...] = ("none",)
"""Values of `withhold` other than names of views: cross-validation with one view, and no withheld view."""


@dataclass(frozen=True)
class RunSettings(MediumSettings):
    """Settings of a reconstruction into a directory, in addition to those of the method."""

    withhold: tuple[str, ...] = AUTO
    """Withheld views for cross-validation: names; left or right (half of each image of an axisymmetric flow); auto (one
    view, in a short cross-validation run from which the main run, with all views, starts); or none."""
    start_from: Path | None = None
    """Result directory with the initial field: a reconstruction by any method in the same box."""
    extend_open_faces: NonNegative = 0.0
    """Millimetres by which the box grows through the open faces (--open-faces) while the field is solved for: rays
    through them are kept. The result is that of the box alone (0: rays through open faces are left out)."""
    fit_gains: bool = False
    """For emission: fit the intensity gain of each camera (not of withheld views)."""
    detail: Literal["auto", "on", "off"] = "auto"
    """Add detail that the field leaves in its data (docs/detail.md): on, off, or auto (for nerif and tv, where the
    residual is above the noise and the withheld view of the cross-validation is predicted better with it)."""
    uncertainty: Literal["off", "fast", "full"] = "off"
    """Standard deviations of every quantity: off, fast (2 samples of the error) or full (8 samples): draws from the
    posterior where detail is added to the blurred field, else bootstrap trials."""
    report: bool = True
    """Write report.html at the end."""
    checkpoint_every: float = 60.0
    """Interval between checkpoints in seconds."""
    threads: Natural = 0
    """Threads on a CPU (0: as many as there are free cores). With a fixed number, runs without a time limit have the
    same result to the last digit."""


Run = RunSettings  #: the name of the class in earlier versions
