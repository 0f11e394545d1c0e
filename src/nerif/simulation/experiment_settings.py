"""Settings of a rendered experiment, and its sensor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import numpy as np
from annotated_types import Ge, Le

from nerif.common.settings import Checked, NonNegative, Positive

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

__all__ = ["ExperimentSettings", "Sensor"]


@dataclass(frozen=True)
class Sensor(Checked):
    """A sensor: photons to counts."""

    bits: Annotated[int, Ge(8), Le(16)] = 12
    """Bits of the counts, 8 to 16."""
    exposure: Positive = 0.8
    """Share of full scale of white paper."""
    full_well: NonNegative = 10000.0
    """Electrons at full scale, which determine the shot noise (0: none)."""
    read_noise: NonNegative = 10.0
    """Standard deviation of the read noise, electrons."""

    def expose(self, light: Float[Tensor, "row column"], seed: int) -> np.ndarray:
        """Return counts of light from 0 (black) to 1 (white paper): shot noise, read noise, rounding, saturation."""
        rng = np.random.default_rng(seed)
        share = self.exposure * light.clamp_min(0).numpy()
        if self.full_well > 0:
            electrons = rng.poisson(share * self.full_well) + self.read_noise * rng.standard_normal(share.shape)
            share = electrons / self.full_well
        counts = np.clip(np.round(share * (2**self.bits - 1)), 0, 2**self.bits - 1)
        return counts.astype(np.uint8 if self.bits == 8 else np.uint16)


@dataclass(frozen=True)
class ExperimentSettings:
    """Settings of the images."""

    kind: str = "dots"
    """Background: dots, wavelet or multiscale."""
    dot: float = 3.0
    """Size of a dot in the image, px."""
    references: int = 5
    """Images without flow."""
    sensor: Sensor = field(default_factory=Sensor)
    samples: int = 3
    """Points along each edge of a pixel."""
    target: str = "chessboard"
    """Calibration target: chessboard, charuco or circles."""
    columns: int = 10
    """Squares (dots of circles) of the target along a row."""
    rows: int = 7
    """Squares along a column."""
    pitch: float = 0.0
    """Edge of a square, mm; 0 fills about 60 % of the image at the origin."""
    poses: int = 30
    """Poses of the target free in space; 0 for no calibration images."""
    backgrounds: int = 5
    """Images of the target on each background."""
    seed: int = 0
    """Seed of patterns, poses and noise."""
