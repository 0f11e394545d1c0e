"""Some of the pixels of a measurement: to judge by them what all are too many for, or what the others lead to."""

from __future__ import annotations

from dataclasses import replace

import torch

from nerif.data.measurement import Measurement

__all__ = ["hold_back", "some_pixels"]

FEWEST = 1 << 8
"""Pixels of each technique that are taken at least, if it has as many."""

WITHHELD_PIXELS, LARGEST, MOST = 0.02, 0.1, 1 << 12
"""Share of the pixels that is held back of many, of few, and how many at most."""
BLOCK = 4
"""Edge of the blocks that are held back, px: the noise of neighbours is alike where optical flow looked at both."""


def some_pixels(measurement: Measurement, count: int) -> Measurement:
    """Return the measurement with about so many usable pixels, drawn at random, the same every time.

    Of each technique there are a few at least, and a view that would be left none keeps all that it has.
    """
    usable = [measurement.usable_for(observation) for observation in measurement.observations]
    draw = torch.rand(usable[0].shape, generator=torch.Generator().manual_seed(0))
    total, keep = sum(int(mask.sum()) for mask in usable), torch.zeros_like(usable[0])
    for mask in usable:
        own = mask & (draw < max(count / total, FEWEST / max(int(mask.sum()), 1)))
        keep |= torch.where(own.flatten(1).any(dim=1)[:, None, None], own, mask)
    return replace(measurement, valid=keep)


def hold_back(measurement: Measurement, edge: int) -> tuple[Measurement, Measurement | None]:
    """Return the measurement without some blocks of pixels, and those alone; None where there are too few for that.

    Every view keeps some of each technique, and of each technique some are held back, but not of every view.

    Parameters
    ----------
    edge : of the bins that the rest is averaged in, px; a block is as large at least
    """
    usable = [measurement.usable_for(observation) & measurement.sees_box for observation in measurement.observations]
    views, height, width = usable[0].shape
    size = max(edge, BLOCK)
    total = sum(int(mask.sum()) for mask in usable)
    share = min(max(WITHHELD_PIXELS, FEWEST / total), MOST / total, LARGEST)
    blocks = torch.rand(views, -(-height // size), -(-width // size), generator=torch.Generator().manual_seed(0))
    held = (blocks < share).repeat_interleave(size, 1).repeat_interleave(size, 2)[:, :height, :width]
    held &= torch.stack(usable).any(dim=0)
    for mask in usable:
        left, own = (mask & ~held).flatten(1).any(dim=1), mask.flatten(1).any(dim=1)
        held &= (left | ~own)[:, None, None]
    for mask in usable:
        count = mask.flatten(1).sum(dim=1)
        if not bool((mask & held).any()):
            if int(count.max()) < 2:
                return measurement, None
            richest = int(count.argmax())
            row, column = mask[richest].nonzero()[int(count.max()) // 2].tolist()
            held[richest, row, column] = True
    valid = torch.ones_like(held) if measurement.valid is None else measurement.valid
    some = (measurement.usable & held).flatten(1).any(dim=1)
    seen = measurement.select([name for name, own in zip(measurement.names, some, strict=True) if own])
    return replace(measurement, valid=valid & ~held), replace(seen, valid=(valid & held)[some])
