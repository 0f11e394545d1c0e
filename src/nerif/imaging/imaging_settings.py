"""Settings of a measurement from images: the displacements, the flow mask, and the gas around the flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Lt

from nerif.common.conventions import AMBIENT_INDEX, DEFAULT_AMBIENT_FACES
from nerif.common.settings import Checked, Natural, NonNegative, Positive

__all__ = ["DisplacementSettings", "MaskSettings", "Surroundings"]

REACH = {"deepflow": 1.5, "dis": 1.5, "tvl1": 1.3, "ilk": 1.6, "correlation": 1.8}
"""Standard deviation (px) of the averaging window of each method at smoothness 1 (benchmarks/displacement.py)."""


@dataclass(frozen=True)
class DisplacementSettings(Checked):
    """Settings of the displacement measurement."""

    method: Literal[*REACH] = "correlation"  # type: ignore[valid-type]
    """correlation (windows of 12 px x smoothness; best on dots), dis (fast, good on noise), deepflow (the paper's),
    ilk, tvl1."""
    smoothness: Positive = 1.0
    """Above 1 for smoother displacements; scales window or regularisation (fixed for deepflow)."""
    local_contrast: Natural = 0
    """Window (px) over which brightness and contrast are equalised; 0 matches them over the whole image only."""
    shake_border: Natural = 0
    """Width (px) of the flow-free border to which shift, rotation and zoom are fitted and removed; 0 for none."""
    max_sigma: Positive = 0.5
    """Pixels with more noise than this are not valid, px."""
    min_correlation: Annotated[float, Ge(-1), Lt(1)] = 0.5
    """Pixels with a lower local correlation of flow image and warped reference are not valid."""

    @property
    def reach(self) -> float:
        """Standard deviation of the averaging window of the method, px."""
        return REACH[self.method] * (1.0 if self.method == "deepflow" else self.smoothness)


@dataclass(frozen=True)
class MaskSettings(Checked):
    """Settings of a flow mask by threshold."""

    threshold: NonNegative = 4.0
    """Flow is where the measured quantity (of displacements |d|) exceeds this multiple of sigma."""
    smooth: NonNegative = 1.5
    """Standard deviation of a Gaussian over the values / sigma before the threshold, px."""
    smallest: Natural = 64
    """Islands and holes of fewer pixels are removed."""
    grow: Natural = 3
    """Pixels added all around, so that the mask includes the edge of the flow."""


@dataclass(frozen=True)
class Surroundings:
    """The gas around the flow, and the light."""

    n_ambient: float = AMBIENT_INDEX
    """Refractive index around the flow."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES
    """Faces of the box on which the index is ambient."""
