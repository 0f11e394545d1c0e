"""When more training brings next to nothing, seen by rays that no step is given.

A run goes in cycles, each twice as long as the one before. Each ends with the smallest learning rate, so that what it
reached can be compared with what the others did; e is the mean square of the residual on the rays held back, over
sigma, of which the noise is 1. The run has converged when the last PATIENCE cycles have gained next to nothing:

    min e before them - min e of them <= max(FALL (e - 1), SCATTER e)

One cycle alone tells too little: rays held back are few, and what others tell of them scatters from cycle to cycle.
"""

from __future__ import annotations

import math
from typing import Any

from nerif.reconstruction.base import Outcome

__all__ = ["Cycles"]

PATIENCE = 2  # cycles
FALL = 0.08  # of what is above the noise: a doubling that gains less leaves 5 % of the error, its root, to the next two
SCATTER = 0.003  # of e itself: so much is chance
MOST = 6  # cycles


class Cycles:
    """The cycles of a run: where they began, and how well each met the rays held back.

    Parameters
    ----------
    first : steps of the first cycle
    longest : seconds after which the run ends at the latest
    """

    def __init__(self, first: int, longest: float) -> None:
        self.length, self.longest = first, longest
        self.step, self.seconds = 0, 0.0  # at which the present one began
        self.errors: list[float] = []
        self.verdict = ""  # why the run has converged, when it has

    def progress(self, step: int, seconds: float) -> float:
        """0 at the start of the present cycle, 1 at its end."""
        left = self.longest - self.seconds
        return max((step - self.step) / self.length, (seconds - self.seconds) / left if left > 0 else 1.0)

    def judge(
        self, error: float, noise: float, step: int, seconds: float, judged: str = "rays held back are"
    ) -> Outcome | None:
        """Take in how well the rays held back are met at the end of a cycle; begin the next, or say why there is none.

        Parameters
        ----------
        error : mean square of the residual on the rays held back
        noise : what of it is noise; 0 where that is not known
        step, seconds : done so far
        judged : whose error it is, for the message
        """
        self.errors.append(error)
        before, least = min(self.errors[:-PATIENCE], default=math.inf), min(self.errors[-PATIENCE:])
        length, taken = self.length, seconds - self.seconds
        self.step, self.seconds, self.length = step, seconds, 2 * length
        left = f"{judged} met to {math.sqrt(min(self.errors)):.3g}{' sigma' if noise else ''}"
        if before - least <= max(FALL * (least - noise), SCATTER * least):
            self.verdict = f"{left}, and {length + length // 2} steps more gained next to nothing"
        elif len(self.errors) == MOST:
            self.verdict = f"{left} after {MOST} cycles, the most there are"
        elif seconds + taken > self.longest:
            return Outcome("time_limit", f"{left} after {seconds:.0f} s; --time-limit {4 * seconds:.0f} may give more")
        return self.outcome

    @property
    def outcome(self) -> Outcome | None:
        """That of a run that has converged."""
        return Outcome("converged", self.verdict) if self.verdict else None

    @property
    def best(self) -> bool:
        """Whether no earlier cycle met the rays held back better than the last."""
        return self.errors[-1] <= min(self.errors)

    def kept(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        return {name: getattr(self, name) for name in ("length", "step", "seconds", "errors", "verdict")}

    def restore(self, kept: dict[str, Any]) -> None:
        """Go on from what a checkpoint kept."""
        for name, value in kept.items():
            setattr(self, name, value)
