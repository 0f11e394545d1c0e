"""Intensity gains of the cameras, fitted together with the field where no calibration gives them.

    min over f >= 0 and g of  sum_v |g_v A_v f - L_v|^2,      the geometric mean of g_v is 1

Alternates between one MLEM iteration for the field on coarse voxels and the optimal gains for it.
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

COARSE_VOXELS = 32  # along the longest edge
MAX_ITERATIONS = 200
TOLERANCE = 1e-5  # change of a gain in one iteration
MIN_GAIN = 0.01  # of the median gain: the gain of a darker view is noise


def fit_gains(measurement: Measurement) -> dict[str, float]:
    """Return the gain of every view by its name, with a geometric mean of 1.

    Parameters
    ----------
    measurement : of emission, two views or more, without withheld views
    """
    (observation, *others) = measurement.observations
    if others or not observation.technique.gains:
        names = " and ".join(o.technique.name for o in measurement.observations)
        raise InputError(f"expected emission alone, got {names}; no other technique has gains", field="fit_gains")
    if len(measurement.cameras) < 2:
        raise InputError("expected two views or more, got one; gains are relative to other views", field="fit_gains")
    rays, values, _ = measurement.rays(observation)
    view, measured = rays.view.long(), values[:, 0]
    grid, model = Grid.of_resolution(measurement.box, COARSE_VOXELS), forward_model(observation.technique, measurement)
    operator = VoxelOperator(rays, grid, model)
    sensitivity = operator.T(torch.ones_like(values)).clamp_min(1e-12)
    field, gains = torch.ones(operator.domain_shape), torch.ones(len(measurement.cameras))
    field *= measured.clamp_min(0).sum() / operator(field).sum()
    count = len(gains)
    for _ in range(MAX_ITERATIONS):
        predicted = operator(field)[:, 0].clamp_min(1e-12)
        products = (predicted * measured, predicted * predicted)
        product, square = (torch.zeros(count).index_add(0, view, x) for x in products)
        update = torch.where(square > 0, product / square.clamp_min(1e-30), torch.ones(count))
        for name, gain in zip(measurement.names, (update / update.median()).tolist(), strict=True):
            if not gain > MIN_GAIN:
                raise InputError(
                    f"expected a gain above {MIN_GAIN:g} of the median, got {gain:.2g} for view '{name}'; "
                    f"leave it out (--withhold {name})",
                    field="fit_gains",
                )
        update = update / update.log().mean().exp()
        converged = float((update - gains).abs().max()) < TOLERANCE
        gains = update
        field = field * operator.T((measured.clamp_min(0) / gains[view] / predicted)[:, None]) / sensitivity
        if converged:
            break
    return dict(zip(measurement.names, gains.tolist(), strict=True))


def gains_of(run: Mapping[str, Any]) -> dict[str, float]:
    """Return the gains stored in run.toml by the name of the view; empty where none were fitted."""
    gains = {str(name): gain for name, gain in run.get("about", {}).get("gains", {}).items()}
    for name, gain in gains.items():
        if not isinstance(gain, int | float) or not 0 < gain < math.inf:
            raise InputError(f"expected a number above 0 for view '{name}', got {gain!r}", field="gains of run.toml")
    return gains


def with_gains(measurement: Measurement, gains: Mapping[str, float]) -> Measurement:
    """Return the measurement with the values and sigmas of the views named divided by their gains."""
    if not gains:
        return measurement
    gain = torch.tensor([gains.get(name, 1.0) for name in measurement.names])[:, None, None, None]
    observations = measurement.observations
    values = {o.technique.name: o.values / gain for o in observations}
    sigmas = {o.technique.name: None if o.sigma is None else o.sigma / gain for o in observations}
    return measurement.observed(values, sigmas)
