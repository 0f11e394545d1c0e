"""The axis of a symmetric flow, as it was found near the one named."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from nerif.geometry.symmetry import Symmetry

__all__ = ["NAMES", "Axis"]

TOLD = 0.5  # of a standard deviation beforehand, below which the data tell a number
NAMES = ("shift_1", "shift_2", "lean_1", "lean_2")
"""Shifts (mm) along e1 and e2 of the frame, leans (rad) towards them."""


@dataclass(frozen=True)
class Axis:
    """An axis that was found.

    Parameters
    ----------
    symmetry : about it
    values, sigma, sigma_after : of NAMES, against the axis as named; sigma 0 for what was held
    residual : rms over sigma of what the coarse field leaves (over the rms measured, where sigma is not known)
    """

    symmetry: Symmetry
    values: tuple[float, ...]
    sigma: tuple[float, ...]
    sigma_after: tuple[float, ...]
    residual: float

    @property
    def told(self) -> tuple[bool, ...]:
        """Whether the data tell each of the numbers."""
        return tuple(b > 0 and a < TOLD * b for a, b in zip(self.sigma_after, self.sigma, strict=True))

    @property
    def record(self) -> dict[str, Any]:
        """What the metrics of a result hold of it."""
        named = {
            "values": dict(zip(NAMES, self.values, strict=True)),
            "sigma": dict(zip(NAMES, self.sigma, strict=True)),
            "sigma_after": dict(zip(NAMES, self.sigma_after, strict=True)),
            "told": dict(zip(NAMES, self.told, strict=True)),
        }
        return {"symmetry": asdict(self.symmetry), **named}

    @property
    def sentences(self) -> list[str]:
        """What to say of it."""
        x, y, z = self.symmetry.point
        if not self.symmetry.axial:
            along = ", ".join(f"{v:.2f}" for v in self.symmetry.direction)
            return [f"planar: alike along ({along})"]
        found = []
        for i, unit in enumerate(("mm", "mm", "deg", "deg")):
            if not self.sigma[i]:
                continue
            factor = 1.0 if unit == "mm" else math.degrees(1.0)
            kind = ("shifted by", "leaning by")[i // 2]
            e = self.symmetry.frame[i % 2]
            toward = "(" + ", ".join(f"{v:.2f}" for v in e) + ")"
            if self.told[i]:
                found.append(
                    f"{kind} {self.values[i] * factor:+.3g} +- {self.sigma_after[i] * factor:.2g} {unit} to {toward}"
                )
            else:
                found.append(f"what the views do not tell is as given: {kind.split()[0]} to {toward}")
        return [f"axis: through ({x:.3f}, {y:.3f}, {z:.3f}) mm", *found]
