"""Training data: rays with their measured values, and points at which the refractive index is ambient.

The random order of rays is computed on demand by a Feistel network on pairs of numbers below a = ceil(sqrt(count)):
each round exchanges the two and adds a hash of one to the other, modulo a, which is one-to-one. Numbers at or beyond
count pass through it again.

Source: Black & Rogaway, Ciphers with arbitrary finite domains, CT-RSA (2002).
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.fields.network import NeuralField
from nerif.fields.network_kinds import network_in
from nerif.forward.images import Images
from nerif.forward.path_integral import PathIntegral, project
from nerif.reconstruction.aperture import apply_aperture, lens_rays
from nerif.reconstruction.bins import coarsest_edge, withhold_pixels
from nerif.reconstruction.bounds import field_bounds, in_units
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.field_files import fingerprint
from nerif.reconstruction.gauge import Gauge, is_open, with_gauge
from nerif.reconstruction.neural.training_settings import TrainingSettings
from nerif.reconstruction.rig_groups import refined_groups
from nerif.reconstruction.rig_parameters import RefinedView
from nerif.reconstruction.rig_refinement import Refinement, load_rig, random_pixels, rig_state
from nerif.reconstruction.sources import of_source, resolve_source, stages
from nerif.reconstruction.target import Target, TechniqueData, check_target
from nerif.reconstruction.voxels.symmetry_axis import axis_of

__all__ = ["TrainingData", "shuffled"]

ROUNDS = 6
MULTIPLIER = 0x9E3779B1  # 2^32 / golden ratio, odd
NUISANCE_PIXELS, NUISANCE_SAMPLES = 1024, 24  # per view; per ray


def shuffled(first: int, length: int, count: int, seed: int) -> Int[Tensor, " n"]:
    """Return `length` places from `first` of an endless random order with each of 0 .. count - 1 once per epoch."""
    place = np.arange(first, first + length, dtype=np.int64)
    epochs = place // count
    parts = [
        _permuted(place[epochs == epoch] % count, count, _hash(seed * MULTIPLIER + epoch))
        for epoch in range(first // count, (first + length - 1) // count + 1)
    ]
    return torch.from_numpy(np.concatenate(parts))


def _permuted(x: Int[np.ndarray, " n"], count: int, key: int) -> Int[np.ndarray, " n"]:
    side = math.isqrt(count - 1) + 1
    left, right = np.divmod(x, side)
    for turn in range(ROUNDS):
        mixed = (right + key + turn * MULTIPLIER) & 0x7FFFFFFF
        mixed = ((mixed ^ (mixed >> 15)) * 0x2C1B3C6D) & 0x7FFFFFFF
        mixed = ((mixed ^ (mixed >> 12)) * 0x297A2D39) & 0x7FFFFFFF
        left, right = right, (left + (mixed ^ (mixed >> 15))) % side
    x = left * side + right
    outside = x >= count
    if outside.any():
        x[outside] = _permuted(x[outside], count, key)
    return x


def _hash(x: int) -> int:
    """31 bits, each of which depends on every bit of x."""
    for factor in (0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53):
        x = ((x ^ (x >> 33)) * factor) & 0xFFFFFFFFFFFFFFFF
    return (x >> 33) & 0x7FFFFFFF


class TrainingData:
    """The rays of a measurement with their measured values, and points at which the field is ambient.

    Parameters
    ----------
    coarsest : edge of the first bins, px; None for one that suits the size of the images
    withhold : whether to withhold some pixels

    Attributes
    ----------
    fingerprint : digest of each part of the data
    gauge_free : whether the data leave a constant of the field undetermined
    gauge : where the field is known, or None
    bounds : lowest and highest value of the field
    shape, samples : of the network; per ray at the start and at the end of a run
    lens_rays : rays per pixel at the end of a run; 1 without a lens
    withheld : withheld pixels, which are in no batch; None if there are none
    stage, label : stage of the run and what its loss compares with (sources.py)
    axis : of a symmetric flow
    refinement : of the rig, or None
    noise : mean square of the noise over that of the signal; 0 if unknown
    """

    withheld: Target | None = None
    stage: int = 0
    refinement: Refinement | None = None

    def __init__(
        self, settings: TrainingSettings, measurement: Measurement, coarsest: int | None = None, withhold: bool = False
    ) -> None:
        measurement = with_gauge(apply_aperture(measurement, settings.aperture), settings)
        # images do not determine a shift
        preferred = "displacements" if "shift" in refined_groups(settings.refine) else "images"
        source = resolve_source(measurement, settings.source, preferred)
        final = of_source(measurement, source)
        check_target(final, settings.model)
        self.device = resolve_device(settings.device)
        self.fingerprint = fingerprint(final, settings.open_faces, settings.refine)
        self.box, self.n_ambient, self.quantity = measurement.box, measurement.n_ambient, measurement.quantity
        self.gauge_free = is_open(measurement)
        settings = settings.resolved_by(measurement)
        self.shape, self.samples = settings.network, settings.samples
        self.settings, self.measurement = settings, measurement
        self.coarsest = coarsest_edge(measurement) if coarsest is None else coarsest
        self.gauge = Gauge.of(measurement, settings.probes)
        self.bounds = field_bounds(measurement, settings.lower, settings.upper)
        self.axis = axis_of(settings, measurement)
        self.lens_rays = lens_rays(measurement, settings.lens_rays)
        if settings.refine:
            self.refinement = Refinement.for_measurement(
                final, settings.refine, settings.pose_sigma_mm, settings.pose_sigma_deg, settings.shift_sigma_px
            )
        if withhold:
            rest, withheld = withhold_pixels(measurement, self.coarsest)
            with suppress(InputError):  # all withheld rays cross an open face
                if withheld is not None:
                    withheld = of_source(withheld, source)
                    self.withheld_names = withheld.names
                    target = Target.of(withheld, settings.open_faces, model=settings.model, single=True)
                    self.withheld = target.without_outliers().to(self.device)
                    self.measurement = rest
        self.stages = stages(self.measurement, source)
        self.set_bins(self.coarsest)

    def set_bins(self, edge: int) -> None:
        """Use bins of that edge, px."""
        settings, stage, self.edge = self.settings, self.stages[self.stage], edge
        measurement, self.label = stage.measurement(), stage.words
        self.target = Target.of(measurement, settings.open_faces, edge, settings.model).to(self.device)
        self.names = measurement.names
        self.noise, self.sigma_known = self.target.noise or 0.0, self.target.sigma_known

    def advance(self, progress: float) -> bool:
        """Switch to the stage of that share of a run or of its first cycle; return whether a new one began."""
        stage = max(i for i, stage in enumerate(self.stages) if stage.begin <= progress)
        if stage <= self.stage:
            return False
        other = self.stages[stage].measurement is not self.stages[self.stage].measurement
        self.stage = stage
        if other:
            self.set_bins(self.edge)
        return True

    def __len__(self) -> int:
        return len(self.target)

    def batch(self, index: Int[Tensor, " b"]) -> list[TechniqueData]:
        """Return rays by index with their measured values, one part per technique."""
        return [self.with_rig(part) for part in self.target[index].parts if len(part)]

    def with_rig(self, part: TechniqueData, withheld: bool = False) -> TechniqueData:
        """Return a part, of withheld pixels or not, with the refined rig."""
        if self.refinement is None:
            return part
        names = self.withheld_names if withheld else self.names
        return self.refinement.of(part, [self.refinement.names.index(name) for name in names])

    def rig(self) -> list[RefinedView]:
        """Return the present corrections of the cameras; none if they are not refined."""
        return [] if self.refinement is None else self.refinement.table()

    def rig_pixels(self, seed: int) -> list[TechniqueData]:
        """Draw pixels for a step of the rig, with their calibrated rays; none in a stage without all views."""
        if self.refinement is None or self.names != self.refinement.names:
            return []
        return random_pixels(self.target, len(self.names), seed)

    def initial_field(self) -> NeuralField:
        """Return a field within the bounds, with random weights from torch's global generator."""
        bounds = in_units(self.bounds, self.target.scale)
        symmetry = None if self.axis is None else self.axis.symmetry
        network = network_in(self.box, self.shape, bounds, symmetry, self.measurement.bodies)
        return NeuralField(network.to(self.device), self.box, self.target.scale)

    # -- nuisance parameters: fitted besides the field, such as the brightness of images -------------------------------

    @torch.no_grad()
    def fit_nuisance(self, field: NeuralField) -> None:
        """Fit nuisance parameters to a field, at random pixels."""
        generator = torch.Generator().manual_seed(self.stage)
        for part in self.target.parts:
            if part.images is not None:
                index = torch.randperm(len(part), generator=generator)[: NUISANCE_PIXELS * len(self.names)]
                pixels = self.with_rig(part[index.to(self.device)])
                rays = replace(pixels.rays, lens=None)
                integral = project(PathIntegral(pixels.model, NUISANCE_SAMPLES), field, rays, self.device)
                part.images.fit_nuisance(integral, pixels.measured, pixels.inverse_scale, rays)

    def copy_nuisance(self) -> None:
        """Give withheld pixels the nuisance parameters of the others."""
        if self.withheld is not None:
            for images, other in zip(_images(self.target), _images(self.withheld), strict=False):
                other.set_nuisance(images.nuisance[[self.names.index(name) for name in self.withheld_names]])

    def state_dict(self) -> dict[str, Tensor]:
        """Return nuisance parameters and rig for a checkpoint."""
        nuisance = {str(i): images.nuisance.clone() for i, images in enumerate(_images(self.target))}
        return nuisance | rig_state(self.refinement)

    def load_state_dict(self, stage: int, state: dict[str, Tensor], edge: int | None = None) -> None:
        """Continue in a stage, with bins of an edge (px), with the nuisance parameters and the rig of a checkpoint."""
        edge = self.edge if edge is None else edge
        if (stage, edge) != (self.stage, self.edge):
            self.stage = stage
            self.set_bins(edge)
        for i, images in enumerate(_images(self.target)):
            images.set_nuisance(state[str(i)])
        load_rig(self.refinement, state)


def _images(target: Target) -> list[Images]:
    return [part.images for part in target.parts if part.images is not None]
