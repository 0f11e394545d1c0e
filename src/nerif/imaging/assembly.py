"""What all views measured, put together as one measurement."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool

from nerif.common.conventions import AMBIENT_INDEX, DEFAULT_AMBIENT_FACES
from nerif.data.measurement import Measurement
from nerif.geometry import Box, Camera
from nerif.imaging.displacement.displacement import DisplacementMap

__all__ = ["Scene", "Surroundings", "join_views"]

Mask = Bool[np.ndarray, "row column"]


@dataclass(frozen=True)
class Surroundings:
    """The gas around the flow, and the light through it."""

    n_ambient: float = AMBIENT_INDEX
    """Refractive index around the flow."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES
    """Faces of the box on which the index is ambient."""


@dataclass(frozen=True)
class Scene:
    """What a measurement holds beside its views: the box to reconstruct, and what is around the flow."""

    box: Box
    surroundings: Surroundings = Surroundings()


def join_views(
    views: Iterable[tuple[Camera, DisplacementMap, Mask | None]], scene: Scene, pictures: bool = False
) -> Measurement:
    """Return one measurement of all views; smaller pictures are padded.

    With pictures a pixel is valid where one of the two says something, and the other is NaN there.

    Parameters
    ----------
    views : camera, displacement and flow mask (or None) of each, held one at a time
    scene : box and surroundings
    pictures : whether to keep those that the displacements were found in
    """
    cameras: list[Camera] = []
    maps: dict[str, list[np.ndarray]] = {"displacement": [], "sigma": [], "valid": [], "flow_mask": []}
    masked = False
    for camera, found, mask in views:
        cameras.append(camera)
        everywhere = np.ones(found.valid.shape, dtype=bool)  # no mask says nothing about where the flow is
        masked |= mask is not None
        own = {"displacement": found.displacement, "sigma": found.sigma, "valid": found.valid}
        own["flow_mask"] = everywhere if mask is None else mask
        if pictures and found.pair is not None:
            own["displacement"] = np.where(found.valid[..., None], found.displacement, np.float32(np.nan))
            own["valid"] = found.valid | np.isfinite(found.pair.flow)
            own |= {"reference": found.pair.reference, "flow": found.pair.flow, "picture_sigma": found.pair.sigma}
        for name, array in own.items():
            maps.setdefault(name, []).append(array)
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
        box=scene.box,
        n_ambient=scene.surroundings.n_ambient,
        sigma=stack("sigma"),
        valid=stack("valid"),
        maps={name: stack(name) for name in ("reference", "flow", "picture_sigma") if name in maps},
        flow_mask=stack("flow_mask") if masked else None,
        wavelength_nm=scene.surroundings.wavelength_nm,
        ambient_faces=scene.surroundings.ambient_faces,
    )
