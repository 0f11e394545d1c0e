"""Remedies in verdicts and reports: for causes of correlated residuals, and a longer run.

A remedy names the setting of a run by which it is in use, and is not advised to that run. A cause whose parameters are
fitted together with the field, such as a wrong pose under --refine cameras, does not explain the residual of that fit,
even if the pattern resembles it: detail that is not yet learned lies where the projections are steep, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nerif.reconstruction.rig_groups import refined_groups
from nerif.results.directory import Result

__all__ = [
    "CAUSES", "CHECK", "DEVIATIONS", "SYMMETRY", "WITHHOLD", "Remedy", "advice", "is_fitted", "likely_cause", "longer",
]  # fmt: skip


@dataclass(frozen=True)
class Remedy:
    """A remedy."""

    words: str  #: with the option
    setting: str = ""  #: of run.toml by which it is in use; empty for another command
    values: tuple[str, ...] = ()  #: with any of which it is

    def in_use(self, settings: Mapping[str, Any]) -> bool:
        """Whether a run with these settings has it in use."""
        return bool(set(self.values) & set(_words(settings.get(self.setting, ()))))


@dataclass(frozen=True)
class Cause:
    """A cause of correlated residuals; `group`: of the refined parameters that are fitted to its pattern."""

    words: str
    remedies: tuple[Remedy, ...] = ()
    group: str = ""


CAUSES = {
    "offset": Cause(
        "a shift of the whole image (camera shake)",
        (Remedy("--refine shift", "refine", ("shift",)), Remedy("nerif displacement --shake-border")),
        "shift",
    ),
    "calibration": Cause(
        "a wrong camera pose",
        (
            Remedy("nerif check finds images that are upside down, mirrored or exchanged"),
            Remedy("if it finds none, --refine cameras", "refine", ("cameras",)),
        ),
        "cameras",
    ),
    "rows": Cause("rows or columns that moved together (a rolling shutter): use a global shutter, or average images"),
    "scale": Cause("a wrong scale: distances, pixel pitch, sensitivity, or an evaluation method that underestimates"),
    "blur": Cause(
        "different sharpness of measurement and field, by windows of optical flow or the lens",
        (Remedy("--aperture auto", "aperture", ("auto", "on")),),
    ),
}
"""Causes by the names of their patterns (residuals.py)."""

SYMMETRY = Remedy(
    "one camera determines a symmetric flow only: --symmetry axis, or planar, with --axis-direction X Y Z",
    "symmetry",
    ("axis", "planar"),
)
CHECK = Remedy("nerif check finds swapped u and v, wrong signs, and mirrored or exchanged images")
WITHHOLD = Remedy("--withhold auto withholds one in a cross-validation run", "withhold", ("auto",))
DEVIATIONS = Remedy("--uncertainty fast computes standard deviations", "uncertainty", ("fast", "full"))
LONGER = {
    "time_limit": "a longer --time-limit", "steps": "more --max-steps", "epochs": "more --epochs",
    "iterations": "more --iterations", "interrupted": "--resume",
}  # fmt: skip
NETWORK = "nerif"  # the method without a penalty
NEAR_NOISE = 1.5  # rms of a residual over that of the noise
SMOOTHED = ("blur", "scale")  # patterns that a field leaves, too, which is not yet learned or regularised


def advice(remedies: Sequence[Remedy], settings: Mapping[str, Any]) -> str:
    """Return the remedies that a run with these settings does not have in use."""
    return "; ".join(remedy.words for remedy in remedies if not remedy.in_use(settings))


def longer(result: Result) -> str:
    """Return the option that makes a run longer; empty for one that has converged."""
    return LONGER.get(result.metrics.outcome or "", "")


def is_fitted(cause: str, settings: Mapping[str, Any]) -> bool:
    """Whether a run with these settings has fitted the parameters that leave the pattern of a cause."""
    entry = CAUSES.get(cause)
    return entry is not None and entry.group in _words(settings.get("refine", ()))


def likely_cause(cause: str, result: Result, ratio: float = math.inf) -> str:
    """Return the likely cause of a correlated residual with its remedies.

    Parameters
    ----------
    cause : whose pattern it has, one of CAUSES, or empty
    ratio : rms of the residual over that of the noise; near 1, a run that has not converged only needs more steps
    """
    entry, option, settings = CAUSES.get(cause), longer(result), result.settings
    field = "detail that the field cannot resolve"
    if option:
        field = f"detail not yet learned ({option} may reduce it)"
        if ratio < NEAR_NOISE and (entry is None or cause in SMOOTHED):
            return field
    elif cause in SMOOTHED:
        field = f"smoothing by {settings['method']}" if settings.get("method", NETWORK) != NETWORK else ""
    if entry is None:
        other = "a view that does not fit the others, or flow beyond the box (nerif check)"
        return f"{field}, or {other}" if option else other
    if is_fitted(cause, settings):
        return f"{field}, as --refine {entry.group} is in use"
    text = ": ".join(filter(None, (entry.words, advice(entry.remedies, settings))))
    return f"{field}, or {text}" if field and cause in SMOOTHED else text


def _words(value: Any) -> tuple[str, ...]:
    """The words of a setting, a text or several; --refine cameras,shift has two."""
    return refined_groups((value,) if isinstance(value, str) else value)
