"""Standard deviations of velocity and pressure, from samples of their distribution given the film.

Each sample is the minimum of the objective with noise added to the film and to the controls expected a priori.

Source: Bardsley, Solonen, Haario & Laine, SIAM J. Sci. Comput. 36 (2014) A1895 (randomize, then optimize).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.flow.flow import FlowDeviations
from nerif.flow.frame_resampling import smooth
from nerif.flow.velocity_problem import VelocityProblem, minimise

__all__ = ["deviations_of"]

WIDTHS = (1.5, 1.5, 1.5)  # voxels over which variances of few samples are averaged


def deviations_of(
    problem: VelocityProblem, controls: Float[Tensor, "t 3 z y x"], samples: int, iterations: int,
    report: Callable[[float], float], limit: float = math.inf,
) -> FlowDeviations | None:  # fmt: skip
    """Return standard deviations about the velocity of given controls; None if the limit left no time for two samples.

    Parameters
    ----------
    problem : on a grid that may be coarser than that of the velocity
    controls : near the minimum
    samples : their number
    iterations : of each
    report : called with the misfit of every evaluation, returns a figure such as the time
    limit : of that figure
    """
    generator, seconds = torch.Generator().manual_seed(0), -math.inf

    def progress(misfit: float, best: Tensor, done: int) -> float:
        nonlocal seconds
        seconds = report(misfit)
        return seconds

    near, *_ = minimise(problem, controls, iterations, 0, limit, progress)
    problem.weigh(near)  # the residual of controls from another grid does not show the noise
    centre, *_ = minimise(problem, near, iterations, 0, limit, progress)
    mean = problem.flow(centre)
    velocity = torch.zeros_like(mean.velocity)
    pressure = None if mean.pressure is None else torch.zeros_like(mean.pressure)
    count = 0
    for _ in range(samples):
        noise = problem.sample(generator)
        minimum, *_ = minimise(problem, centre + noise.controls, iterations, 0, limit, progress, noise)
        if seconds > limit:  # not at its minimum
            break
        flow, count = problem.flow(minimum), count + 1
        velocity += (flow.velocity - mean.velocity).square()
        if pressure is not None and flow.pressure is not None and mean.pressure is not None:
            pressure += (flow.pressure - mean.pressure).square()
    if count < min(2, samples):
        return None
    return FlowDeviations(
        mean.grid, smooth(velocity / count, WIDTHS).clamp_min(0).sqrt(),
        None if pressure is None else smooth(pressure / count, WIDTHS).clamp_min(0).sqrt(),
    )  # fmt: skip
