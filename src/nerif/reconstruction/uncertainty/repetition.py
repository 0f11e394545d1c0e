"""A reconstruction done again, to see how far off it may be: what every kind of repetition is given and gives."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.data.measurement import Measurement
from nerif.data.volume import Volume, describe
from nerif.fields.base import Field
from nerif.fields.grid import VoxelField
from nerif.geometry import Grid
from nerif.physics.quantities import GasSettings
from nerif.reconstruction.base import Reconstruction, Reconstructor

__all__ = ["VOXELS", "Found", "Maps", "Member", "Repetitions", "Taken", "certainty", "other_seed"]

VOXELS = 64

Maps = Mapping[str, Float[Tensor, "view row column c"]]
"""What views see, or its noise, by the name of the technique."""


@dataclass(frozen=True)
class Found:
    """What there is to repeat.

    Parameters
    ----------
    result : of the reconstruction
    reconstructor : settings it was made by
    measurement : that it was made from
    noise : gives the standard deviation of what was measured, pixel by pixel
    seen : gives what the views would see of a field, and of them those that are named
    """

    result: Reconstruction
    reconstructor: Reconstructor
    measurement: Measurement
    noise: Callable[[], Maps]
    seen: Callable[[Field], Maps]

    @cached_property
    def sampled(self) -> Volume:
        """The result on VOXELS voxels along the longest edge, on which errors are compared."""
        return self.result.volume(Grid.of_resolution(self.result.box, VOXELS))

    @cached_property
    def predicted(self) -> Maps:
        """What the views see of the result as it is sampled, by a spline through it."""
        return self.seen(VoxelField.through(self.sampled.values.double(), self.sampled.grid))


@dataclass(frozen=True)
class Member:
    """One repetition.

    Parameters
    ----------
    reconstructor : settings
    measurement : what it is reconstructed from
    left_out : views of the measurement that are not in it
    expected : what it would find if it made no error, where that is known
    about : what is particular to it, in words
    """

    reconstructor: Reconstructor
    measurement: Measurement
    left_out: tuple[str, ...] = ()
    expected: Volume | None = None
    about: str = ""


@runtime_checkable
class Taken(Protocol):
    """What becomes of the repetitions, taken in one by one."""

    @property
    def count(self) -> int:
        """How many were."""

    def add(self, member: Member, result: Reconstruction) -> None:
        """Take in what one more has found."""

    def volumes(self) -> list[Volume]:
        """Return what they tell of every quantity."""


@runtime_checkable
class Repetitions(Protocol):
    """A kind of repetitions, how many, and what each is reconstructed from."""

    @property
    def word(self) -> str:
        """What it is called, in metrics.json and to the user."""

    @property
    def members(self) -> int:
        """How many."""

    @property
    def fewest(self) -> int:
        """How many have to succeed."""

    @property
    def without_views(self) -> bool:
        """Whether some do without a view, which tells how well it is predicted."""

    def member(self, number: int, found: Found) -> Member:
        """Return one of them, from 1 on."""

    def taken(self, found: Found, main: Volume, gas: GasSettings) -> Taken:
        """Return what takes them in, beside the main result as it is written."""


def certainty(field: Volume, std: Volume) -> Volume:
    """Return how sure a field is, from 0 to 1: q^2 / (q^2 + std^2), 0 where there is nothing to be sure of.

    As the opacity of a volume it leaves out what is ambient and fades what is in doubt.

    Source: the gain of Wiener's filter, Extrapolation, Interpolation, and Smoothing of Stationary Time Series (1949).
    """
    signal, noise = field.values.double().square(), std.values.double().square()
    values = torch.where(signal + noise > 0, signal / (signal + noise), 0.0).nan_to_num(0.0)
    label = f"{field.quantity}_certainty"
    return Volume(values.float(), field.grid, label, *describe(label)[:1], field.attributes)


def other_seed(reconstructor: Reconstructor, number: int) -> Reconstructor:
    """Return settings with another seed, if they have one."""
    if not any(f.name == "seed" for f in dataclasses.fields(reconstructor)):  # type: ignore[arg-type]
        return reconstructor
    return replace(reconstructor, seed=getattr(reconstructor, "seed") + number)  # type: ignore[type-var]  # noqa: B009
