"""Some of the pixels of a measurement, to judge by them what all are too many for."""

from __future__ import annotations

from dataclasses import replace

import torch

from nerif.measurement import Measurement

__all__ = ["some_pixels"]

FEWEST = 1 << 8
"""Pixels of each technique that are taken at least, if it has as many."""


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
