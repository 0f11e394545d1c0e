"""Training data: rays with their measured values, and points at which the refractive index is ambient.

Rays are drawn in a random order computed on demand, by a Feistel network on pairs of numbers below
a = ceil(sqrt(count)): each round exchanges the two and adds a hash of one to the other, modulo a, which is one-to-one.
Numbers at or beyond count pass through it again.

Source: Black & Rogaway, Ciphers with arbitrary finite domains, CT-RSA (2002).
"""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.transfer import sent
from nerif.data.measurement import Measurement
from nerif.fields.network import Network, NeuralField
from nerif.fields.symmetric import SymmetricNetwork
from nerif.forward.base import ForwardModel
from nerif.reconstruction.aperture import lens_rays, seen_through
from nerif.reconstruction.bounds import field_bounds, in_units
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.files import fingerprint
from nerif.reconstruction.gauge import AmbientRegion, is_open
from nerif.reconstruction.neural.bins import coarsest_edge
from nerif.reconstruction.neural.settings import TrainingSettings
from nerif.reconstruction.neural.some_pixels import hold_back
from nerif.reconstruction.rig.numbers import refined_words
from nerif.reconstruction.rig.refined import kept_of, take_up
from nerif.reconstruction.rig.refinement import Refinement, drawn
from nerif.reconstruction.sources import chosen_source, of_source, stages
from nerif.reconstruction.symmetry import axis_of
from nerif.reconstruction.target import Part, Target, check_target

__all__ = ["TrainingData", "shuffled"]

ROUNDS = 6
MULTIPLIER = 0x9E3779B1  # 2^32 / golden ratio, odd


def shuffled(first: int, length: int, count: int, seed: int) -> Int[Tensor, " n"]:
    """Return places first .. first + length - 1 of an endless order that has each of 0 .. count - 1 once an epoch.

    Parameters
    ----------
    first : place, counted from the first epoch's beginning
    count : things to put in order
    seed : of the order; each epoch has its own
    """
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
    """Thirty-one bits that change all when one of x does."""
    for factor in (0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53):
        x = ((x ^ (x >> 33)) * factor) & 0xFFFFFFFFFFFFFFFF
    return (x >> 33) & 0x7FFFFFFF


SETTLED_BY = 1024  # pixels a view


class TrainingData:
    """The rays of a measurement with what they measured, and points at which its field is ambient.

    Parameters
    ----------
    settings : TrainingSettings
    measurement : Measurement
    coarsest : edge of the bins to begin with, px; None for what an image of its size can do with
    judged : whether some of the rays are held back

    Attributes
    ----------
    fingerprint : a digest of each part of the data, by its name
    open : whether the data leave a constant of the field open
    bounds : lowest and highest value of the field
    shape, samples : of the network, and of a ray at the start and at the end of a run
    lens_rays : rays through the lens of a pixel at the end of a run; 1 for a thin one
    withheld : rays that are in no batch, to judge by them; None where there are none
    stage, met : part of the run that the data are given for, and what the loss is of in it
    axis : of a symmetric flow
    refinement : of the rig, or None where it is as calibrated
    noise : mean square of the noise over that of what was measured; 0 where it is not known
    """

    withheld: Target | None = None
    stage: int = 0
    refinement: Refinement | None = None

    def __init__(
        self, settings: TrainingSettings, measurement: Measurement, coarsest: int | None = None, judged: bool = False
    ) -> None:
        measurement = seen_through(measurement, settings.aperture)
        preferred = "displacements" if "shift" in refined_words(settings.refine) else "images"  # these tell no shift
        source = chosen_source(measurement, settings.source, preferred)
        final = of_source(measurement, source)
        check_target(final, settings.model)
        self.device, self.fingerprint = resolve_device(settings.device), fingerprint(final, settings.open_faces)
        self.box, self.n_ambient, self.quantity = measurement.box, measurement.n_ambient, measurement.quantity
        self.open = is_open(measurement)
        settings = settings.resolved_by(measurement)
        self.shape, self.samples = settings.network, settings.samples
        self.settings, self.measurement = settings, measurement
        self.coarsest = coarsest_edge(measurement) if coarsest is None else coarsest
        self.ambient = AmbientRegion.of(measurement, settings.ambient_faces)
        self.bounds = field_bounds(measurement, settings.lower, settings.upper)
        self.axis = axis_of(settings, measurement)
        self.lens_rays = lens_rays(measurement, settings.lens_rays)
        if settings.refine:
            self.refinement = Refinement.asked(
                final, settings.refine, settings.pose_sigma_mm, settings.pose_sigma_deg, settings.shift_sigma_px
            )
        if judged:
            rest, held = hold_back(measurement, self.coarsest)
            with suppress(InputError):  # all that would be held back crosses an open face
                if held is not None:
                    judges = of_source(held, source)
                    self.judging = judges.names
                    self.withheld = (
                        Target.of(judges, settings.open_faces, model=settings.model, single=True)
                        .without_outliers()
                        .to(self.device)
                    )
                    self.measurement = rest
        self.stages, self.edge = stages(self.measurement, source), self.coarsest
        self.refine(self.coarsest)

    def refine(self, edge: int) -> None:
        """Give bins of another edge, px, from now on."""
        settings, self.edge = self.settings, edge
        seen, self.met = self.stages[self.stage].measurement(), self.stages[self.stage].words
        self.target = Target.of(seen, settings.open_faces, edge, settings.model).to(self.device)
        self.names = seen.names
        self.noise = self.target.noise or 0.0
        self.sigma_known = self.target.sigma_known

    def advance(self, progress: float) -> bool:
        """Switch to the data of that share of a run, or of its first cycle; return whether a new part began."""
        reached = max(i for i, stage in enumerate(self.stages) if stage.begin <= progress)
        if reached <= self.stage:
            return False
        other = self.stages[reached].measurement is not self.stages[self.stage].measurement
        self.stage = reached
        if other:
            self.refine(self.edge)
        return True

    @property
    def unsettled(self) -> list[Part]:
        """Some rays of whatever has to be fitted beside the field (ForwardModel.settle)."""
        generator = torch.Generator().manual_seed(self.stage)
        parts = [part for part in self.target.parts if part.model.settles]
        some = [torch.randperm(len(part), generator=generator)[: SETTLED_BY * len(self.names)] for part in parts]
        return [self.refined(part[index.to(self.device)]) for part, index in zip(parts, some, strict=True)]

    def kept(self) -> dict[str, Tensor]:
        """Return what has been fitted beside the field, as a checkpoint keeps it."""
        kept = {str(i): model.brightness.clone() for i, model in enumerate(_settling(self.target))}
        return kept | kept_of(self.refinement)

    def restore(self, stage: int, kept: dict[str, Tensor]) -> None:
        """Go on in that part of a run with what was fitted beside the field."""
        if stage != self.stage:
            self.stage = stage
            self.refine(self.edge)
        for i, model in enumerate(_settling(self.target)):
            model.adopt(kept[str(i)])
        take_up(self.refinement, kept)

    def judge_alike(self) -> None:
        """Let the images that are held back be as bright as those that are not."""
        if self.withheld is not None:
            for model, judge in zip(_settling(self.target), _settling(self.withheld), strict=False):
                judge.adopt(model.brightness[[self.names.index(name) for name in self.judging]])

    def __len__(self) -> int:
        return len(self.target)

    def batch(self, index: Int[Tensor, " b"]) -> list[Part]:
        """Return the rays of those numbers with what they measured, technique by technique."""
        return [self.refined(part) for part in self.target[index].parts if len(part)]

    def refined(self, part: Part, withheld: bool = False) -> Part:
        """Return a part, of the rays held back or of the others, as the refined rig has it."""
        if self.refinement is None:
            return part
        names = self.judging if withheld else self.names
        return self.refinement.of(part, [self.refinement.names.index(name) for name in names])

    def refined_by(self, seed: int) -> list[Part]:
        """Draw pixels that the rig is refined by, with their calibrated rays, residuals in units of sigma."""
        if self.refinement is None or self.names != self.refinement.names:
            return []  # a part of the run that has not all views
        return drawn(self.target, len(self.names), seed)

    def ambient_points(self, count: int, generator: torch.Generator) -> Float[Tensor, "n 3"] | None:
        """Draw about `count` points at which the field is ambient, mm; None if none is known."""
        return None if self.ambient is None else sent(self.ambient.sample(count, generator), self.device)

    def untrained(self) -> NeuralField:
        """Return a field with random weights, drawn from torch's own generator, that cannot leave its bounds."""
        bounds = in_units(self.bounds, self.target.scale)
        if self.axis is None:
            network = Network(self.shape, bounds=bounds)
        else:
            own = self.axis.symmetry.in_units(self.box.centre, max(self.box.edges) / 2)
            network = SymmetricNetwork(self.shape, own, bounds)
        return NeuralField(network.to(self.device), self.box, self.target.scale)


def _settling(target: Target) -> list[ForwardModel]:
    """The models with something to fit beside the field."""
    return [part.model for part in target.parts if part.model.settles]
