"""A warning, after a look at the first few steps, where the time limit of a training allows too few of them."""

from __future__ import annotations

import math
from collections.abc import Callable

from nerif.reconstruction.base import Reconstructor, Step
from nerif.reconstruction.neural.settings import TrainingSettings

__all__ = ["SlowRun", "lasting"]

FEWEST = 100  # steps, with fewer of which no field comes out
LOOK, EARLY = 5, 0.05  # steps, or share of the limit, after which the pace is known


class SlowRun:
    """Called after each step of one or more trainings; says once, in one line, that there is time for too few steps.

    The first step does not count, since it may compile the network.

    Parameters
    ----------
    settings : of the whole run; of a method that trains no network nothing is said
    say : takes the line
    """

    def __init__(self, settings: Reconstructor, say: Callable[[str], None]) -> None:
        self.settings, self.say = settings, say
        self.line = ""  # that was said
        self._first: Step | None = None
        self._done = False

    def __call__(self, step: Step) -> None:
        settings, first = self.settings, self._first
        if self._done or not isinstance(settings, TrainingSettings) or math.isinf(settings.latest):
            return
        if step.step == 0:  # the network is being fitted to a start
            return
        limit = settings.latest
        if first is None or step.step <= first.step:  # another run has begun
            self._first = step
            return
        steps, seconds = step.step - first.step, step.seconds - first.seconds
        if steps < LOOK and seconds < EARLY * limit:
            return
        self._done = True
        pace, planned = seconds / steps, settings.steps(step.pass_steps)
        allowed = first.step + (limit - first.seconds) / max(pace, 1e-9)
        if allowed >= min(FEWEST, planned):
            return
        plan = f"the {planned:.0f} steps asked for" if math.isfinite(planned) else f"{FEWEST} steps"
        whole = planned if math.isfinite(planned) else FEWEST
        self.line = (
            f"slow: a step takes {lasting(pace)}, so the limit of {lasting(limit)} allows about {allowed:.0f} steps; "
            f"{plan} would take {lasting(whole * pace)}. Give a longer --time-limit, or fewer --points-per-batch and a "
            "smaller --network.width (--preset fast suits a CPU)"
        )
        self.say(self.line)


def lasting(seconds: float) -> str:
    """Return a duration in words, to two figures."""
    for unit, name in ((86400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * unit:
            return f"{seconds / unit:.0f} {name}" if seconds >= 10 * unit else f"{seconds / unit:.1f} {name}"
    return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.2g} s"
