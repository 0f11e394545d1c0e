"""Bins of pixels, and subsets of the pixels of a measurement.

A bin averages neighbouring pixels to one ray of less noise:

    d = sum d_i / sigma_i^2 / sum 1 / sigma_i^2,      sigma^-2 = sum sigma_i^-2,      over the usable pixels of a bin

The ray of a bin is the exact ray through the mean of its pixels with the same weights. Bins at the rim of the box, some
of whose rays miss it, are left out; a view without other bins keeps its pixels.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.blocks import blocks
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import Observation
from nerif.geometry import Box, Camera, Rays

__all__ = ["binned_rays", "coarsest_edge", "patches", "pixel_subset", "withhold_pixels"]

MIN_BINS = 128  # along the shorter side of an image, so that bins blur no more than the pixels of a small camera
MIN_PIXELS = 1 << 8  # of each technique in a subset, if it has as many
WITHHELD_SHARE, MAX_WITHHELD_SHARE, MAX_WITHHELD = 0.02, 0.1, 1 << 12  # of many pixels; of few; pixels
BLOCK = 4  # px, edge of withheld blocks: neighbours share noise, as windows of optical flow overlap


def coarsest_edge(measurement: Measurement) -> int:
    """Return the largest edge of bins that is fine enough for every image, a power of two, px."""
    shortest = min(min(camera.image_size) for camera in measurement.cameras)
    return int(1 << max(0, (shortest // MIN_BINS).bit_length() - 1))


def binned_rays(
    measurement: Measurement, observation: Observation, edge: int, open_faces: tuple[str, ...] = ()
) -> tuple[Rays, Float[Tensor, "n c"], Float[Tensor, "n c"]]:
    """Return rays, values and sigma of bins of usable pixels (edge in px), without those that cross an open face.

    An unknown sigma of a pixel counts as 1.
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
        view_edge = edge if bool(keep.any()) else 1
        weight = mask[..., None].expand(height, width, channels).double()
        if observation.sigma is not None:
            weight = torch.where(mask[..., None], observation.sigma[i, :height, :width].double().pow(-2), 0.0)
        d = torch.where(mask[..., None], observation.values[i, :height, :width], 0.0)
        total = _sums(weight, view_edge)
        mean = total.mean(-1, keepdim=True)
        moment = _sums(weight.mean(-1, keepdim=True) * camera.pixel_grid(), view_edge)
        keep = (mean[..., 0] > 0) & (keep if view_edge == edge else True)
        pixels = (moment / mean)[keep].to(camera.intrinsics.dtype)
        rays = camera.rays(pixels, view=i).clip(measurement.box)
        crosses = rays.crosses
        parts.append(rays[crosses].to(dtype=torch.float32))
        values.append((_sums(weight * d, view_edge)[keep] / total[keep])[crosses].float())
        sigma.append(total[keep][crosses].rsqrt().float())
    return Rays.concatenate(parts), torch.cat(values), torch.cat(sigma)


def patches(
    measurement: Measurement, observation: Observation, edge: int, open_faces: tuple[str, ...] = ()
) -> tuple[Rays, Float[Tensor, "n c"], Float[Tensor, "n c"]]:
    """Return the rays of bins, and value and sigma of each of their pixels, row by row, for a technique of one channel.

    An unusable pixel has the value 0 and an infinite sigma. An unknown sigma counts as 1.
    """
    rays, _, _ = binned_rays(measurement, observation, edge, open_faces)
    usable, within = measurement.usable_for(observation), torch.arange(edge)
    rows, columns = usable.shape[1:]
    column, row = (((rays.pixel + 0.5) / edge).floor().long() * edge).unbind(-1)
    row, column = row[:, None, None] + within[:, None], column[:, None, None] + within
    inside = (row < rows) & (column < columns)
    place = rays.view.long()[:, None, None], row.clamp(max=rows - 1), column.clamp(max=columns - 1)
    good = (usable[place] & inside).flatten(1)
    values = observation.values[place].flatten(1)
    sigma = torch.ones_like(values) if observation.sigma is None else observation.sigma[place].flatten(1)
    return rays, torch.where(good, values, 0.0).float(), torch.where(good, sigma, math.inf).float()


def _sums(x: Float[Tensor, "row column k"], edge: int) -> Float[Tensor, "r c k"]:
    """Sums over bins; bins at the lower and right rim have fewer pixels."""
    height, width, _ = x.shape
    x = torch.nn.functional.pad(x.double(), (0, 0, 0, -width % edge, 0, -height % edge))
    return blocks(x, edge, edge).sum(dim=(1, 3))


def _inside(camera: Camera, box: Box, edge: int, open_faces: tuple[str, ...]) -> Bool[Tensor, "r c"]:
    """Bins whose corner rays all cross the box, and no open face."""
    height, width = camera.image_size
    rows, columns = (torch.arange(0, n + edge, edge)[: -(-n // edge) + 1].clamp(max=n) - 0.5 for n in (height, width))
    v, u = torch.meshgrid(rows.double(), columns.double(), indexing="ij")
    rays = camera.rays(torch.stack([u, v], dim=-1).reshape(-1, 2).to(camera.intrinsics.dtype)).clip(box)
    good = (rays.unobstructed & ~rays.exit_faces(box, open_faces)).reshape(u.shape)
    return good[1:, 1:] & good[1:, :-1] & good[:-1, 1:] & good[:-1, :-1]


def pixel_subset(measurement: Measurement, count: int) -> Measurement:
    """Return the measurement with about `count` usable pixels, the same random ones at every call.

    Each technique keeps at least MIN_PIXELS, and a view that would lose all keeps its pixels.
    """
    usable = [measurement.usable_for(observation) for observation in measurement.observations]
    draw = torch.rand(usable[0].shape, generator=torch.Generator().manual_seed(0))
    total, keep = sum(int(mask.sum()) for mask in usable), torch.zeros_like(usable[0])
    for mask in usable:
        subset = mask & (draw < max(count / total, MIN_PIXELS / max(int(mask.sum()), 1)))
        keep |= torch.where(subset.flatten(1).any(dim=1)[:, None, None], subset, mask)
    return replace(measurement, valid=keep)


def withhold_pixels(measurement: Measurement, edge: int) -> tuple[Measurement, Measurement | None]:
    """Return the measurement without some blocks of pixels, and these alone; None if there are too few pixels.

    Blocks are at least as large as the bins of the rest (edge in px). Every view keeps pixels of each technique. Of
    each technique some are withheld, but not of every view.
    """
    usable = [measurement.usable_for(observation) & measurement.sees_box for observation in measurement.observations]
    views, height, width = usable[0].shape
    size = max(edge, BLOCK)
    total = sum(int(mask.sum()) for mask in usable)
    share = min(max(WITHHELD_SHARE, MIN_PIXELS / total), MAX_WITHHELD / total, MAX_WITHHELD_SHARE)
    blocks = torch.rand(views, -(-height // size), -(-width // size), generator=torch.Generator().manual_seed(0))
    withheld = (blocks < share).repeat_interleave(size, 1).repeat_interleave(size, 2)[:, :height, :width]
    withheld &= torch.stack(usable).any(dim=0)
    for mask in usable:
        remains, present = (mask & ~withheld).flatten(1).any(dim=1), mask.flatten(1).any(dim=1)
        withheld &= (remains | ~present)[:, None, None]
    for mask in usable:
        count = mask.flatten(1).sum(dim=1)
        if not bool((mask & withheld).any()):
            if int(count.max()) < 2:
                return measurement, None
            richest = int(count.argmax())
            row, column = mask[richest].nonzero()[int(count.max()) // 2].tolist()
            withheld[richest, row, column] = True
    valid = torch.ones_like(withheld) if measurement.valid is None else measurement.valid
    views_in = (measurement.usable & withheld).flatten(1).any(dim=1)
    subset = measurement.select([name for name, inside in zip(measurement.names, views_in, strict=True) if inside])
    return replace(measurement, valid=valid & ~withheld), replace(subset, valid=(valid & withheld)[views_in])
