"""Whether a training finds anything: its loss beside that of the empty field, index ambient everywhere.

    q = |prediction - d|^2 / |d|^2        over a batch, each over sigma^2; 1 for the empty field

A network that is stepped too far ends at the empty field, whose gradient is zero: q stays at 1.
"""

from __future__ import annotations

import math
from typing import Any

__all__ = ["Watch"]

EMPTY = 0.9  # of what can be explained is left: nothing is found
HALF, LOSS = 0.5, 0.1
PATIENCE, LEAST = 200, 50  # steps in which the loss must have fallen; steps after which an end says something
MEMORY = 0.95  # of the running mean, a step


class Watch:
    """Running mean of q, and what it means.

    Parameters
    ----------
    noise : the q that is left by the noise alone; 0 where it is not known
    """

    def __init__(self, noise: float) -> None:
        self.noise = noise
        self.left, self.lowest, self.step, self.since = 1.0, 1.0, 0, 0

    def follow(self, q: float, step: int) -> None:
        """Take in the q of a step; one without displacement, not a number, says nothing."""
        if math.isfinite(q):
            kept = MEMORY ** max(1, step - self.step)
            left = max(0.0, (q - self.noise) / (1 - self.noise)) if self.noise < EMPTY else 0.0
            self.left = kept * self.left + (1 - kept) * left
            self.lowest = min(self.lowest, self.left)
            self.since += max(1, step - self.step)
        self.step = step

    @property
    def healthy(self) -> bool:
        """Whether what was found is still there."""
        return self.left < self.lowest + LOSS

    def collapsed(self, over: bool) -> bool:
        """Whether nothing is found for long, or what was found is lost.

        Parameters
        ----------
        over : whether the run is; then fewer steps must do
        """
        long_enough = self.since >= (LEAST if over or self.found else PATIENCE)
        return long_enough and self.left > EMPTY

    @property
    def found(self) -> bool:
        """Whether anything ever was."""
        return self.lowest < HALF

    @property
    def remark(self) -> str:
        """What to say at the end of a run that found less than half."""
        if self.since < LEAST or self.left <= HALF:
            return ""
        return f"; {self.left:.0%} of the squared displacement, noise apart, is not explained yet"

    def kept(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        return {name: getattr(self, name) for name in ("left", "lowest", "step", "since")}

    def restore(self, kept: dict[str, Any]) -> None:
        """Go on from what a checkpoint kept."""
        for name, value in kept.items():
            setattr(self, name, value)
