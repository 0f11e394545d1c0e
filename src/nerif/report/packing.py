"""Volumes packed into a page: 16 bit, differences along x, low and high bytes apart, deflated, base64.

The page contains the reconstructed field once; n, density and temperature are functions of an index excess
(`relation`). Standard deviation and error have 12 bits. 65535 is a masked voxel.
"""

from __future__ import annotations

import base64
import math
import zlib
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nerif.data.quantity_names import INDEX, quantities_of
from nerif.data.volume import Volume
from nerif.geometry import Grid
from nerif.physics.gas import TEMPERATURE_RANGE
from nerif.physics.gas_optics import GAS_CONSTANT
from nerif.physics.medium import Medium

__all__ = ["COARSE", "FINE", "MASKED", "MAX_VOXELS", "coarsen", "pack", "relation"]

MAX_VOXELS = 128  # along the longest edge; finer volumes are averaged, as the page says
MASKED = 65535
TABLE_POINTS = 513
FINE, COARSE = 65534, 4095  # levels


def tabulated(quantity: str, medium: Medium, n_ambient: float, low: float, high: float) -> dict[str, Any]:
    """Return a quantity of a medium at equal steps of the index excess from low to high, None where it is masked."""
    excess = torch.linspace(low, high, TABLE_POINTS, dtype=torch.float64)
    values = [v if math.isfinite(v) else None for v in medium.values(excess, n_ambient, quantity)[0].tolist()]
    return {"kind": "table", "low": low, "step": (high - low) / (TABLE_POINTS - 1) or 1.0, "values": values}


def relation(quantity: str, attributes: dict[str, float | str]) -> dict[str, Any]:
    """Return how n - 1, density or temperature q of a gas follow from the index excess x, by attributes of the file.

        linear: q = (x + offset) factor,      reciprocal: q = factor / (x + offset)

    With a `lower` (or None) q is masked unless x + offset > 0, with an `upper` unless lower <= q <= upper. Other
    quantities are shown unchanged.
    """
    identity: dict[str, Any] = {"kind": "linear", "offset": 0.0, "factor": 1.0, "lower": None, "upper": None}
    if quantity not in quantities_of(INDEX):
        return identity
    of_index = {**identity, "offset": float(attributes["n_ambient"]) - 1}
    if quantity == "n":
        return of_index
    k = float(attributes["gladstone_dale_m3_kg-1"])
    if quantity == "density":
        return {**of_index, "factor": 1 / k, "lower": 0.0}
    pressure, mass = float(attributes["pressure_pa"]), float(attributes["molar_mass_kg_mol-1"])
    low, high = TEMPERATURE_RANGE
    factor = pressure * mass * k / GAS_CONSTANT
    return {**of_index, "kind": "reciprocal", "factor": factor, "lower": low, "upper": high}


def coarsen(volume: Volume, max_voxels: int = MAX_VOXELS) -> Volume:
    """Average a volume until no edge has more than `max_voxels` voxels."""
    if max(volume.grid.shape) <= max_voxels:
        return volume
    nz, ny, nx = (max(1, round(n * max_voxels / max(volume.grid.shape))) for n in volume.grid.shape)
    grid = Grid(volume.grid.box, (nz, ny, nx))
    values = torch.nn.functional.adaptive_avg_pool3d(volume.values.float()[None, None], grid.shape)[0, 0]
    return Volume(values, grid, volume.quantity, volume.unit, volume.attributes, volume.notes)


def pack(values: Float[np.ndarray, "z y x"], levels: int = FINE) -> dict[str, Any]:
    """Return the values as text, with `low` and `step`: x = low + code step."""
    valid = np.isfinite(values)
    low, high = (float(values[valid].min()), float(values[valid].max())) if valid.any() else (0.0, 1.0)
    span = high - low or 1.0
    codes = np.where(valid, np.round((np.nan_to_num(values) - low) / span * levels), MASKED).astype("<u2").ravel()
    steps = np.diff(codes, prepend=codes.dtype.type(0))  # modulo 65536; small in a smooth field
    data = np.concatenate([(steps & 255).astype(np.uint8), (steps >> 8).astype(np.uint8)])
    text = base64.b64encode(zlib.compress(data.tobytes(), 6)).decode()
    return {"low": low, "step": span / levels, "text": text}
