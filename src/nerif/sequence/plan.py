"""What every worker of a sequence has to know, wherever it runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from nerif.physics.quantities import GasSettings
from nerif.reconstruction.neural import NeRIF

__all__ = ["Event", "SequencePlan", "warm"]

WARM_UP = 10  # steps over which the learning rate rises from weights that are good already

Event = Callable[[dict[str, object]], None]
"""Told {"frame", "what": "begun" | "share" | "done" | "failed", ...} as a frame goes along."""


@dataclass(frozen=True)
class SequencePlan:
    """Which recording is reconstructed into which store, and how.

    Parameters
    ----------
    measurement, out : stores
    cold : settings of a frame that starts from nothing
    warm : settings of a frame that starts from the one before
    voxels : of the volumes, along the longest edge
    quantities : written
    gas : what density and temperature are computed for
    hold_out : views kept out
    threads : of a worker on a CPU; 0 for its share of the cores
    joint_steps : of training for each frame of a network over space and time; 0 for a network for each frame
    time_octaves : of the encoding of time in it
    """

    measurement: Path
    out: Path
    cold: NeRIF
    warm: NeRIF
    voxels: int = 100
    quantities: tuple[str, ...] = ("index_excess",)
    gas: GasSettings = field(default_factory=GasSettings)
    hold_out: tuple[str, ...] = ()
    threads: int = 0
    joint_steps: int = 0
    time_octaves: int = 3


def warm(cold: NeRIF, steps: int, rate: float) -> NeRIF:
    """Return the settings of a frame that starts from the one before: fewer steps, at a share of the learning rate."""
    return replace(cold, max_steps=steps, rate_after_fit=rate, warm_up=min(cold.warm_up, WARM_UP))
