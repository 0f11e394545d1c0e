"""Distance of the sampling planes along a ray."""

from __future__ import annotations

from nerif.common.conventions import InputError

__all__ = ["MAX_STEP", "check_step"]

MAX_STEP = {"linear": 0.5, "cubic": 1.0}
"""Largest distance by basis, voxels: the gradient of the linear one jumps from voxel to voxel (docs/decisions/011)."""


def check_step(step: float, basis: str) -> None:
    """Raise InputError unless the distance of planes is in the range of the basis."""
    if not 0 < step <= MAX_STEP[basis]:
        raise InputError(
            f"expected above 0 and at most {MAX_STEP[basis]:g} voxels (basis {basis}), got {step}", field="step"
        )
