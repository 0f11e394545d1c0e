"""What the record of an octahedron holds: its Resolution in plain numbers, and how finely the pixels sample it."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from nerif.fields.phantoms import Octahedron
from nerif.geometry import Camera
from study.mtf import MTF
from study.resolution import Resolution

__all__ = ["from_plain", "pixels_per_unit", "to_plain"]


def to_plain(resolution: Resolution) -> dict[str, Any]:
    """Return a Resolution as plain numbers and lists, with what follows from them, for a JSON file."""
    return {
        "lp_per_mm": resolution.lp_per_mm,
        "lp_per_unit": resolution.lp_per_unit,
        "coarsest_lp_per_unit": resolution.coarsest,
        "finest_lp_per_unit": float(resolution.mtf_per_unit.frequency[-1]),
        "unit_mm": resolution.unit,
        "half_length_mm": resolution.half_length,
        "distance_mm": resolution.distance.tolist(),
        "edge_spread": resolution.edge_spread.tolist(),
        "frequency_lp_per_mm": resolution.mtf.frequency.tolist(),
        "mtf": resolution.mtf.transfer.tolist(),
        "patches_mm": resolution.patches.tolist(),
        "local_lp_per_mm": resolution.local_lp_per_mm.tolist(),
    }


def from_plain(plain: dict[str, Any]) -> Resolution:
    """Return what `to_plain` made plain; None, as JSON files have it, is NaN."""

    def numbers(name: str) -> Tensor:
        values = plain[name]
        if values and not isinstance(values[0], list):
            values = [math.nan if v is None else v for v in values]
        return torch.tensor(values, dtype=torch.float64)

    return Resolution(
        unit=plain["unit_mm"],
        half_length=plain["half_length_mm"],
        distance=numbers("distance_mm"),
        edge_spread=numbers("edge_spread"),
        mtf=MTF(numbers("frequency_lp_per_mm"), numbers("mtf")),
        patches=numbers("patches_mm"),
        local_lp_per_mm=numbers("local_lp_per_mm"),
    )


def pixels_per_unit(camera: Camera, phantom: Octahedron) -> float:
    """Return how many pixels a camera gives to one unit of the phantom at the centre of the box.

    Measured across the optical axis; the geometric mean of what columns and rows have.
    """
    centre = camera.rotation.new_tensor(phantom.box.centre)
    across = camera.rotation[:2] * (phantom.unit / 2)  # the image's right and down, world frame, mm
    spans = (camera.project(centre + across) - camera.project(centre - across)).norm(dim=-1)
    return float(spans.prod().sqrt())
