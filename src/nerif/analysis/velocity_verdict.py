"""The verdict on a velocity: residuals of the equations, standard deviations, determined region, outcome of the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nerif.analysis.verdict import RATINGS, Verdict
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import COMPONENTS

__all__ = ["MOST_MISFIT", "known_share", "relative_deviation", "velocity_verdict"]

MISFIT = 1.5, 3.0  # rms of residual / sigma: above, with care; above, not to be used
UNEXPLAINED = 0.01, 0.1  # acceleration that momentum leaves: of a plume 0.004, of wrinkles that are no flow 0.015
DEVIATION = 0.2, 0.5  # standard deviation of the velocity over its rms
KNOWN = 0.05, 0.01  # share of the box: below, with care; below, not to be used
MOST_MISFIT = MISFIT[1]


def velocity_verdict(store: VelocitySequence) -> Verdict:
    """Return the verdict on a velocity that was computed from a film."""
    about = store.attributes
    settings, misfit, unexplained = about.get("settings", {}), float(about["misfit"]), about.get("unexplained")
    share, spread = known_share(store), relative_deviation(store, COMPONENTS)
    level = [sum(misfit > limit for limit in MISFIT)]
    changes = f"the density changes that the velocity does not explain are {misfit:.2g} times those of noise and grid"
    longer = "more time (--time-limit), " if about.get("falling") else ""
    check = f" (give {longer}a finer grid (--resolution), or check units, physics and properties of the fluid)"
    reasons = [changes + check * (misfit > MISFIT[0])]
    if unexplained is not None:
        level.append(sum(unexplained > limit for limit in UNEXPLAINED))
        reasons.append(f"the equation of momentum leaves {unexplained:.1%} of the acceleration unexplained")
    if spread is not None:
        level.append(sum(spread > limit for limit in DEVIATION))
        size = f"the standard deviation of the velocity is {spread:.0%} of its rms"
        reasons.append(f"{size}, without errors of the equations")
    elif settings.get("samples"):
        level.append(1)
        reasons.append("the limits left no time for standard deviations")
    if about.get("falling"):
        level.append(1)
        reasons.append("the fit ended at its limits while its residual still fell")
    if share < KNOWN[0]:
        level.append(1 + (share < KNOWN[1]))
        reasons.append(f"it is known in {share:.1%} of the box only")
    if about.get("physics") == "transport":
        level.append(1)
        reasons.append(
            "without an equation of momentum velocity along surfaces of equal density follows only from continuity and "
            "smoothness, and there is no pressure"
        )
    return Verdict.of(RATINGS[max(level)], None, reasons)


def known_share(store: VelocitySequence) -> float:
    """Return the share of the box in which the velocity is known, the mean over time."""
    return float(np.mean([np.isfinite(store.read("u", k)).mean() for k in range(len(store))]))


def relative_deviation(store: VelocitySequence, quantities: Sequence[str]) -> float | None:
    """Return the rms standard deviation of quantities relative to their rms; None if there is none."""
    if any(f"{name}_std" not in store.group for name in quantities):
        return None
    spread, size = (
        sum(float(np.nansum(np.square(store.read(f"{name}{end}", slice(None))))) for name in quantities)
        for end in ("_std", "")
    )
    return math.sqrt(spread / size) if size > 0 else None
