"""Scale of a slider: whole steps and their values, logarithmic if these span decades."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["Scale"]

STEPS = 400
DECADES = 1.3  # from this range on a scale is logarithmic
DIGITS = 3


@dataclass(frozen=True)
class Scale:
    """Steps 0 to `last` between two values.

    Parameters
    ----------
    low, high : values of the ends
    whole : whether the values are whole numbers
    """

    low: float
    high: float
    whole: bool = False

    @property
    def last(self) -> int:
        """The highest step."""
        return round(self.high - self.low) if self.whole else STEPS

    @property
    def logarithmic(self) -> bool:
        """Whether the scale is logarithmic."""
        return not self.whole and self.low > 0 and math.log10(self.high / self.low) >= DECADES

    def value(self, step: int) -> float:
        """Return the value of a step, rounded."""
        if step in (0, self.last):
            return self.low if step == 0 else self.high
        share = step / self.last
        if self.logarithmic:
            return float(f"{self.low * (self.high / self.low) ** share:.{DIGITS}g}")
        return self.low + step if self.whole else float(f"{self.low + share * (self.high - self.low):.{DIGITS}g}")

    def step(self, value: float) -> int:
        """Return the step nearest to a value, which is clipped to the ends."""
        value = min(max(value, self.low), self.high)
        if self.logarithmic:
            return round(math.log(value / self.low) / math.log(self.high / self.low) * self.last)
        return round((value - self.low) / (self.high - self.low) * self.last)
