"""How bright each camera sees: gains of the views, fitted together with the field where no calibration tells them.

    min over f >= 0 and g of  sum_v |g_v A_v f - L_v|^2,      the geometric mean of g_v is 1

One iteration of MLEM for the field on coarse voxels and the best gains for it follow one another.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.forward.registry import forward_model
from nerif.geometry import Grid
from nerif.reconstruction.voxels.operator import VoxelOperator

__all__ = ["fit_gains", "gains_of", "with_gains"]

VOXELS = 32  # along the longest edge
ROUNDS = 200  # at most
SETTLED = 1e-5  # change of a gain in a round
DARK = 0.01  # of the median gain: a view that shows less shows nothing, and its gain is noise


def fit_gains(measurement: Measurement, voxels: int = VOXELS) -> dict[str, float]:
    """Return the gain of every view by its name, their geometric mean 1.

    Parameters
    ----------
    measurement : of emission, by two views or more; those held out have been taken out of it
    voxels : of the coarse field, along the longest edge

    Raises
    ------
    InputError
        If it is of another technique, of one view, or a view shows next to nothing of what the others see.
    """
    (observation, *others) = measurement.observations
    if others or not observation.technique.gains:
        names = " and ".join(o.technique.name for o in measurement.observations)
        raise InputError(
            f"expected emission, whose cameras may be of different brightness, got {names}", field="fit_gains"
        )
    if len(measurement.cameras) < 2:
        raise InputError("expected two views or more, got one, whose gain nothing tells", field="fit_gains")
    rays, values, _ = measurement.rays(observation)
    view, measured = rays.view.long(), values[:, 0]
    grid, model = Grid.of_resolution(measurement.box, voxels), forward_model(observation.technique, measurement)
    operator = VoxelOperator(rays, grid, model)
    reach = operator.T(torch.ones_like(values)).clamp_min(1e-12)
    field, gains = torch.ones(operator.domain_shape), torch.ones(len(measurement.cameras))
    field *= measured.clamp_min(0).sum() / operator(field).sum()
    count = len(gains)
    for _ in range(ROUNDS):
        seen = operator(field)[:, 0].clamp_min(1e-12)
        product, square = (torch.zeros(count).index_add(0, view, x) for x in (seen * measured, seen * seen))
        fresh = torch.where(square > 0, product / square.clamp_min(1e-30), torch.ones(count))
        for name, gain in zip(measurement.names, (fresh / fresh.median()).tolist(), strict=True):
            if not gain > DARK:
                raise InputError(
                    f"view '{name}' shows {gain:.2g} times what the others make expect, too little to tell "
                    f"its gain by; leave it out (--withhold {name})",
                    field="fit_gains",
                )
        fresh = fresh / fresh.log().mean().exp()
        settled = float((fresh - gains).abs().max()) < SETTLED
        gains = fresh
        field = field * operator.T((measured.clamp_min(0) / gains[view] / seen)[:, None]) / reach
        if settled:
            break
    return dict(zip(measurement.names, gains.tolist(), strict=True))


def gains_of(run: Mapping[str, Any]) -> dict[str, float]:
    """Return the gains of views that run.toml keeps, none where none were fitted.

    Raises
    ------
    InputError
        If one is no number above 0.
    """
    found = {str(name): gain for name, gain in run.get("about", {}).get("gains", {}).items()}
    for name, gain in found.items():
        if not isinstance(gain, int | float) or not 0 < gain < math.inf:
            raise InputError(f"expected a number above 0 for view '{name}', got {gain!r}", field="gains of run.toml")
    return found


def with_gains(measurement: Measurement, gains: Mapping[str, float]) -> Measurement:
    """Return the measurement with the values and sigmas of the views named divided by their gains."""
    if not gains:
        return measurement
    values, sigmas = {}, {}
    for o in measurement.observations:
        own = torch.tensor([gains.get(name, 1.0) for name in measurement.names])[:, None, None, None]
        values[o.technique.name] = o.values / own
        sigmas[o.technique.name] = None if o.sigma is None else o.sigma / own
    return measurement.observed(values, sigmas)
