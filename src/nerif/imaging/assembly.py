"""What all views measured, put together as one measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from nerif.conventions import DEFAULT_AMBIENT_FACES
from nerif.geometry import Box, Camera
from nerif.imaging.displacement import DisplacementMap
from nerif.measurement import Measurement

__all__ = ["World", "join_views"]


@dataclass(frozen=True)
class World:
    """What a measurement holds beside its views; see Measurement."""

    box: Box
    n_ambient: float
    wavelength_nm: float | None = None
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES


def join_views(
    cameras: Sequence[Camera], maps: Sequence[DisplacementMap], masks: Sequence[np.ndarray | None], world: World
) -> Measurement:
    """Return one measurement of all views; smaller pictures are padded.

    Parameters
    ----------
    cameras, maps : of the views
    masks : (row, column) where the flow is, or None where a view has no mask
    """
    sizes = [m.valid.shape for m in maps]
    height, width = max(s[0] for s in sizes), max(s[1] for s in sizes)

    def stack(arrays: Sequence[np.ndarray], fill: float | bool) -> torch.Tensor:
        whole = [
            np.pad(
                a,
                [(0, height - a.shape[0]), (0, width - a.shape[1])] + [(0, 0)] * (a.ndim - 2),
                constant_values=fill,
            )
            for a in arrays
        ]
        return torch.from_numpy(np.stack(whole))

    everywhere = [np.ones(m.valid.shape, dtype=bool) for m in maps]  # no mask says nothing about where the flow is
    filled = [e if mask is None else mask for mask, e in zip(masks, everywhere, strict=True)]
    return Measurement(
        cameras=tuple(cameras),
        displacement=stack([m.displacement for m in maps], np.nan),
        box=world.box,
        n_ambient=world.n_ambient,
        sigma=stack([m.sigma for m in maps], np.nan),
        valid=stack([m.valid for m in maps], False),
        flow_mask=stack(filled, False) if any(mask is not None for mask in masks) else None,
        wavelength_nm=world.wavelength_nm,
        ambient_faces=world.ambient_faces,
    )
