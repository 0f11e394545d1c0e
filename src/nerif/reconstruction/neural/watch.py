"""Whether a training finds anything: its loss beside that of the empty field, index ambient everywhere.

    q = |prediction - d|^2 / |d|^2        over the last steps, each over sigma^2; 1 for the empty field

A network that is stepped too far ends at the empty field, whose gradient is zero: q stays at 1.
"""

from __future__ import annotations

import math
from typing import Any

__all__ = ["Watch"]

EMPTY = 0.9  # of what can be explained is left: nothing is found
HALF, LOSS = 0.5, 0.1
MUCH = 1.5  # sigma, of which noise alone leaves 1
PATIENCE, LEAST = 200, 50  # steps in which the loss must have fallen; steps after which an end says something
RATE = 1.5e-2  # learning rate that PATIENCE is for: at a smaller one the weights need more steps to go as far
MEMORY = 0.95  # of the running mean, a step


class Watch:
    """What is left of q when the noise is taken off, and what it means.

    Parameters
    ----------
    noise : the q that is left by the noise alone; 0 where it is not known
    rate : learning rate of the run
    """

    def __init__(self, noise: float, rate: float = RATE) -> None:
        self.noise, self.patience = noise, round(PATIENCE * max(1.0, RATE / rate))
        self.residual, self.empty = 0.0, 0.0  # running means
        self.lowest, self.step, self.since = 1.0, 0, 0

    def follow(self, residual: float, empty: float, step: int) -> None:
        """Take in the two means of a step; where nothing was measured there is nothing to explain."""
        steps = max(1, step - self.step)
        self.step = step
        if empty > 0:
            kept = MEMORY**steps
            self.residual = kept * self.residual + (1 - kept) * residual
            self.empty = kept * self.empty + (1 - kept) * empty
            self.since += steps
            if self.since >= LEAST:
                self.lowest = min(self.lowest, self.left)

    @property
    def left(self) -> float:
        """What is not explained, and is not noise, as a share; 0 where there is nothing to explain."""
        if not self.empty or self.noise >= EMPTY:
            return 0.0
        return max(0.0, (self.residual / self.empty - self.noise) / (1 - self.noise))

    @property
    def healthy(self) -> bool:
        """Whether what was found is still there."""
        return self.since < LEAST or self.left < self.lowest + LOSS

    def collapsed(self, over: bool) -> bool:
        """Whether nothing is found for long, or most of what was found is lost.

        Parameters
        ----------
        over : whether the run is; then fewer steps must do
        """
        if self.found:
            return self.since >= LEAST and self.left > HALF
        return self.since >= (LEAST if over else self.patience) and self.left > EMPTY

    @property
    def found(self) -> bool:
        """Whether a field ever was."""
        return self.lowest < HALF / 2

    @property
    def remark(self) -> str:
        """What to say at the end of a run that found less than half, or left much more than the noise."""
        if self.since < LEAST:
            return ""
        if self.left > HALF:
            return f"; {self.left:.0%} of what was measured, squared and noise apart, is not explained yet"
        if self.sigmas > MUCH:
            return (
                f"; the residual is {self.sigmas:.1f} sigma: more time or a larger --network.width lowers it, "
                "more views the error, unless cameras or sigma are wrong (nerif check)"
            )
        return ""

    @property
    def sigmas(self) -> float:
        """The residual, rms over sigma; 0 where sigma is not known."""
        return math.sqrt(self.residual / self.empty / self.noise) if self.noise and self.empty else 0.0

    def kept(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        return {name: getattr(self, name) for name in ("residual", "empty", "lowest", "step", "since")}

    def restore(self, kept: dict[str, Any]) -> None:
        """Go on from what a checkpoint kept."""
        for name, value in kept.items():
            setattr(self, name, value)
