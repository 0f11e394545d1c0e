"""A voxel method: its settings, and the loop over grids and iterations (descent.py)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from annotated_types import Ge, Lt

from nerif.reconstruction.voxels.voxel_settings import VoxelSettings

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement
    from nerif.fields.field import Field
    from nerif.reconstruction.reconstructor import OnStep, Reconstruction, State

__all__ = ["VoxelReconstructor", "WeightedVoxelReconstructor"]


@dataclass(frozen=True)
class VoxelReconstructor(VoxelSettings):
    """A method that solves for the coefficients of a grid."""

    def __call__(
        self, measurement: Measurement, on_step: OnStep | None = None, resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:  # fmt: skip
        from nerif.reconstruction.voxels.descent import VoxelRun

        return VoxelRun(self, measurement, on_step, resume, start)()


@dataclass(frozen=True)
class WeightedVoxelReconstructor(VoxelReconstructor):
    """Settings of the methods with a penalty."""

    coarse: ClassVar[float] = 10
    regularisation: Literal["auto"] | Annotated[float, Ge(0), Lt(math.inf)] = "auto"
    """Regularisation weight, or auto (discrepancy principle where sigma is known, else L-curve)."""

    @property
    def weight(self) -> float | None:
        return None if self.regularisation == "auto" else float(self.regularisation)
