"""How the frames of a sequence are reconstructed, and what every worker has to know, wherever it runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import QUANTITIES, quantities_of
from nerif.physics.quantities import GasSettings
from nerif.reconstruction.neural.neural import NeRIF

__all__ = ["Event", "SequencePlan", "SequenceSettings"]

WARM_UP = 10  # steps over which the learning rate rises from weights that are good already

Event = Callable[[dict[str, object]], None]
"""Told {"frame", "what": "begun" | "done" | "failed", ...} as a frame goes along."""

LEAST = {"chunk": 1, "warm_steps": 1, "voxels": 1}


@dataclass(frozen=True)
class SequenceSettings:
    """How the frames of a sequence are reconstructed, beside the settings of the network; kept in the store."""

    chunk: int = 32
    """Frames of a chunk of time; the first of each starts from nothing."""
    warm_steps: int = 300
    """Steps of a frame that starts from the one before."""
    warm_rate: float = 0.7
    """Share of the learning rate such a frame begins with."""
    withhold: tuple[str, ...] = ()
    """Views kept out of the reconstruction, and compared with it."""
    voxels: int = 100
    """Voxels of the volumes along the longest edge of the box."""
    quantities: tuple[str, ...] = ()
    """Written of every frame: of an index index_excess, n, density, temperature; none for the field, and density."""
    gas: GasSettings = field(default_factory=GasSettings)
    """What density and temperature are computed for."""

    def for_measurement(self, measurement: Measurement) -> SequenceSettings:
        """Return the settings with what follows from a measurement: quantities that are not given, and the gas.

        Raises
        ------
        InputError
            If a quantity does not follow from what was measured.
        """
        known = quantities_of(measurement.quantity)
        for quantity in self.quantities:
            if quantity not in known:
                names = " and ".join(kind.name for kind in measurement.techniques)
                raise InputError(
                    f"expected some of {', '.join(known)} for {names}, got '{quantity}'", field="quantities"
                )
        written = self.quantities or tuple(q for q in known if q in (measurement.quantity, "density"))
        return replace(self, quantities=written, gas=self.gas.for_measurement(measurement))

    def __post_init__(self) -> None:
        for name in ("withhold", "quantities"):
            if isinstance(getattr(self, name), str):
                raise InputError(f"expected a tuple of names, got the text '{getattr(self, name)}'", field=name)
        if not self.warm_rate > 0:
            raise InputError(f"expected a share above 0, got {self.warm_rate}", field="warm_rate")
        for name, least in LEAST.items():
            if getattr(self, name) < least:
                raise InputError(f"expected {least} or more, got {getattr(self, name)}", field=name)
        for quantity in self.quantities:
            if quantity not in QUANTITIES:
                raise InputError(f"expected some of {', '.join(QUANTITIES)}, got '{quantity}'", field="quantities")


@dataclass(frozen=True)
class SequencePlan:
    """Which recording is reconstructed into which store, and how.

    Parameters
    ----------
    measurement, out : stores
    cold : settings of the method as they were asked
    settings : of the sequence
    threads : of a worker on a CPU; 0 for its share of the cores
    """

    measurement: Path
    out: Path
    cold: NeRIF
    settings: SequenceSettings = field(default_factory=SequenceSettings)
    threads: int = 0

    @property
    def first(self) -> NeRIF:
        """Settings of a frame that starts from nothing, repeatable: no clock ends it."""
        return replace(self.cold, longest=math.inf)

    @property
    def warm(self) -> NeRIF:
        """Settings of a frame that starts from the one before: fewer steps, at a share of the learning rate."""
        asked, warm_up = self.settings, min(self.cold.warm_up, WARM_UP)
        return replace(self.cold, max_steps=asked.warm_steps, rate_after_fit=asked.warm_rate, warm_up=warm_up)

    @property
    def kept(self) -> dict[str, Any]:
        """What the store keeps of it, JSON; none of it may change before the store is complete."""
        return {"measurement": str(self.measurement), **asdict(self.settings), "settings": asdict(self.cold)}
