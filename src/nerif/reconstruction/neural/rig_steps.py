"""Steps of the rig refinement (rig_refinement.py) during the training of a network."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerif.fields.network import NeuralField
from nerif.forward.path_integral import PathIntegral
from nerif.geometry import Rays
from nerif.reconstruction.neural.sampling import SamplingDensity, sample_rays
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.rig_refinement import MOMENTUM
from nerif.reconstruction.target import TechniqueData

__all__ = ["refine_rig"]

SAMPLES, LENS_RAYS, BATCH = 16, 4, 512  # samples of a thin ray, rays through a lens, pixels
BEGIN, EVERY, UNTIL, SLOW_FROM = 0.1, 0.04, 0.94, 0.75  # shares of the run
SIGN_UNTIL, EARLY, EARLY_FACTOR = 0.5, 0.26, 1.7  # a pose error must show by then; early ones by this factor clearer


@torch.no_grad()
def refine_rig(data: TrainingData, field: NeuralField, density: SamplingDensity, progress: float) -> None:
    """Take a step of the rig with the present field, if it is refined and a step is due at this share of the run."""
    rig = data.refinement
    if rig is None:
        return
    due = math.ceil((min(progress, UNTIL) - BEGIN) / EVERY)
    if rig.steps > max(due, 0) + 1:  # of the previous cycle
        rig.steps = 0
    if rig.steps >= due or (progress > SIGN_UNTIL and not rig.off):
        return

    def predict(part: TechniqueData, rays: Rays) -> Tensor:
        generator = torch.Generator().manual_seed(rig.steps)  # the same samples for all poses
        integrals = []
        for index in torch.arange(len(rays)).split(BATCH):
            batch, each, count = rays[index], 1, SAMPLES
            if batch.lens is not None:
                batch, each, count = batch.spread(LENS_RAYS, generator), LENS_RAYS, SAMPLES // 2
            s, step = sample_rays(batch, count, generator, "adaptive", density, each)
            integral = PathIntegral(part.model).along(field, batch, s, step)
            integrals.append(integral if each == 1 else batch.mean_of(each, integral))
        return torch.cat(integrals)

    momentum = MOMENTUM if progress < SLOW_FROM else 0.0
    rig.step(data.rig_pixels(rig.steps), predict, data.sigma_known, momentum, EARLY_FACTOR if progress < EARLY else 1.0)
