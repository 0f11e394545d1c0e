"""What every reconstruction method takes and gives back.

A Reconstructor is a frozen record of settings; called with a Measurement it returns a Reconstruction.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from nerif.data.measurement import Measurement
from nerif.data.volume import Volume, describe
from nerif.fields.base import Field
from nerif.geometry import Box, Grid
from nerif.geometry.symmetry import Axis

__all__ = ["OnStep", "Outcome", "Reconstruction", "Reconstructor", "State", "Step", "compose"]

SHOWN_VOXELS = 48  # along the longest edge, in a notebook

MISFITS = {
    "residual_over_sigma": "times the noise, rms over the training views",
    "residual": "rms over the training views, where the ambient field has 1",
    "loss": "in the loss, where the ambient field has 1",
}
"""Names in a history, the most telling first, and what they say."""


@dataclass(frozen=True)
class Outcome:
    """Why a reconstruction stopped.

    Parameters
    ----------
    reason : one word: converged, discrepancy, epochs, steps, iterations, time_limit, interrupted, diverged or
        collapsed (the field explains nothing of what was measured)
    message : one sentence, with the remedy where there is one
    """

    reason: str
    message: str

    @property
    def failed(self) -> bool:
        """Whether no field was found."""
        return self.reason in ("diverged", "collapsed")


@dataclass(frozen=True)
class State:
    """Everything needed to go on with a run: tensors by name, and plain numbers and texts."""

    tensors: dict[str, Tensor]
    scalars: dict[str, Any]

    def under(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors whose names begin with a prefix, by what follows it."""
        return {name.removeprefix(prefix): value for name, value in self.tensors.items() if name.startswith(prefix)}


@dataclass(frozen=True)
class Step:
    """What a method tells of itself after a step.

    Parameters
    ----------
    step, epoch : counts; epoch in passes over all rays
    seconds : spent so far, earlier runs included
    progress : 0 at the start, 1 at the end; of a run that may end early, 1 at the latest end
    losses : the terms by name
    rays_per_second : 1/s
    capture : gives the State to resume from
    field : gives the Field as it is now, to be looked at before the method goes on
    note : a line for the user on what changed before this step; nothing where nothing did
    pass_steps : steps that a pass over all pixels takes on average, of a training
    """

    step: int
    epoch: float
    seconds: float
    progress: float
    losses: dict[str, float]
    rays_per_second: float
    capture: Callable[[], State]
    field: Callable[[], Field]
    note: str = ""
    pass_steps: float = 1.0


OnStep = Callable[[Step], bool | None]
"""Called after each step; True asks the method to stop and return what it has."""


def compose(*callbacks: OnStep) -> OnStep:
    """Return a callback that calls each in turn and asks to stop if one of them does."""

    def call(step: Step) -> bool:
        asked = [bool(c(step)) for c in callbacks]  # each is called, also after one has asked to stop
        return any(asked)

    return call


@dataclass(frozen=True)
class Reconstruction:
    """The result of a reconstruction.

    Parameters
    ----------
    field : Field of the quantity
    box : where it holds, mm
    n_ambient : refractive index that an excess is counted from
    quantity : what the field is (volume.QUANTITIES)
    history : one record a logged step
    outcome : why it stopped
    settings : what the method was asked, as plain values
    seconds : spent
    peak_memory_bytes : on the device (CUDA) or of the process (CPU)
    device : where it ran
    state : to resume from, or None
    rig : what was refined of each view (refinement.py)
    axis : of a symmetric flow, as it was found (symmetry.py); None where no symmetry was asked for
    """

    field: Field
    box: Box
    n_ambient: float
    history: list[dict[str, float]]
    outcome: Outcome
    settings: dict[str, Any]
    seconds: float = 0.0
    peak_memory_bytes: int = 0
    device: str = "cpu"
    state: State | None = dataclasses.field(default=None, repr=False)
    quantity: str = "index_excess"
    rig: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    axis: Axis | None = None

    @property
    def model(self) -> str:
        """Forward model by which the field was found."""
        return str(self.settings["model"])

    def volume(self, grid: Grid) -> Volume:
        """Return the field at the voxel centres of a grid."""
        return Volume.of(self.field.sample(grid, self.device), grid, self.quantity, self.n_ambient)

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the three middle slices, why it stopped, how long it took, and the misfit."""
        from nerif.plotting.notebook import number, panel, show_slices

        volume = self.volume(Grid.of_resolution(self.box, SHOWN_VOXELS))
        rows = [("Outcome", f"{self.outcome.reason.replace('_', ' ')}: {self.outcome.message}")]
        rows.append(("Time", f"{self.seconds:.0f} s on {self.device}"))
        last = self.history[-1] if self.history else {}
        for name, meaning in MISFITS.items():
            if name in last:
                rows.append(("Misfit", f"{number(last[name], 3)} {meaning}"))
                break
        image = show_slices(volume)
        caption = f"{describe(self.quantity)[1].capitalize()} in the three middle slices"
        return panel("Reconstruction", rows + volume.summary(), (image, caption))


class Reconstructor(ABC):
    """A method of reconstruction: a frozen record of its settings, called with the data.

    A record can be kept, compared and called again; a call leaves it as it is. Settings that cannot be right are
    refused when the record is made.
    """

    aperture: str
    """Whether pixels see through the whole of their lens (aperture.py)."""
    source: str
    """Whether it goes by images, displacements or both (sources.py)."""

    @abstractmethod
    def __call__(
        self,
        measurement: Measurement,
        on_step: OnStep | None = None,
        resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:
        """Reconstruct the field of a measurement: from nothing, from an earlier State, or from another field.

        A run that a limit, the callback or a failure stops returns the best field it has, and says why in its outcome.

        Parameters
        ----------
        measurement : Measurement; usable pixels whose rays cross the box are to be met, weighed by sigma if it is known
        on_step : called after each step or iteration (on a GPU: after some of them) with a Step; None for no callback.
            Where it returns True the run stops with outcome "interrupted"
        resume : State of an earlier run of the same method and settings on the same data, to go on as if it had not
            stopped; limits (time, steps, iterations) may be raised. None to begin anew
        start : Field to begin from, in the box of the measurement and on any device; None for the ambient index.
            Without effect when resuming

        Returns
        -------
        Reconstruction
            Field, history, outcome, and the State to resume from.

        Raises
        ------
        InputError
            If nothing in the measurement fixes the ambient index, no ray is left, the device does not exist or has too
            little memory, or `resume` is of another method, other settings or other data.
        """

    @abstractmethod
    def in_two(self) -> tuple[Reconstructor, Reconstructor]:
        """Return settings of a short run, and of one within the limits asked for that goes on from what that finds."""
