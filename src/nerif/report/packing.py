"""Volumes packed small enough to travel inside a page: 16 bit, differences along x, bytes apart, deflated, base64.

The page holds the index excess once; n, density and temperature are simple functions of it (`Relation`), so that three
quantities take the room of one. What stands beside it (spread, error) has 12 bits. 65535 stands for a masked voxel.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nerif.geometry import Grid
from nerif.physics.gas_optics import GAS_CONSTANT
from nerif.physics.quantities import TEMPERATURE_RANGE
from nerif.volume import Volume

__all__ = ["COARSE", "FINE", "LARGEST", "Relation", "coarsen", "pack", "relation", "unpack"]

LARGEST = 128  # voxels along the longest edge; finer volumes are averaged down, and the page says so
MASKED = 65535
FINE, COARSE = 65534, 4095


@dataclass(frozen=True)
class Relation:
    """A quantity q of the index excess x: q = (x + offset) factor, or q = factor / (x + offset); masked out of bounds.

    Parameters
    ----------
    kind : "linear" or "reciprocal"
    offset : 1
    factor : unit of q
    lower, upper : q is masked unless lower < q and lower <= q <= upper; None for no bound
    """

    kind: str
    offset: float
    factor: float
    lower: float | None = None
    upper: float | None = None

    def __call__(self, x: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Return the quantity of an index excess, NaN where masked."""
        with np.errstate(divide="ignore", invalid="ignore"):
            shifted = x.astype(np.float64) + self.offset
            q = shifted * self.factor if self.kind == "linear" else self.factor / shifted
            good = shifted > 0 if self.lower is not None else np.isfinite(q)
            if self.lower is not None and self.upper is not None:
                good &= (q >= self.lower) & (q <= self.upper)
            return np.where(good, q, np.nan)


def relation(quantity: str, attributes: dict[str, float | str]) -> Relation:
    """Return how n - 1, density or temperature follow from the index excess, by the attributes of the file."""
    refractivity = float(attributes["n_ambient"]) - 1
    if quantity == "n":
        return Relation("linear", refractivity, 1.0)
    k = float(attributes["gladstone_dale_m3_kg-1"])
    if quantity == "density":
        return Relation("linear", refractivity, 1 / k, lower=0.0)
    pressure, mass = float(attributes["pressure_pa"]), float(attributes["molar_mass_kg_mol-1"])
    low, high = TEMPERATURE_RANGE
    return Relation("reciprocal", refractivity, pressure * mass * k / GAS_CONSTANT, low, high)


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


def unpack(packed: dict[str, Any], shape: tuple[int, ...]) -> Float[np.ndarray, "z y x"]:
    """Return what `pack` was given, to within half a step: the page's own reading, written once more for tests."""
    data = np.frombuffer(zlib.decompress(base64.b64decode(packed["text"])), dtype=np.uint8).astype(np.uint16)
    steps = data[: len(data) // 2] | (data[len(data) // 2 :] << 8)
    codes = np.cumsum(steps, dtype=np.uint16)
    values = packed["low"] + codes * packed["step"]
    return np.where(codes == MASKED, np.nan, values).reshape(shape)


def as_plain(found: Relation) -> dict[str, Any]:
    """Return a relation as what JSON can hold."""
    return asdict(found)
