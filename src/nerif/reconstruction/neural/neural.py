"""NeRIF: a coordinate network trained to predict the measurement (paper, Alg. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from nerif.reconstruction.neural.training_settings import TrainingSettings

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement
    from nerif.fields.field import Field
    from nerif.reconstruction.reconstructor import OnStep, Reconstruction, State

__all__ = ["NeRIF"]


@dataclass(frozen=True)
class NeRIF(TrainingSettings):
    """Neural refractive index field."""

    title: ClassVar[str] = "NeRIF"
    detailed: ClassVar[bool] = True

    def __call__(
        self,
        measurement: Measurement,
        on_step: OnStep | None = None,
        resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:
        from nerif.reconstruction.neural.trainer import Trainer
        from nerif.reconstruction.neural.training_data import TrainingData

        return Trainer(self, TrainingData(self, measurement, withhold=not self.limited), resume, start).run(on_step)
