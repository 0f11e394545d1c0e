"""Neighbouring pixels averaged: fewer rays, each of less noise, that together hold all that was measured.

    d = sum d_i / sigma_i^2 / sum 1 / sigma_i^2,      sigma^-2 = sum sigma_i^-2,      over the usable pixels of a bin

The ray of a bin is the exact ray through the mean of its pixels, weighted alike. Bins at the rim of the box, some of
whose rays miss it, are left out; a view that has no others keeps its pixels.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.data.measurement import Measurement, Observation
from nerif.geometry import Box, Camera, Rays

__all__ = ["binned_rays", "coarsest_edge", "patches"]

FEWEST = 128
"""Bins that an image keeps along its shorter side, so that they blur no more than the pixels of a small camera."""


def coarsest_edge(measurement: Measurement) -> int:
    """Return the largest edge of bins that every image of the measurement can do with, a power of two, px."""
    shortest = min(min(camera.image_size) for camera in measurement.cameras)
    return int(1 << max(0, (shortest // FEWEST).bit_length() - 1))


def binned_rays(
    measurement: Measurement, observation: Observation, edge: int, open_faces: tuple[str, ...] = ()
) -> tuple[Rays, Float[Tensor, "n c"], Float[Tensor, "n c"]]:
    """Return rays, values and sigma of square bins of the usable pixels that cross none of the open faces.

    Where sigma is not known, that of a pixel counts as 1.

    Parameters
    ----------
    observation : what was measured by one technique
    edge : of a bin, px
    """
    usable, channels = measurement.usable_for(observation), observation.values.shape[-1]
    parts, values, sigma = [], [], []
    for i, camera in enumerate(measurement.cameras):
        height, width = camera.image_size
        mask = usable[i, :height, :width]
        if not bool(mask.any()):
            continue
        camera = observation.technique.seen_by(camera)
        keep = _inside(camera, measurement.box, edge, open_faces) & (_sums(mask[..., None].double(), edge)[..., 0] > 0)
        own = edge if bool(keep.any()) else 1
        known = None if observation.sigma is None else observation.sigma[i, :height, :width]
        weight = mask[..., None].expand(height, width, channels).double()
        if known is not None:
            weight = torch.where(mask[..., None], known.double().pow(-2), 0.0)
        d = torch.where(mask[..., None], observation.values[i, :height, :width], 0.0)
        total = _sums(weight, own)
        mean = total.mean(-1, keepdim=True)
        moment = _sums(weight.mean(-1, keepdim=True) * camera.pixel_grid(), own)
        keep = (mean[..., 0] > 0) & (keep if own == edge else True)
        pixels = (moment / mean)[keep].to(camera.intrinsics.dtype)
        rays = camera.rays(pixels, view=i).clip(measurement.box)
        crosses = rays.crosses
        parts.append(rays[crosses].to(dtype=torch.float32))
        values.append((_sums(weight * d, own)[keep] / total[keep])[crosses].float())
        sigma.append(total[keep][crosses].rsqrt().float())
    return Rays.concatenate(parts), torch.cat(values), torch.cat(sigma)


def patches(
    measurement: Measurement, observation: Observation, edge: int, open_faces: tuple[str, ...] = ()
) -> tuple[Rays, Float[Tensor, "n c"], Float[Tensor, "n c"]]:
    """Return the rays of bins, and value and sigma of each of their pixels, row by row.

    A pixel that is not usable has the value 0 and an infinite sigma. Where sigma is not known it counts as 1.

    Parameters
    ----------
    observation : what was measured by a technique of one channel
    edge : of a bin, px
    """
    rays, _, _ = binned_rays(measurement, observation, edge, open_faces)
    usable, within = measurement.usable_for(observation), torch.arange(edge)
    rows, columns = usable.shape[1:]
    column, row = (((rays.pixel + 0.5) / edge).floor().long() * edge).unbind(-1)
    there = row[:, None, None] + within[:, None], column[:, None, None] + within
    inside = (there[0] < rows) & (there[1] < columns)
    place = rays.view.long()[:, None, None], there[0].clamp(max=rows - 1), there[1].clamp(max=columns - 1)
    good = (usable[place] & inside).flatten(1)
    values = observation.values[place].flatten(1)
    sigma = torch.ones_like(values) if observation.sigma is None else observation.sigma[place].flatten(1)
    return rays, torch.where(good, values, 0.0).float(), torch.where(good, sigma, math.inf).float()


def _sums(x: Float[Tensor, "row column k"], edge: int) -> Float[Tensor, "r c k"]:
    """Sums over bins, those at the lower and right rim of the pixels that are left."""
    height, width, k = x.shape
    x = torch.nn.functional.pad(x.double(), (0, 0, 0, -width % edge, 0, -height % edge))
    return x.reshape(x.shape[0] // edge, edge, -1, edge, k).sum(dim=(1, 3))


def _inside(camera: Camera, box: Box, edge: int, open_faces: tuple[str, ...]) -> Bool[Tensor, "r c"]:
    """Bins at all of whose corners rays cross the box, and none of the open faces."""
    height, width = camera.image_size
    rows, columns = (torch.arange(0, n + edge, edge)[: -(-n // edge) + 1].clamp(max=n) - 0.5 for n in (height, width))
    v, u = torch.meshgrid(rows.double(), columns.double(), indexing="ij")
    rays = camera.rays(torch.stack([u, v], dim=-1).reshape(-1, 2).to(camera.intrinsics.dtype)).clip(box)
    good = rays.unobstructed & ~rays.exit_faces(box, open_faces)
    good = good.reshape(u.shape)
    return good[1:, 1:] & good[1:, :-1] & good[:-1, 1:] & good[:-1, :-1]
