"""Interpolation of a scalar between two frames, advected by the velocity.

theta(x, t) = (1 - s) theta_0(x - s dt u) + s theta_1(x + (1 - s) dt u),      t = t_0 + s dt
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Grid

__all__ = ["between"]


@torch.no_grad()
def between(
    before: Float[Tensor, "z y x"], after: Float[Tensor, "z y x"], velocity: Float[Tensor, "3 z y x"], grid: Grid,
    seconds: float, fraction: float = 0.5,
) -> Float[Tensor, "z y x"]:  # fmt: skip
    """Return a scalar at an instant between two frames.

    Parameters
    ----------
    before, after : scalar at the two frames
    velocity : then, along x, y, z, mm/s; NaN (not known): at rest
    grid : of all volumes
    seconds : between the frames
    fraction : of that time, s
    """
    if not 0 <= fraction <= 1:
        raise InputError(f"expected 0 to 1, got {fraction}", field="fraction")
    points, path = grid.points(torch.float32), seconds * velocity.nan_to_num().movedim(0, -1)
    from_before = VoxelField.through(before.float(), grid)(points - fraction * path)
    from_after = VoxelField.through(after.float(), grid)(points + (1 - fraction) * path)
    return (1 - fraction) * from_before + fraction * from_after
