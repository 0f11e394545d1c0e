"""Bootstrap estimate of the error of a reconstruction: trials on a known field, the one that was found.

    std(x) = rho exp(C sqrt(1 - k^2)) (G * mean_j (q'_j - q)^2)^(1/2) (x)
    k^2 = <(q'_j - g * q'_j)^2> / <(q - g * q)^2>,    rho^2 = <(d - F q)^2> / <(d_j - F q'_j)^2>

Trial q'_j is a reconstruction of the field q that was found, from its projections in the same cameras. The residuals of
the reconstruction are added to them in blocks of random sign: noise of the right size and spatial correlation. The
error of q'_j is then a sample of the error of q.

q is smoother than the truth, and detail that the reconstruction cannot resolve is absent from q. How much is lost is
estimated from the share k^2 of the detail of q that the trials keep, with g as fine as the pixels. Where they keep all
of it the errors are those of noise; where they do not, q has lost more of the truth than the trials of q. C was fitted
to random flows (docs/decisions/055). If the reconstruction was trained longer than the trials, it fits its data d
better than they fit theirs, d_j, and its errors are smaller by rho.

A single error is noisy, so squares are averaged around each voxel by a Gaussian G of width WIDTH. No truth is used.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import mean

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume, describe
from nerif.fields.base import Field
from nerif.fields.grid import VoxelField
from nerif.geometry import Camera, Grid
from nerif.physics.quantities import GasSettings, derive, deviation
from nerif.reconstruction.base import Reconstruction, Reconstructor

__all__ = [
    "KINDS",
    "VOXELS",
    "Deviations",
    "Found",
    "Maps",
    "Member",
    "Trials",
    "best_covered",
    "certainty",
    "other_seed",
]

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
    seen : gives what the views would see of a field, and of them those that are named
    """

    result: Reconstruction
    reconstructor: Reconstructor
    measurement: Measurement
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
    expected : what it would find if it made no error
    about : what is particular to it, in words
    """

    reconstructor: Reconstructor
    measurement: Measurement
    expected: Volume
    about: str = ""


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


KINDS = {"off": 0, "fast": 2, "full": 8}
"""How many trials."""

WIDTH = 0.04  # of the box edge, standard deviation
DETAIL = 0.7  # px in the middle of the box, standard deviation of g
LOST = 1.9  # C
NONE = 1e-10  # of the squares of a field: less than that is rounding, and no detail
BLOCK = 8  # px, in which what is left unexplained keeps its sign
TAILS = {"p05": -1.645, "p95": 1.645}  # standard deviations at which percentiles lie


@dataclass(frozen=True)
class Trials:
    """Further reconstructions with known errors.

    Parameters
    ----------
    kind : one of KINDS
    """

    kind: str

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"expected one of {', '.join(KINDS)}, got '{self.kind}'", field="uncertainty")

    @property
    def members(self) -> int:
        """How many."""
        return KINDS[self.kind]

    def member(self, number: int, found: Found) -> Member:
        """Return a trial: of the field that was found, and what was left of the measurement with other signs."""
        drawn = torch.Generator().manual_seed(2_000_003 + number)
        reconstructor, about = other_seed(found.reconstructor, number), ", of a field that is known"
        return Member(reconstructor, _simulated(found, drawn), found.sampled, about)


def best_covered(cameras: Sequence[Camera]) -> list[str]:
    """Return the names of the views, first those that look most like two others: the others tell most of what they do.

    A view from opposite shows the same.
    """
    axes = torch.stack([camera.rotation[2].double() for camera in cameras])
    apart = torch.acos((axes @ axes.T).abs().clamp(max=1.0))
    apart.fill_diagonal_(math.inf)
    near = apart.sort(dim=1).values[:, : min(2, len(axes) - 1)].sum(dim=1) if len(axes) > 1 else torch.zeros(1)
    middle = (torch.arange(len(axes)) - (len(axes) - 1) / 2).abs()
    order = np.lexsort((middle.numpy(), near.numpy().round(6)))
    return [cameras[int(i)].name for i in order]


def _simulated(found: Found, drawn: torch.Generator) -> Measurement:
    """What would have been measured of the field that was found, with what was left unexplained of it."""
    maps = {}
    for o in found.measurement.observations:
        predicted = found.predicted[o.technique.name].to(o.values)
        maps[o.technique.name] = predicted + (o.values - predicted) * _signs(o.values, drawn)
    sigmas = {o.technique.name: o.sigma for o in found.measurement.observations}
    return found.measurement.observed(maps, sigmas)


def _signs(like: Float[Tensor, "view row column c"], drawn: torch.Generator) -> Float[Tensor, "view row column c"]:
    """1 or -1 by chance, the same in blocks of pixels."""
    views, height, width, channels = like.shape
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    coarse = torch.randint(0, 2, (views, rows, columns, channels), generator=drawn) * 2 - 1
    fine = coarse.repeat_interleave(BLOCK, dim=1).repeat_interleave(BLOCK, dim=2)
    return fine[:, :height, :width].to(like)


def _left(measurement: Measurement, seen: Maps) -> list[float]:
    """Mean square of what a field leaves unexplained of each technique, over sigma^2 where that is known."""
    squares = []
    for o in measurement.observations:
        used = measurement.usable_for(o) & measurement.sees_box
        left = (o.values - seen[o.technique.name].to(o.values))[used].double()
        if o.sigma is not None:
            left = left / o.sigma[used].double()
        squares.append(float(left.square().mean()))
    return squares


def _blurred(values: Tensor, grid: Grid, mm: float) -> Tensor:
    """The mean over a Gaussian of that standard deviation, at least a voxel."""
    from scipy.ndimage import gaussian_filter

    width = [max(1.0, mm / h) for h in grid.spacing[::-1]]  # voxels along z, y, x
    return torch.from_numpy(gaussian_filter(values.double().numpy(), width, mode="nearest"))


class Deviations:
    """Standard deviation of every quantity from the errors of trials.

    Parameters
    ----------
    main : (z, y, x) the field that was found, as it is written
    gas : what density and temperature are computed for
    found : what the trials are of
    """

    def __init__(self, main: Volume, gas: GasSettings, found: Found) -> None:
        self.main, self.gas, self.found = main, gas, found
        self.pixel = mean(found.measurement.pixel_sizes)  # mm, in the middle of the box
        self.squares: list[Tensor] = []
        self.detail: list[tuple[float, float]] = []
        """Mean squares of the detail that a trial has, and of that of the field it is of, where that has some."""
        self.left: list[float] = []
        """Mean squares of what trials leave unexplained, over those of the reconstruction."""
        self.grid: Grid | None = None

    @property
    def count(self) -> int:
        """How many errors are known."""
        return len(self.squares)

    def add(self, member: Member, result: Reconstruction) -> None:
        """Add the error of one more trial."""
        self.grid = member.expected.grid
        both = result.volume(self.grid).values.double(), member.expected.values.double()
        self.squares.append((both[0] - both[1]).square())
        fine = [float((v - _blurred(v, self.grid, DETAIL * self.pixel)).square().mean()) for v in both]
        if fine[1] > NONE * float(both[1].square().mean()):
            self.detail.append((fine[0], fine[1]))
        left = _left(member.measurement, self.found.seen(result.field))
        self.left += [j / q for j, q in zip(left, self._left_by_it, strict=True) if q > 0]

    @cached_property
    def _left_by_it(self) -> list[float]:
        return _left(self.found.measurement, self.found.seen(self.found.result.field))

    @property
    def lost(self) -> float:
        """The share of the squares of detail that trials have lost, 1 - k^2."""
        if not self.detail:
            return 0.0
        kept, there = (sum(squares) for squares in zip(*self.detail, strict=True))
        return max(1 - kept / there, 0.0)

    @property
    def better(self) -> float:
        """How much less the reconstruction leaves unexplained than trials do, rho."""
        return mean(self.left) ** -0.5 if self.left and mean(self.left) > 0 else 1.0

    def local(self) -> Float[Tensor, "z y x"]:
        """Return the rms error of the trials around each voxel of `grid`."""
        assert self.grid is not None
        edge = math.prod(self.grid.box.edges) ** (1 / 3)
        return _blurred(torch.stack(self.squares).mean(dim=0), self.grid, WIDTH * edge).sqrt()

    def std(self) -> Volume:
        """Return the standard deviation of the field."""
        assert self.grid is not None
        whole = self.better * math.exp(LOST * math.sqrt(self.lost)) * self.local()
        values = VoxelField.through(whole, self.grid).sample(self.main.grid).clamp(min=0)
        return Volume(values, self.main.grid, f"{self.main.quantity}_std")

    def volumes(self) -> list[Volume]:
        """Return standard deviations as density_std and so on; of what is no linear function, percentiles too.

        A field x has the percentiles x + z std, and T(x) theirs.
        """
        std = self.std().values.double()
        found = []
        for quantity in self.gas.quantities_of(self.main):
            found.append(self._statistic(quantity, "std", deviation(self.main, std, quantity, self.gas)))
            if quantity == "temperature":
                for name, z in TAILS.items():
                    end = self._derived(quantity, -z * std)  # temperature falls as the index rises
                    found.append(self._statistic(quantity, name, end))
        return found

    def _derived(self, quantity: str, more: Tensor) -> Tensor:
        moved = Volume.of(self.main.values.double() + more, self.main.grid, self.main.quantity, self._ambient)
        return derive(moved, quantity, self.gas).values.double()

    @property
    def _ambient(self) -> float:
        return float(self.main.attributes.get("n_ambient", 1.0))

    def _statistic(self, quantity: str, statistic: str, values: Tensor) -> Volume:
        label = f"{quantity}_{statistic}"
        derived = derive(self.main, quantity, self.gas)
        notes: dict[str, float | str] = {"trials": self.count}
        if "assumption" in derived.notes:
            masked = {"masked_voxels": int(torch.isnan(values).sum()), "masked_where": derived.notes["masked_where"]}
            notes |= {"assumption": derived.notes["assumption"], **masked}
        return Volume(values.float(), self.main.grid, label, describe(label)[0], derived.attributes, notes)
