"""Detection of a field that stays or becomes ambient, and remarks on a poor fit.

A network that takes too large a step ends at the ambient field, whose gradient is zero. There

    q = |prediction - d|^2 / |d|^2        over the last steps, each over sigma^2

stays at 1.
"""

from __future__ import annotations

import math

from nerif.reconstruction.neural.schedule import Resumable

__all__ = ["FitMonitor"]

EMPTY = 0.9  # unexplained share of the signal from which no field counts as found
HALF, LOSS = 0.5, 0.1
HIGH_RESIDUAL = 1.5  # sigma
EMPTY_STEPS, MIN_STEPS = 200, 50  # steps in which the loss must have fallen; steps before any verdict
EMPTY_RATE = 1.5e-2  # learning rate of EMPTY_STEPS: at a smaller one the weights need more steps to move as far
MEMORY = 0.95  # of the running mean, per step


class FitMonitor(Resumable):
    """Unexplained share of the signal, q without the noise.

    Parameters
    ----------
    noise : q of the noise alone; 0 if unknown
    rate : learning rate of the run
    """

    STATE = ("residual", "empty", "lowest", "step", "since")

    def __init__(self, noise: float, rate: float = EMPTY_RATE, step: int = 0) -> None:
        self.noise, self.patience = noise, round(EMPTY_STEPS * max(1.0, EMPTY_RATE / rate))
        self.residual, self.empty = 0.0, 0.0  # running mean squares, of the field and of the ambient field
        self.lowest, self.step, self.since = 1.0, step, 0

    def update(self, residual: float, empty: float, step: int) -> None:
        """Add the mean squares of a step; a step without signal (empty = 0) does not count."""
        steps = max(1, step - self.step)
        self.step = step
        if empty > 0:
            memory = MEMORY**steps
            self.residual = memory * self.residual + (1 - memory) * residual
            self.empty = memory * self.empty + (1 - memory) * empty
            self.since += steps
            if self.since >= MIN_STEPS:
                self.lowest = min(self.lowest, self.unexplained)

    @property
    def unexplained(self) -> float:
        """Share of the squared signal that is neither explained nor noise; 0 without a signal."""
        if not self.empty or self.noise >= EMPTY:
            return 0.0
        return max(0.0, (self.residual / self.empty - self.noise) / (1 - self.noise))

    @property
    def healthy(self) -> bool:
        """Whether the fit is nearly as good as it has been."""
        return self.since < MIN_STEPS or self.unexplained < self.lowest + LOSS

    @property
    def has_fitted(self) -> bool:
        """Whether the field has ever explained most of the signal."""
        return self.lowest < HALF / 2

    def collapsed(self, final: bool) -> bool:
        """Return whether the field has stayed or become ambient; at the end (`final`) fewer steps are enough."""
        if self.has_fitted:
            return self.since >= MIN_STEPS and self.unexplained > HALF
        return self.since >= (MIN_STEPS if final else self.patience) and self.unexplained > EMPTY

    def remark(self, converged: bool) -> str:
        """Return a remark on a poor fit at the end of a run, or nothing."""
        if self.since < MIN_STEPS:
            return ""
        if self.unexplained > HALF:
            return f"; {self.unexplained:.0%} of the squared signal without noise is not explained yet"
        # rms over sigma; 0 if sigma is unknown
        sigmas = math.sqrt(self.residual / self.empty / self.noise) if self.noise and self.empty else 0.0
        if sigmas > HIGH_RESIDUAL:
            remedy = "a larger --network.width" if converged else "a longer run"
            return (
                f"; the residual is {sigmas:.1f} sigma: {remedy} lowers it, more views the error, "
                "unless cameras or sigma are wrong (nerif check)"
            )
        return ""
