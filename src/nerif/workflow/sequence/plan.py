"""Settings of a sequence, and the inputs of every worker."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerif.common.conventions import InputError
from nerif.common.settings import Count, Positive
from nerif.data.quantity_names import INDEX, QUANTITIES
from nerif.physics.media import MEDIA, MediumSettings
from nerif.reconstruction.neural.neural import NeRIF
from nerif.workflow.run_settings import NONE

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["Event", "SequencePlan", "SequenceSettings"]

MAX_WARM_UP = 10  # steps over which the learning rate rises in a warm start

Event = Callable[[dict[str, object]], None]  #: called with {"frame", "what": "begun" | "done" | "failed", ...}


@dataclass(frozen=True)
class SequenceSettings(MediumSettings):
    """Settings of a sequence in addition to those of the network; stored with the result."""

    chunk: Count = 32
    """Frames per chunk of time; the first frame of each starts without an initial field."""
    warm_steps: Count = 300
    """Steps of a frame that starts from the previous one."""
    warm_rate: Positive = 0.7
    """Initial learning rate of such a frame, relative to the full one."""
    withhold: tuple[str, ...] = ()
    """Withheld views, compared with the reconstruction (default, or none: no view)."""
    voxels: Count = 100
    """Voxels of the volumes along the longest edge of the box."""
    quantities: tuple[str, ...] = ()
    """Volumes to write; of an index index_excess, n, and those of the medium, such as density (default: the field, and
    the first of the medium)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.withhold == NONE:
            object.__setattr__(self, "withhold", ())
        for quantity in self.quantities:
            if quantity not in QUANTITIES:
                raise InputError(f"expected some of {', '.join(QUANTITIES)}, got '{quantity}'", field="quantities")

    def for_measurement(self, measurement: Measurement) -> SequenceSettings:
        """Return the settings with the quantities and the medium of a measurement."""
        medium = self.substance.for_measurement(measurement)
        available = medium.available(measurement.quantity)
        other = medium.not_around(measurement.n_ambient) if measurement.quantity == INDEX else ""
        for quantity in self.quantities:
            if quantity not in available:
                names = " and ".join(kind.name for kind in measurement.techniques)
                raise InputError(
                    f"expected some of {', '.join(available)} for {names}, got '{quantity}'", field="quantities"
                )
            if other and quantity in medium.names:
                raise InputError(f"expected index_excess or n, got {quantity}: {other}", field="quantities")
        derived = [q for q in available if q in medium.names and not other]
        default = (measurement.quantity, *derived[:1])
        return replace(self.with_substance(medium), quantities=self.quantities or default)


@dataclass(frozen=True)
class SequencePlan:
    """The reconstruction of a recording into a store."""

    measurement: Path  #: store
    out: Path  #: store
    cold: NeRIF  #: settings of the method
    settings: SequenceSettings = field(default_factory=SequenceSettings)  #: of the sequence
    threads: int = 0  #: of a worker on a CPU; 0: its share of the cores

    @property
    def warm(self) -> NeRIF:
        """Settings of a frame that starts from the previous one."""
        steps, rate, warm_up = self.settings.warm_steps, self.settings.warm_rate, min(self.cold.warm_up, MAX_WARM_UP)
        return replace(self.cold, max_steps=steps, rate_after_fit=rate, warm_up=warm_up)

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the store, JSON; they must not change before the store is complete."""
        entries = {k: v for k, v in asdict(self.settings).items() if k not in MEDIA} | self.settings.medium_entries
        return {"measurement": str(self.measurement), **entries, "settings": asdict(self.cold)}
