"""How far off a reconstruction may be, from a few more of them whose errors are known.

    std(x)^2 = G * mean_j (q'_j - p_j)^2 (x),      p_j = q + SHARE (q - q_-j)

Trials come in pairs. One does without a view: where it differs from q, q_-j tells what that view told. The other is of
a field p_j that is known, seen by the same cameras: q changed once more by what a view told, so that it holds, where
the views tell least, what they may have missed. What it looks like is predicted, with what the reconstruction left
unexplained added in blocks of random sign: whatever noise there is, of the right size and correlated as it is. How far
the reconstruction q'_j of it is off is an error as q may have it. One error is noisy, so squares are averaged around
each voxel by a Gaussian G, WIDTH wide. No trial sees a truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.fields.grid import VoxelField
from nerif.geometry import Camera, Grid
from nerif.measurement import Measurement
from nerif.physics.quantities import GasSettings, derive
from nerif.reconstruction.base import Reconstruction
from nerif.reconstruction.repetition import Found, Member, other_seed
from nerif.volume import Volume, describe, quantities_of

__all__ = ["KINDS", "Deviations", "Trials", "best_covered"]

KINDS = {"off": 0, "fast": 1, "full": 4}
"""Trials without a view, and as many of a field that is known."""

SHARE = 0.5  # 0 stays below the errors of flames, 1 above those of smooth balls (docs/architecture.md)
WIDTH = 0.04  # of the box edge, standard deviation
VOXELS = 64  # along the longest edge, on which errors are compared
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
            raise InputError(f"uncertainty: expected one of {', '.join(KINDS)}, got '{self.kind}'")

    @property
    def word(self) -> str:
        return "uncertainty"

    @property
    def members(self) -> int:
        return 2 * KINDS[self.kind]

    @property
    def fewest(self) -> int:
        return 1

    @property
    def without_views(self) -> bool:
        return True

    def member(self, number: int, found: Found, earlier: Sequence[Reconstruction | None]) -> Member:
        """Return a trial: those of odd numbers do without a view, each followed by one of a field that is known."""
        method, measurement = other_seed(found.reconstructor, number), found.measurement
        volume = _sampled(found.result)
        order = best_covered(measurement.cameras)
        out = order[((number - 1) // 2) % len(order)]
        if number % 2 and len(order) > 1:
            rest = measurement.select([name for name in measurement.names if name != out])
            return Member(method, rest, (out,), about=f", without {out}")
        known = volume.values.double()
        before = earlier[number - 2] if number > 1 else None
        if before is not None and len(order) > 1:
            known = known + SHARE * (known - _sampled(before).values.double())
        drawn = torch.Generator().manual_seed(2_000_003 + number)
        expected = Volume.of(known, volume.grid, volume.quantity, found.result.n_ambient)
        simulated = _simulated(found, volume, expected, drawn)
        return Member(method, simulated, (), expected, ", of a field that is known")

    def taken(self, main: Volume, gas: GasSettings) -> Deviations:
        return Deviations(main, gas)


def _sampled(result: Reconstruction) -> Volume:
    return result.volume(Grid.of_resolution(result.box, VOXELS))


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


def _simulated(found: Found, volume: Volume, known: Volume, drawn: torch.Generator) -> Measurement:
    """What would have been measured of a field that is known, with what was left unexplained of the one found."""
    own = found.seen(VoxelField.through(volume.values.double(), volume.grid))
    other = found.seen(VoxelField.through(known.values, known.grid))
    maps = {}
    for o in found.measurement.observations:
        name = o.technique.name
        left = (o.values - own[name].to(o.values)) * _signs(o.values, drawn)
        maps[name] = other[name].to(o.values) + left
    sigmas = {o.technique.name: o.sigma for o in found.measurement.observations}
    return found.measurement.observed(maps, sigmas)


def _signs(like: Float[Tensor, "view row column c"], drawn: torch.Generator) -> Float[Tensor, "view row column c"]:
    """1 or -1 by chance, the same in blocks of pixels."""
    views, height, width, channels = like.shape
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    coarse = torch.randint(0, 2, (views, rows, columns, channels), generator=drawn) * 2 - 1
    fine = coarse.repeat_interleave(BLOCK, dim=1).repeat_interleave(BLOCK, dim=2)
    return fine[:, :height, :width].to(like)


class Deviations:
    """Standard deviation of every quantity from the errors of trials.

    Parameters
    ----------
    main : (z, y, x) the field that was found, as it is written
    gas : what density and temperature are computed for
    """

    def __init__(self, main: Volume, gas: GasSettings) -> None:
        self.main, self.gas = main, gas
        self.squares: list[Tensor] = []
        self.grid: Grid | None = None

    @property
    def count(self) -> int:
        """How many errors are known."""
        return len(self.squares)

    def add(self, member: Member, result: Reconstruction) -> None:
        """Take in what one more has found, if it is known what it should have."""
        if member.expected is not None:
            self.grid = member.expected.grid
            error = result.volume(self.grid).values.double() - member.expected.values.double()
            self.squares.append(error.square())

    def std(self) -> Volume:
        """Return the standard deviation of the field."""
        from scipy.ndimage import gaussian_filter

        assert self.grid is not None
        mean = torch.stack(self.squares).mean(dim=0)
        edge = math.prod(self.grid.box.edges) ** (1 / 3)
        width = [WIDTH * edge / h for h in self.grid.spacing[::-1]]  # voxels along z, y, x
        local = torch.from_numpy(gaussian_filter(mean.numpy(), width, mode="nearest")).sqrt()
        values = VoxelField.through(local, self.grid).sample(self.main.grid).clamp(min=0)
        return Volume(values, self.main.grid, f"{self.main.quantity}_std")

    def volumes(self) -> list[Volume]:
        """Return standard deviations as density_std and so on; of what is no linear function, percentiles too.

        A field x has the percentiles x + z std, and T(x) theirs; its standard deviation is half of T(x - std) less
        T(x + std).
        """
        std = self.std().values.double()
        found = []
        for quantity in quantities_of(self.main.quantity):
            below, above = (self._derived(quantity, z * std) for z in (-1, 1))
            found.append(self._statistic(quantity, "std", 0.5 * (above - below).abs()))
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
