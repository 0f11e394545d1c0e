"""Fields that are alike around an axis or along a line (geometry/symmetry.py), by a network or by splines of (r, h)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerif.conventions import InputError, Points, Values, Vectors
from nerif.fields.base import Field
from nerif.fields.encoding import encode, encode_pullback
from nerif.fields.grid import VoxelField
from nerif.fields.mlp import ACTIVATIONS, UNBOUNDED, Network, NetworkShape
from nerif.geometry.symmetry import Symmetry

__all__ = ["SymmetricNetwork", "SymmetricVoxels"]


class SymmetricNetwork(Network):
    """A network of (r, h): v(x) = sum_k D_k(x) f_k(r, h), one output f_k a number that the field has there.

    Parameters
    ----------
    shape : NetworkShape
    symmetry : Symmetry, in the coordinates of the network
    bounds : lowest and highest value of the n head
    """

    def __init__(self, shape: NetworkShape, symmetry: Symmetry, bounds: tuple[float, float] = UNBOUNDED) -> None:
        super().__init__(shape, bounds=bounds)
        self.symmetry = symmetry
        self.layered = symmetry.angles == 1  # type: ignore[misc]
        if not self.layered:
            if shape.gradient_head:
                raise InputError("gradient_head: expected none with harmonics of the angle (--symmetry axis+N)")
            output = self.outputs[0]
            assert isinstance(output, nn.Linear)
            self.outputs[0] = nn.Linear(output.in_features, symmetry.angles)

    def encode(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n e"]:
        return encode(self.symmetry.reduced(p), self.waves, self.gains[self.octave].to(p))

    def pull_back(self, p: Tensor, encoded: Tensor, cotangent: Tensor) -> Float[Tensor, "n 3"]:
        slope = encode_pullback(encoded, cotangent, self.waves)
        return self.symmetry.turned_back(self.symmetry.local(p).to(slope), slope)

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
        return self.symmetry.turned_back(self.symmetry.local(p).to(slope), slope)


class SymmetricVoxels(Field):
    """B-splines of (r, h): f(x) = sum_k D_k(x) f_k(r, h).

    Parameters
    ----------
    parts : VoxelField of each f_k over (r, -, h), all on one grid
    symmetry : Symmetry, mm
    """

    def __init__(self, parts: Sequence[VoxelField], symmetry: Symmetry) -> None:
        if len(parts) != symmetry.angles:
            raise InputError(f"parts: expected {symmetry.angles} of the symmetry, got {len(parts)}")
        self.parts, self.symmetry = tuple(parts), symmetry

    def to(self, device: torch.device | str) -> SymmetricVoxels:
        """Return the same field with its coefficients on another device."""
        return SymmetricVoxels([part.to(device) for part in self.parts], self.symmetry)

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        w = self.symmetry.local(points)
        place = self.symmetry.of_local(w)
        found = [part.value_and_gradient(place) for part in self.parts]
        if len(found) == 1:
            value, slope = found[0]
            return value, self.symmetry.turned_back(w, slope)
        share, rise = self.symmetry.shares(w)
        values, slopes = torch.stack([v for v, _ in found], dim=-1), torch.stack([s for _, s in found], dim=-2)
        slope = self.symmetry.turned_back(w, (share[..., None] * slopes).sum(dim=-2))
        return (share * values).sum(dim=-1), slope + (rise * values[..., None]).sum(dim=-2)
