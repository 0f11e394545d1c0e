"""A cloud of small bright particles, and its ideal volume, the truth of a reconstruction.

E(x) = sum_p b_p G(x - x_p),      G a Gaussian of integral 1, averaged over the voxel
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.quantity_names import describe
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid

__all__ = ["DIAMETER", "Particles", "quality_factor", "spread"]

DIAMETER = 3.0
"""Diameter of a particle image, px, and of a particle of the ideal volume, voxels: four standard deviations (1/e^2)."""

QUANTITY = "emission"
REACH = 5.0  # standard deviations at which a Gaussian is truncated


@dataclass(frozen=True)
class Particles:
    """Particles in an illuminated box."""

    positions: Float[Tensor, "n 3"]  #: mm, world frame
    brightness: Float[Tensor, " n"]  #: integral over the emission of each, mm^2
    box: Box  #: mm

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def draw(cls, box: Box, count: int, variation: float = 0.0, seed: int = 0) -> Particles:
        """Return particles uniformly distributed in a box, of mean brightness 1 mm^2.

        `variation` is the standard deviation of the logarithm of the brightness.
        """
        if count < 1:
            raise InputError(f"expected at least 1 particle, got {count}", field="count")
        if not 0 <= variation < math.inf:
            raise InputError(f"expected 0 or more, got {variation}", field="variation")
        generator = torch.Generator().manual_seed(seed)
        unit = torch.rand(count, 3, generator=generator, dtype=torch.float64)
        logarithm = variation * torch.randn(count, generator=generator, dtype=torch.float64)
        brightness = torch.exp(logarithm - variation**2 / 2)
        return cls(unit.new_tensor(box.lower) + unit * unit.new_tensor(box.edges), brightness, box)

    def moved_to(self, positions: Float[Tensor, "n 3"]) -> Particles:
        """Return the particles at other positions (mm), without those outside the box."""
        lower, upper = positions.new_tensor(self.box.lower), positions.new_tensor(self.box.upper)
        inside = ((positions >= lower) & (positions <= upper)).all(dim=1)
        return Particles(positions[inside], self.brightness[inside], self.box)

    def volume(self, grid: Grid, diameter: float = DIAMETER) -> Volume:
        """Return the ideal volume: every particle a Gaussian of a diameter (voxels), averaged over the voxels.

        Source: Elsinga, Scarano, Wieneke & van Oudheusden, Exp. Fluids 41 (2006) 933, Sec. 3.
        """
        spacing = self.positions.new_tensor(grid.spacing)
        places = (self.positions - self.positions.new_tensor(grid.box.lower)) / spacing - 0.5
        per_voxel = self.brightness / math.prod(grid.spacing)
        values = spread(places.flip(-1), per_voxel, diameter / 4, grid.shape).float()
        return Volume(values, grid, QUANTITY, describe(QUANTITY)[0])


def spread(
    places: Float[Tensor, "n d"], amounts: Float[Tensor, " n"], deviation: float, shape: tuple[int, ...]
) -> Float[Tensor, "*shape"]:
    """Return an array of cells with each point as a Gaussian, integrated over the cells.

    Parameters
    ----------
    places : of the points, in cells along each axis of the array, 0 at the centre of the first
    amounts : integral over each Gaussian
    deviation : standard deviation, cells
    shape : of the array, outside of which the Gaussians are cut off
    """
    if not deviation > 0:
        raise InputError(f"expected above 0, got {4 * deviation}", field="diameter")
    reach = math.ceil(REACH * deviation)
    offsets = torch.arange(-reach, reach + 1)
    nearest = places.round().long()
    index = torch.zeros(len(places), 1, dtype=torch.long)
    share = amounts[:, None]
    for axis, n in enumerate(shape):
        cells = nearest[:, axis, None] + offsets
        edges = (torch.cat([cells, cells[:, -1:] + 1], dim=1) - 0.5 - places[:, axis, None]) / deviation
        part = torch.special.ndtr(edges).diff(dim=1) * ((cells >= 0) & (cells < n))
        index = (index[:, :, None] * n + cells.clamp(0, n - 1)[:, None]).flatten(1)
        share = (share[:, :, None] * part[:, None]).flatten(1)
    total = torch.zeros(math.prod(shape), dtype=share.dtype)
    return total.index_add_(0, index.flatten(), share.flatten()).reshape(shape)


def quality_factor(reconstructed: Float[Tensor, "z y x"], ideal: Float[Tensor, "z y x"]) -> float:
    """Return the quality of a reconstruction, 1 for the ideal volume in any scale.

        Q = sum E1 E0 / sqrt(sum E1^2 sum E0^2)

    Source: Elsinga, Scarano, Wieneke & van Oudheusden, Exp. Fluids 41 (2006) 933, Eq. (5).
    """
    e1, e0 = reconstructed.double(), ideal.double()
    if e1.shape != e0.shape:
        raise InputError(
            f"expected the shape of the reconstruction {tuple(e1.shape)}, got {tuple(e0.shape)}", field="ideal"
        )
    size = float(e1.square().sum() * e0.square().sum()) ** 0.5
    return float((e1 * e0).sum()) / size if size else 0.0
