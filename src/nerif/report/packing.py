"""Volumes packed small enough to travel inside a page: 16 bit, differences along x, bytes apart, deflated, base64.

The page holds the reconstructed field once; n, density and temperature are simple functions of an index excess
(`relation`), so that three quantities take the room of one. What stands beside it (spread, error) has 12 bits. 65535
stands for a masked voxel.
"""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nerif.data.volume import INDEX, Volume, quantities_of
from nerif.geometry import Grid
from nerif.physics.gas_optics import GAS_CONSTANT
from nerif.physics.quantities import TEMPERATURE_RANGE

__all__ = ["COARSE", "FINE", "LARGEST", "MASKED", "coarsen", "pack", "relation"]

LARGEST = 128  # voxels along the longest edge; finer volumes are averaged down, and the page says so
MASKED = 65535
FINE, COARSE = 65534, 4095


def relation(quantity: str, attributes: dict[str, float | str]) -> dict[str, Any]:
    """Return how n - 1, density or temperature q follow from the index excess x, by the attributes of the file.

    Any other field x is shown as it is: q = x.

        linear: q = (x + offset) factor,      reciprocal: q = factor / (x + offset)

    With a `lower` (None for no bound) q is masked unless x + offset > 0, with an `upper` unless lower <= q <= upper.
    """
    found: dict[str, Any] = {"kind": "linear", "offset": 0.0, "factor": 1.0, "lower": None, "upper": None}
    if quantity not in quantities_of(INDEX):
        return found
    found["offset"] = float(attributes["n_ambient"]) - 1
    if quantity == "n":
        return found
    k = float(attributes["gladstone_dale_m3_kg-1"])
    if quantity == "density":
        return {**found, "factor": 1 / k, "lower": 0.0}
    pressure, mass = float(attributes["pressure_pa"]), float(attributes["molar_mass_kg_mol-1"])
    low, high = TEMPERATURE_RANGE
    factor = pressure * mass * k / GAS_CONSTANT
    return {**found, "kind": "reciprocal", "factor": factor, "lower": low, "upper": high}


def coarsen(volume: Volume, largest: int = LARGEST) -> Volume:
    """Average a volume down until no edge has more than `largest` voxels."""
    if max(volume.grid.shape) <= largest:
        return volume
    nz, ny, nx = (max(1, round(n * largest / max(volume.grid.shape))) for n in volume.grid.shape)
    grid = Grid(volume.grid.box, (nz, ny, nx))
    values = torch.nn.functional.adaptive_avg_pool3d(volume.values.float()[None, None], grid.shape)[0, 0]
    return Volume(values, grid, volume.quantity, volume.unit, volume.attributes, volume.notes)


def pack(values: Float[np.ndarray, "z y x"], levels: int = FINE) -> dict[str, Any]:
    """Return the values as text, and what is needed to read it: x = low + code step."""
    known = np.isfinite(values)
    low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 1.0)
    span = high - low or 1.0
    codes = np.where(known, np.round((np.nan_to_num(values) - low) / span * levels), MASKED).astype("<u2")
    flat = codes.ravel()
    steps = np.diff(flat, prepend=flat.dtype.type(0))  # modulo 65536: small where the field is smooth
    data = np.concatenate([(steps & 255).astype(np.uint8), (steps >> 8).astype(np.uint8)])
    text = base64.b64encode(zlib.compress(data.tobytes(), 6)).decode()
    return {"low": low, "step": span / levels, "text": text}
