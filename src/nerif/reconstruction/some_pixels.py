"""Some of the pixels of a measurement: those that judge what bins leave, and those held back from training."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from nerif.measurement import Measurement

__all__ = ["held_back", "some_pixels"]

FEWEST = 1 << 8
"""Pixels of each technique that are taken at least, if it has as many."""


def some_pixels(measurement: Measurement, count: int, edge: int = 1) -> Measurement:
    """Return the measurement with about so many usable pixels, drawn at random, the same every time.

    Parameters
    ----------
    count : pixels, at about
    edge : of the square blocks that are taken whole, px
    """
    return replace(measurement, valid=_chosen(measurement, count, edge))


def held_back(measurement: Measurement, count: int, edge: int = 1) -> tuple[Measurement, Measurement]:
    """Return the measurement without some pixels, and with those alone; a view that is left none keeps all in both."""
    chosen = _chosen(measurement, count, edge)
    rest = measurement.usable & ~chosen
    for observation in measurement.observations:
        mask = measurement.usable_for(observation)
        rest |= mask & ~(rest & mask).flatten(1).any(dim=1)[:, None, None]
    return replace(measurement, valid=rest), replace(measurement, valid=chosen)


def _chosen(measurement: Measurement, count: int, edge: int) -> Bool[Tensor, "view row column"]:
    """Usable pixels in blocks; of each technique a few at least, and of each view that shows it one block or all."""
    usable = [measurement.usable_for(observation) for observation in measurement.observations]
    views, rows, columns = usable[0].shape
    blocks = torch.rand(
        views, -(-rows // edge), -(-columns // edge), generator=torch.Generator().manual_seed(0)
    ).repeat_interleave(edge, dim=1)[:, :rows]
    draw = blocks.repeat_interleave(edge, dim=2)[:, :, :columns]
    total, keep = sum(int(mask.sum()) for mask in usable), torch.zeros_like(usable[0])
    for mask in usable:
        share = max(count / max(total, 1), FEWEST / max(int(mask.sum()), 1))
        own = mask & (draw < share)
        keep |= torch.where(own.flatten(1).any(dim=1)[:, None, None], own, mask)
    return keep
