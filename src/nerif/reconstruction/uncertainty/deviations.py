"""Standard deviations of every quantity from samples of the error of a field.

    std(x) = factor (G * mean_j e_j^2)^(1/2) (x)

A single sample is noisy, so squares are averaged around each voxel by a Gaussian G.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.data.quantity_names import describe
from nerif.data.volume import Volume
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Grid
from nerif.geometry.body import Body, contained
from nerif.physics.gas import GasSettings
from nerif.physics.medium import Medium, derive, deviation

__all__ = ["TAILS", "VOXELS", "Deviations", "blurred", "certainty"]

VOXELS = 64  # along the longest edge of the box, on which errors are sampled
WIDTH = 0.04  # of the box edge: standard deviation of G
TAILS = {"p05": -1.645, "p95": 1.645}  # standard deviations of the percentiles


def certainty(field: Volume, std: Volume) -> Volume:
    """Return q^2 / (q^2 + std^2), between 0 and 1; 0 where both are 0.

    As the opacity of a volume it hides the ambient and fades what is uncertain.

    Source: the gain of Wiener's filter, Extrapolation, Interpolation, and Smoothing of Stationary Time Series (1949).
    """
    signal, noise = field.values.double().square(), std.values.double().square()
    values = torch.where(signal + noise > 0, signal / (signal + noise), 0.0).nan_to_num(0.0)
    label = f"{field.quantity}_certainty"
    return Volume(values.float(), field.grid, label, *describe(label)[:1], field.attributes)


def blurred(values: Tensor, grid: Grid, mm: float) -> Tensor:
    """Return the mean over a Gaussian with a standard deviation in mm, at least a voxel."""
    from scipy.ndimage import gaussian_filter

    width = [max(1.0, mm / h) for h in grid.spacing[::-1]]  # voxels along z, y, x
    return torch.from_numpy(gaussian_filter(values.double().numpy(), width, mode="nearest"))


class Deviations:
    """Standard deviations of every quantity from samples of the error.

    `main` is the field on the grid of the result; errors within bodies do not count.
    """

    def __init__(self, main: Volume, medium: Medium, bodies: Sequence[Body] = ()) -> None:
        self.main, self.medium, self.bodies = main, medium, bodies
        self.squares: list[Tensor] = []
        self.grid: Grid | None = None

    @property
    def factor(self) -> float:
        """The standard deviation over the rms of the samples."""
        return 1.0

    @property
    def count(self) -> int:
        return len(self.squares)

    def add(self, error: Float[Tensor, "z y x"], grid: Grid) -> None:
        """Add a sample of the error on a grid, the same for all."""
        self.grid = grid
        self.squares.append(error.double().square())

    def local(self) -> Float[Tensor, "z y x"]:
        """Return the rms of the samples around each voxel of `grid`."""
        assert self.grid is not None
        width, mean = WIDTH * math.prod(self.grid.box.edges) ** (1 / 3), torch.stack(self.squares).mean(dim=0)
        if not self.bodies:
            return blurred(mean, self.grid, width).sqrt()
        outside = (~contained(self.bodies, self.grid.points())).double()
        share = blurred(outside, self.grid, width).clamp_min(1e-6)
        return (blurred(mean * outside, self.grid, width) / share).sqrt()

    def std(self) -> Volume:
        """Return the standard deviation of the field."""
        assert self.grid is not None
        values = VoxelField.through(self.factor * self.local(), self.grid).sample(self.main.grid).clamp(min=0)
        values = values.masked_fill(self.main.values.isnan(), math.nan)
        return Volume(values, self.main.grid, f"{self.main.quantity}_std")

    def volumes(self) -> list[Volume]:
        """Return the standard deviation of every quantity, such as density_std; percentiles of the temperature T.

        The percentiles of the field x are x + z std; those of T, which is not linear in x, are T(x + z std).
        """
        std = self.std().values.double()
        volumes = []
        for quantity in self.medium.quantities_of(self.main):
            volumes.append(self._statistic(quantity, "std", deviation(self.main, std, quantity, self.medium)))
            if quantity == "temperature" and isinstance(self.medium, GasSettings):
                for name, z in TAILS.items():
                    values = self.main.values.double() - z * std  # temperature falls as the index rises
                    n_ambient = float(self.main.attributes.get("n_ambient", 1.0))
                    tail = Volume.of(values, self.main.grid, self.main.quantity, n_ambient)
                    gas = replace(self.medium, uniform_pressure="yes")  # as in the field
                    volumes.append(self._statistic(quantity, name, derive(tail, quantity, gas).values.double()))
        return volumes

    def _statistic(self, quantity: str, statistic: str, values: Tensor) -> Volume:
        label = f"{quantity}_{statistic}"
        derived = derive(self.main, quantity, self.medium)
        notes: dict[str, float | str] = {"trials": self.count}
        if "assumption" in derived.notes:
            masked = {"masked_voxels": int(torch.isnan(values).sum()), "masked_where": derived.notes["masked_where"]}
            notes |= {"assumption": derived.notes["assumption"], **masked}
        return Volume(values.float(), self.main.grid, label, describe(label)[0], derived.attributes, notes)
