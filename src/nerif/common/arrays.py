"""Aliases of arrays with their shapes, as used in annotations; arrays with gaps."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError

__all__ = ["Mask", "Matrix3", "Pixels", "Points", "Values", "Vectors", "filled", "make_tensors"]

Points = Float[Tensor, "*batch 3"]  # mm, world frame
Vectors = Float[Tensor, "*batch 3"]  # direction (1) or gradient (1/mm)
Values = Float[Tensor, "*batch"]  # index excess n - n_ambient (1)
Pixels = Float[Tensor, "*batch 2"]  # px, (column u, row v), (0, 0) the centre of the top-left pixel
Matrix3 = Float[Tensor, "3 3"]
Mask = Bool[Tensor, "*batch"]


def make_tensors(record: object, dtype: torch.dtype, *names: str) -> None:
    """Set fields of a frozen record that are arrays or lists to tensors of a type; None and tensors stay."""
    for name in names:
        value = getattr(record, name)
        if value is None or isinstance(value, Tensor):
            continue
        try:
            tensor = torch.as_tensor(np.asarray(value)).to(dtype)
        except (TypeError, ValueError):
            got = type(value).__name__
            raise InputError(f"expected numbers as a tensor, an array or lists, got {got}", field=name) from None
        object.__setattr__(record, name, tensor)


def filled(values: Float[np.ndarray, "z y x"]) -> Float[np.ndarray, "z y x"]:
    """Return the values with masked voxels (NaN) set to their nearest neighbour, so that masks have no surface."""
    from scipy.ndimage import distance_transform_edt

    masked = ~np.isfinite(values)
    if masked.all() or not masked.any():
        return np.nan_to_num(values)
    nearest = distance_transform_edt(masked, return_distances=False, return_indices=True)
    return values[tuple(nearest)]
