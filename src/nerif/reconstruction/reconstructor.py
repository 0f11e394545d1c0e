"""The interface of reconstruction methods.

A Reconstructor is an immutable record of settings; called with a Measurement it returns a Reconstruction.
"""

from __future__ import annotations

import dataclasses
import inspect
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from nerif.common.conventions import InputError

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure
    from torch import Tensor

    from nerif.data.measurement import Measurement
    from nerif.data.volume import Volume
    from nerif.fields.field import Field
    from nerif.geometry import Box, Grid
    from nerif.geometry.body import Body
    from nerif.geometry.symmetry import Axis
    from nerif.reconstruction.rig_parameters import RefinedView

__all__ = [
    "END", "VOXELS", "OnStep", "Outcome", "Reconstruction", "Reconstructor", "State", "Step", "compose", "sampled",
]  # fmt: skip

VOXELS = 100  # of a volume along the longest edge
NOTEBOOK_VOXELS = 48  # along the longest edge
MISFITS = {  # columns of a history, the most informative first
    "residual_over_sigma": "times the noise, rms over the fitted views",
    "residual": "rms over the fitted views, relative to the ambient field",
    "loss": "loss, relative to the ambient field",
}


END = {
    "converged": "converged", "discrepancy": "residual as large as the noise", "epochs": "all epochs done",
    "steps": "all steps done", "iterations": "all iterations done", "time_limit": "time limit reached",
    "interrupted": "interrupted", "diverged": "diverged", "collapsed": "no field found",
}  # fmt: skip
"""Reasons why a reconstruction stopped, in words."""
FAILED = ("diverged", "collapsed")


@dataclass(frozen=True)
class Outcome:
    """Why a reconstruction stopped: a reason (one of END), and a sentence with the remedy if there is one."""

    reason: str
    message: str

    @property
    def failed(self) -> bool:
        """Whether there is no useful field."""
        return self.reason in FAILED

    @property
    def sentence(self) -> str:
        """The message, after the reason in words unless the message has it."""
        return f"{END[self.reason]}: {self.message}" if self.reason in ("converged", *FAILED) else self.message


@dataclass(frozen=True)
class State:
    """The state from which a run can be resumed: tensors by name, and plain numbers and texts."""

    tensors: dict[str, Tensor]
    scalars: dict[str, Any]

    def under(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors whose names begin with a prefix, by the rest of their names."""
        return {name.removeprefix(prefix): value for name, value in self.tensors.items() if name.startswith(prefix)}


@dataclass(frozen=True)
class Step:
    """The progress of a method after a step."""

    step: int  #: number done
    epoch: float  #: passes over all rays
    seconds: float  #: time of the run, earlier parts of a resumed one included
    progress: float  #: from 0 at the start to 1 at the end; of a run that ends by convergence, at the next possible end
    losses: dict[str, float]  #: the terms by name
    rays_per_second: float
    capture: Callable[[], State]  #: returns the State to resume from
    field: Callable[[], Field]  #: returns the present Field, valid until the method continues
    note: str = ""  #: a line for the user on a change before this step, or ""
    pass_steps: float = 1.0  #: average steps per pass over all pixels, of a training
    rig: Callable[[], list[RefinedView]] = list
    """Returns the present corrections of the cameras (refinement.py); none if they are not refined."""


OnStep = Callable[[Step], bool | None]
"""Called after each step; returns True to stop the method, which then returns its present result."""


def compose(*callbacks: OnStep) -> OnStep:
    """Return a callback that calls all others in turn and requests a stop if one of them does."""
    return lambda step: any([bool(callback(step)) for callback in callbacks])  # noqa: C419 (a generator would skip some)


@dataclass(frozen=True, repr=False)
class Reconstruction:
    """The result of a reconstruction."""

    field: Field
    box: Box  #: of the field, mm
    n_ambient: float  #: refractive index from which an excess is counted
    history: list[dict[str, float]]  #: one record per logged step
    outcome: Outcome
    settings: dict[str, Any]  #: of the method, as plain values
    seconds: float = 0.0  #: time of the run
    peak_memory_bytes: int = 0  #: on the device (CUDA) or of the process (CPU)
    device: str = "cpu"
    state: State | None = dataclasses.field(default=None, repr=False)  #: to resume from, or None
    quantity: str = "index_excess"  #: of the field (volume.QUANTITIES)
    rig: list[RefinedView] = dataclasses.field(default_factory=list)  #: corrections of each view (refinement.py)
    axis: Axis | None = None  #: of a symmetric flow, as estimated (symmetry.py); None without symmetry
    bodies: tuple[Body, ...] = ()  #: in the flow; within them the field has no meaning, and volumes are NaN

    @property
    def model(self) -> str:
        """Name of the forward model."""
        return str(self.settings["model"])

    def volume(self, grid: Grid | int = VOXELS) -> Volume:
        """Return the field at the voxel centres of a grid, or of one with that many along the longest edge.

        Voxels whose centre is within a body are NaN.
        """
        from nerif.geometry import Grid

        grid = grid if isinstance(grid, Grid) else Grid.of_resolution(self.box, grid)
        if not self.box.holds(grid.box):
            raise InputError(
                f"expected a part of the box {self.box.lower} to {self.box.upper} mm, got {grid.box.lower} to "
                f"{grid.box.upper}", field="grid",
            )  # fmt: skip
        return sampled(self.field, grid, self.quantity, self.n_ambient, self.bodies, self.device)

    def to_xarray(self, grid: Grid | int = VOXELS) -> xr.DataArray:
        """Return the volume on a grid with coordinates x, y, z in mm, unit and attributes."""
        return self.volume(grid).to_xarray()

    def plot(self, grid: Grid | int = VOXELS) -> Figure:
        """Return a figure of the three middle slices."""
        return self.volume(grid).plot()

    def write(self, path: str | os.PathLike[str], grid: Grid | int = VOXELS, force: bool = False) -> None:
        """Write the volume in the format of the ending of a file (.vti, .nc, .npz, .mat, .csv, .dat)."""
        self.volume(grid).write(path, force)

    def __repr__(self) -> str:
        from nerif.data.quantity_names import name_of

        x, y, z = self.box.edges
        about = f"{name_of(self.quantity)} in {x:g} x {y:g} x {z:g} mm by a {type(self.field).__name__}"
        return f"<Reconstruction of {about}; {self.outcome.reason} after {self.seconds:.1f} s on {self.device}>"

    def _repr_html_(self) -> str:
        """Notebook display: the three middle slices, outcome, time and misfit."""
        from nerif.data.quantity_names import describe
        from nerif.plotting.notebook import number, panel, show_slices

        volume = self.volume(NOTEBOOK_VOXELS)
        rows = [("Why it ended", self.outcome.sentence)]
        rows.append(("Time", f"{self.seconds:.0f} s on {self.device}"))
        last = self.history[-1] if self.history else {}
        misfits = [("Misfit", f"{number(last[name], 3)} {text}") for name, text in MISFITS.items() if name in last]
        image = show_slices(volume)
        caption = f"{describe(self.quantity)[1].capitalize()} in the three middle slices"
        return panel("Reconstruction", rows + misfits[:1] + volume.summary(), (image, caption))


def sampled(
    field: Field, grid: Grid, quantity: str, n_ambient: float, bodies: Sequence[Body] = (), device: str = "cpu"
) -> Volume:
    """Return a field at the voxel centres of a grid, NaN within bodies."""
    from nerif.data.volume import Volume
    from nerif.geometry.body import contained

    volume = Volume.of(field.sample(grid, device), grid, quantity, n_ambient)
    return volume.masked(contained(bodies, grid.points()), "within a body") if bodies else volume


class Reconstructor(ABC):
    """A reconstruction method: an immutable record of settings, called with the data.

    Invalid settings raise InputError when the record is made.
    """

    title: ClassVar[str]  # as printed
    aperture: str  # whether pixels have an aperture (aperture.py)
    source: str  # images, displacements or both (sources.py)
    detailed: ClassVar[bool] = False  # detail is added to its field (detail.py) where that pays

    @classmethod
    def about(cls) -> str:
        """Return the first line of the description of the method."""
        return (inspect.getdoc(cls) or cls.title).splitlines()[0]

    @abstractmethod
    def __call__(
        self, measurement: Measurement, on_step: OnStep | None = None, resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:  # fmt: skip
        """Reconstruct the field of a measurement.

        A run that is stopped by a limit, the callback or a failure returns its best field; the outcome has the reason.

        Parameters
        ----------
        measurement : its usable pixels whose rays cross the box are fitted, weighted by sigma if that is known
        on_step : called after each step or iteration (on a GPU: after some of them); returns True to stop the run
        resume : State of an earlier run of the same method, settings and data, to be continued; limits (time, steps,
            iterations) may be raised
        start : Field to start from, in the box of the measurement; None for the ambient index. Without effect when
            resuming

        Raises
        ------
        InputError
            If nothing fixes the ambient index, no ray is left, the device does not exist or has too little memory, or
            `resume` is of another method, other settings or other data.
        """

    def resolved(self, measurement: Measurement) -> tuple[Reconstructor, str]:
        """Return the settings within what a measurement resolves, and a line on what that changed, or nothing."""
        return self, ""

    @abstractmethod
    def split_for_cross_validation(self) -> tuple[Reconstructor, Reconstructor]:
        """Return settings of the cross-validation run, and of a main run that starts from it, within the limits."""
