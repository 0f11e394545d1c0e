"""Is any view predicted by the others at all? And if none is, which error of the whole rig explains it?

The agreement of a view with what the others predict cannot be more than that of its pixels with their neighbours, which
noise lowers alike. Where it is a small part of that in most views, the rig is wrong as a whole. Errors that are common
in calibrations (geometry/plausibility.py), and pictures under the names of other cameras, are undone one at a time, and
the one without which views agree is the likely cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import torch

from nerif.analysis.consistency import compare, orders, predicted_by_others, values_of, with_values
from nerif.common.conventions import InputError
from nerif.common.findings import Finding
from nerif.data.measurement import Measurement
from nerif.geometry.plausibility import suspects

__all__ = ["NOISY", "repeatable", "unrelated", "unrelated_finding"]

LITTLE = 0.2  # of what pixels agree with their neighbours: correct rigs reach 0.38 and more, wrong ones at most 0.15
ENOUGH = 0.35  # of the same, that views reach without the likely cause
NOISY = 0.3  # agreement of neighbouring pixels below which noise hides whether views agree
SAME = 0.02  # of agreement, which tells no cause from another
JUDGES = 3  # views by which a cause is judged


def repeatable(small: Measurement) -> float:
    """Return the correlation (about 0) of neighbouring pixels, median over the views: 0 of white noise alone."""
    found = []
    for values, camera in zip(values_of(small), small.cameras, strict=True):
        height, width = camera.image_size
        d = values[:height, :width]
        along = 0 if width < 2 else 1
        a, b = d.narrow(along, 0, d.shape[along] - 1), d.narrow(along, 1, d.shape[along] - 1)
        both = torch.isfinite(a).all(dim=-1) & torch.isfinite(b).all(dim=-1)
        size = float(a[both].norm() * b[both].norm())
        found.append(float((a[both] * b[both]).sum()) / size if size > 0 else 0.0)
    return float(torch.tensor(found).median())


def unrelated(agreements: Sequence[float], small: Measurement) -> bool:
    """Return whether the views have nothing to do with one another, and it is not noise that hides it."""
    most = repeatable(small)
    return most > NOISY and float(torch.tensor(agreements).median()) < LITTLE * most


def unrelated_finding(
    small: Measurement, agreements: Sequence[float], voxels: int, suspicious: Sequence[int] = (),
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> Finding:  # fmt: skip
    """Say that no view is predicted by the others, and why that is likely so.

    Parameters
    ----------
    small : the measurement, binned
    agreements : of its views
    voxels : of the quick reconstructions, along the longest edge
    suspicious : numbers of the cameras that cannot be where they are; all may be wrong where there are none
    on_step : called with the number of causes tried, and of all
    """
    trials = _trials(small, suspicious)
    best, words = 0.0, ""
    for number, (suspected, trial) in enumerate(trials):
        with suppress(InputError):  # not a rig to reconstruct from either
            reached = _agreement(trial, voxels)
            if reached > best + SAME:  # of two that explain as much, the more common one
                best, words = reached, suspected
        on_step(number + 1, len(trials))
    if best > ENOUGH * repeatable(small):
        cause = f"likely {words}: without that the agreement is {best:.2f}"
    else:
        cause = "check units (mm), poses (world to camera), and whether each picture has the camera of its name"
    now = float(torch.tensor(agreements).median())
    sentence = f"no view is predicted by the others (agreement {now:.2f}, median of {len(agreements)}): {cause}"
    return Finding("unrelated", sentence, small.names)


def _trials(small: Measurement, suspicious: Sequence[int]) -> list[tuple[str, Measurement]]:
    """The measurement without each of the likely causes."""
    trials = []
    for suspect, cameras, box in suspects(small.cameras, small.box, suspicious or None):
        with suppress(InputError):
            trials.append((suspect.words, replace(small, cameras=cameras, box=box)))
    for correction in orders(small.cameras):
        trials.append((correction.words, with_values(small, correction.undo(values_of(small), small.cameras))))
    return trials


def _agreement(small: Measurement, voxels: int) -> float:
    """The median agreement of a few views with the others."""
    step = -(-len(small.names) // JUDGES)
    judges = range(0, len(small.names), step)
    reached = [compare(predicted_by_others(small, [i], voxels)[i], small, i)[0] for i in judges]
    return float(torch.tensor(reached).median())
