"""Axisymmetric and planar fields (geometry/symmetry.py): networks and splines of (r, h)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerif.common.arrays import Points, Values, Vectors
from nerif.common.conventions import InputError
from nerif.fields.field import Field, in_chunks
from nerif.fields.network import ACTIVATIONS, UNBOUNDED, Network, NeuralField, encode, encode_pullback
from nerif.fields.network_shape import NetworkShape
from nerif.fields.sum import SumField
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Grid
from nerif.geometry.symmetry import Symmetry

__all__ = ["SymmetricNetwork", "SymmetricVoxels", "symmetry_of_field"]


class SymmetricNetwork(Network):
    """A network of (r, h) for a symmetry in its coordinates: v(x) = sum_k D_k(x) f_k(r, h), an output for each f_k."""

    def __init__(self, shape: NetworkShape, symmetry: Symmetry, bounds: tuple[float, float] = UNBOUNDED) -> None:
        super().__init__(shape, bounds=bounds)
        self.symmetry = symmetry
        self.layered = symmetry.angles == 1  # type: ignore[misc]
        if not self.layered:
            if shape.gradient_head:
                raise InputError("not available with harmonics of the angle (--symmetry axis+N)", field="gradient_head")
            output = self.outputs[0]
            assert isinstance(output, nn.Linear)
            self.outputs[0] = nn.Linear(output.in_features, symmetry.angles)

    def encode(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n e"]:
        return encode(self.symmetry.reduced(p), self.waves, self.gains[self.octave].to(p))

    def pull_back(self, p: Tensor, encoded: Tensor, cotangent: Tensor) -> Float[Tensor, "n 3"]:
        slope = encode_pullback(encoded, cotangent, self.waves)
        return self.symmetry.gradient(self.symmetry.local(p).to(slope), slope)

    def _value(self, p: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        if self.layered:
            return super()._value(p, h)
        output, slope, inner = self.outputs[0], None, h
        assert isinstance(output, nn.Linear)
        if self.shape.head_width:
            inner, slope = ACTIVATIONS[self.shape.activation](self.heads[0](h))
        each = output(inner)
        share, rise = self.symmetry.shares(self.symmetry.local(p))
        mixed = share.to(each) @ output.weight
        if slope is not None:
            mixed = (slope * mixed) @ self.heads[0].weight  # type: ignore[operator]
        return (share * each).sum(dim=1), mixed, (rise * each[..., None]).sum(dim=1)

    def _gradient_heads(self, p: Tensor, h: Tensor) -> Tensor:
        slope = super()._gradient_heads(p, h)
        return self.symmetry.gradient(self.symmetry.local(p).to(slope), slope)


def symmetry_of_field(field: Field) -> Symmetry | None:
    """Return the symmetry that a field has by construction, mm, or None."""
    if isinstance(field, SumField):
        return symmetry_of_field(field.parts[0])
    if isinstance(field, SymmetricVoxels):
        return field.symmetry
    if isinstance(field, NeuralField) and isinstance(field.network, SymmetricNetwork):
        unit = field.half_edge
        x, y, z = field.box.centre
        return field.network.symmetry.in_units((-x / unit, -y / unit, -z / unit), 1 / unit)
    return None


class SymmetricVoxels(Field):
    """B-splines of (r, h): f(x) = sum_k D_k(x) f_k(r, h).

    Parameters
    ----------
    parts : f_k over (r, -, h), all on one grid
    symmetry : mm
    """

    def __init__(self, parts: Sequence[VoxelField], symmetry: Symmetry) -> None:
        if len(parts) != symmetry.angles:
            raise InputError(f"expected {symmetry.angles} for the symmetry, got {len(parts)}", field="parts")
        self.parts, self.symmetry = tuple(parts), symmetry

    @classmethod
    def through(
        cls, field: Field, symmetry: Symmetry, grid: Grid, device: torch.device | str = "cpu"
    ) -> SymmetricVoxels:
        """Return the splines through a symmetric field on a grid (r, -, h), of two voxels across.

        About an axis r runs from -r_max to r_max.
        """
        h, r = torch.meshgrid(grid.axis("z"), grid.axis("x"), indexing="ij")
        field, parts = field.to(device), []
        for k in range(symmetry.angles):
            angle = torch.full_like(r, 2 * math.pi * k / symmetry.angles)
            points = symmetry.places(r, angle, h).float().reshape(-1, 3)
            values = torch.cat([field(p.to(device)).detach().cpu().float() for p in in_chunks(points)])
            flat = values.reshape(len(h), 1, -1).expand(*grid.shape)
            parts.append(VoxelField.through(flat, grid))
        return cls(parts, symmetry)

    @property
    def grid(self) -> Grid:
        """Grid over (r, k, h)."""
        flat = self.parts[0].grid
        return Grid(flat.box, (flat.shape[0], len(self.parts), flat.shape[2]))

    @property
    def padded(self) -> Float[Tensor, "z k x"]:
        """Coefficients (h, k, r) with the layers beyond the grid in h and r."""
        return torch.stack([part.coefficients[:, part.layers] for part in self.parts], dim=1)

    def to(self, device: torch.device | str) -> SymmetricVoxels:
        """Return the field with its coefficients on a device."""
        return SymmetricVoxels([part.to(device) for part in self.parts], self.symmetry)

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        w = self.symmetry.local(points)
        place = self.symmetry.of_local(w)
        results = [part.value_and_gradient(place) for part in self.parts]
        if len(results) == 1:
            value, slope = results[0]
            return value, self.symmetry.gradient(w, slope)
        share, rise = self.symmetry.shares(w)
        values = torch.stack([value for value, _ in results], dim=-1)
        slopes = torch.stack([slope for _, slope in results], dim=-2)
        slope = self.symmetry.gradient(w, (share[..., None] * slopes).sum(dim=-2))
        return (share * values).sum(dim=-1), slope + (rise * values[..., None]).sum(dim=-2)
