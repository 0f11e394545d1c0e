"""What all views measured, put together as one measurement."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool

from nerif.conventions import DEFAULT_AMBIENT_FACES
from nerif.geometry import Box, Camera
from nerif.imaging.displacement import DisplacementMap
from nerif.measurement import Measurement

__all__ = ["World", "join_views"]

Mask = Bool[np.ndarray, "row column"]


@dataclass(frozen=True)
class World:
    """What a measurement holds beside its views; see Measurement."""

    box: Box
    n_ambient: float
    wavelength_nm: float | None = None
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES


def join_views(views: Iterable[tuple[Camera, DisplacementMap, Mask | None]], world: World) -> Measurement:
    """Return one measurement of all views; smaller pictures are padded.

    Parameters
    ----------
    views : camera, displacement and flow mask (or None) of each, held one at a time
    world : box and surroundings
    """
    cameras: list[Camera] = []
    maps: dict[str, list[np.ndarray]] = {"displacement": [], "sigma": [], "valid": [], "flow_mask": []}
    masked = False
    for camera, found, mask in views:
        cameras.append(camera)
        everywhere = np.ones(found.valid.shape, dtype=bool)  # no mask says nothing about where the flow is
        masked |= mask is not None
        own = (found.displacement, found.sigma, found.valid, everywhere if mask is None else mask)
        for arrays, array in zip(maps.values(), own, strict=True):
            arrays.append(array)
    size = tuple(max(v.shape[k] for v in maps["valid"]) for k in range(2))

    def stack(name: str) -> torch.Tensor:
        arrays = maps[name]
        kind = arrays[0].dtype
        whole = np.full((len(arrays), *size, *arrays[0].shape[2:]), np.nan if kind.kind == "f" else 0, dtype=kind)
        for own in whole:
            array = arrays.pop(0)  # not kept beside its copy
            own[: array.shape[0], : array.shape[1]] = array
        return torch.from_numpy(whole)

    return Measurement(
        cameras=tuple(cameras),
        displacement=stack("displacement"),
        box=world.box,
        n_ambient=world.n_ambient,
        sigma=stack("sigma"),
        valid=stack("valid"),
        flow_mask=stack("flow_mask") if masked else None,
        wavelength_nm=world.wavelength_nm,
        ambient_faces=world.ambient_faces,
    )
