"""Settings of the training of a network: its size, its loss, where rays are sampled, rates, limits and the device."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from nerif.common.conventions import InputError
from nerif.fields.network import NetworkShape
from nerif.forward.registry import AUTO, check_model
from nerif.geometry.symmetry import NO_SYMMETRY
from nerif.reconstruction.neural.losses import LossWeights
from nerif.reconstruction.neural.optimiser import OPTIMISERS
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.sources import check_source

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["TrainingSettings"]

CHOICES = {
    "optimiser": OPTIMISERS,
    "sampling": ("adaptive", "random", "shifted", "regular"),
    "norm": ("l2", "squared"),
    "schedule": ("cosine", "constant"),
    "precision": ("auto", "float32", "tf32", "bf16"),
    "compile": ("auto", "on", "off"),
}


FIRST = 0.2  # of the limits, in a first run of two


@dataclass(frozen=True)
class TrainingSettings(SharedSettings):
    """Settings of every method that trains a network."""

    network: NetworkShape = field(default_factory=NetworkShape)
    """Size of the network."""
    wave_pixels: float = 2.5
    """Waves of the encoding that are shorter than so many pixels in the middle of the box are left out, since pixels
    cannot tell them from longer ones (paper: 0)."""
    weights: LossWeights = field(default_factory=LossWeights)
    """Weights of the terms of the loss."""
    norm: str = "squared"
    """Either "squared" residuals (maximum likelihood for Gaussian noise) or "l2", the paper's."""
    model: str = AUTO
    """Forward model: of displacements lever_arm (auto), paraxial, or curved (along the ray as the present field bends
    it); of absorption absorbance (auto), or, where little light is left and its logarithm skewed, intensity (noise of
    the detector, which is even) or poisson (counted quanta)."""
    samples: tuple[int, int] = (0, 0)
    """M at the start and at the end; a step samples N ~ Uniform(M - jitter, M + jitter) points a ray. 0 0: 12 to 24,
    twice as many of a symmetric flow seen by one camera."""
    sample_jitter: int = 4
    """Half-range of the random number of samples a ray, see samples."""
    sampling: str = "adaptive"
    """In equal intervals, one draw each ("random", the paper's), one a ray ("shifted") or midpoints ("regular"), or
    "adaptive", where the field varies."""
    source: str = "auto"
    """What to go by (also --from): displacements, images (each pixel, after a start from displacements, or from
    blurred images), both, or auto: images where there are some."""
    lens_rays: int = 0
    """Rays through the lens of a pixel at the end, an even number, and about a third of them at the start; 0: 2
    to 12, as the cone is wide in pixels."""
    points_per_batch: int = 8192
    """Sample points of a step; a step takes points_per_batch / N pixels of N points each."""
    optimiser: str = "muon"
    """Muon for weight matrices and Adam for the rest, or adam for all (the paper's)."""
    learning_rate: float = 1.5e-2
    """Adam's at its highest, for a network of 4 x 128; other shapes have shares of it (reconstruction/optimiser.py)."""
    rates_by_shape: bool = True
    """Whether Adam's rates follow the shape of the network, or are the same for all weights (the paper's)."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Adam's decay rates."""
    matrix_rate: float = 2.0
    """Muon's learning rate, in units of Adam's."""
    momentum: float = 0.9
    """Muon's."""
    warm_up: int = 15
    """Steps over which the learning rate rises, at most a sixth of max_steps; with the cosine schedule."""
    schedule: str = "cosine"
    """Learning rate: "cosine" to 1 % of the learning rate, or "constant" (the paper's)."""
    epochs: float = 0.0
    """Stop after so many passes over all rays (the paper's n_outer); 0 for no limit. Without any limit a run ends when
    rays that it is not given are met no better."""
    max_steps: int = 0
    """Stop after so many steps; 0 for no limit."""
    longest: float = 600.0
    """Seconds after which a run without a limit ends, whether more would bring anything or not (no frame of a film)."""
    first_cycle: int = 400
    """Steps after which a run without a limit first asks whether more would; then after each twice as many."""
    stop_ratio: float = 0.0
    """Stop when the loss is below this share of that of the ambient field, near which a network begins; 0 never (paper:
    0.005)."""
    fit_steps: int = 400
    """Steps in which the network is fitted to the field it starts from (--start-from)."""
    rate_after_fit: float = 0.3
    """Share of the learning rate that a run goes on with from such a start."""
    seed: int = 0
    """Of weights and samples; makes a CPU run repeatable that no clock ends."""
    precision: str = "auto"
    """One of auto, float32, tf32, bf16 (mixed; the last part of the run in float32)."""
    full_precision_from: float = 0.85
    """Share of the run after which bf16 gives way to float32."""
    compile: str = "auto"
    """Compile the network: on, off, or auto, on CUDA by PyTorch and its layers on a CPU in float32 by Numba."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, allowed in CHOICES.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"expected one of {', '.join(allowed)}, got '{getattr(self, name)}'", field=name)
        for name in (
            "longest",
            "first_cycle",
            "learning_rate",
            "matrix_rate",
            "points_per_batch",
            "fit_steps",
            "rate_after_fit",
            "warm_up",
        ):
            if not getattr(self, name) > 0:
                raise InputError(f"expected a positive number, got {getattr(self, name)}", field=name)
        for name in ("epochs", "max_steps", "stop_ratio", "sample_jitter", "wave_pixels"):
            if not getattr(self, name) >= 0:
                raise InputError(f"expected 0 or more, got {getattr(self, name)}", field=name)
        if not (len(self.samples) == 2 and min(self._samples()) > self.sample_jitter):
            raise InputError(
                f"expected two counts above sample_jitter ({self.sample_jitter}), or 0 0, got {self.samples}",
                field="samples",
            )
        if self.lens_rays < 0 or self.lens_rays % 2:
            raise InputError(
                f"expected an even number, or 0 for as many as it takes, got {self.lens_rays}", field="lens_rays"
            )
        if self.points_per_batch < max(self._samples()) + self.sample_jitter:
            raise InputError(
                f"expected room for one ray ({max(self._samples()) + self.sample_jitter} points), "
                f"got {self.points_per_batch}",
                field="points_per_batch",
            )
        if (self.weights.head or self.weights.consistency) and not self.network.gradient_head:
            raise InputError("the head and consistency terms need gradient_head = true", field="weights")
        check_model(self.model)
        check_source(self.source)

    def resolved_by(self, measurement: Measurement) -> TrainingSettings:
        """Return them with what they leave to a measurement: the waves of the encoding, and the samples of a ray."""
        pixel = min(measurement.pixel_sizes) / (max(measurement.box.edges) / 2)
        network = self.network.without_waves_below(self.wave_pixels * pixel)
        samples = self._samples(self.symmetry != NO_SYMMETRY and len(measurement.cameras) == 1)
        return replace(self, network=network, wave_pixels=0.0, samples=samples)

    def _samples(self, steep: bool = False) -> tuple[int, int]:
        """Samples of a ray at the start and at the end; more where fronts are as steep as one camera sees them."""
        if any(self.samples):
            return self.samples
        return (24, 48) if steep else (12, 24)

    def in_two(self) -> tuple[TrainingSettings, TrainingSettings]:
        if self.limited:
            steps = max(1, round(FIRST * self.max_steps)) if self.max_steps else 0
            first = replace(
                self, epochs=FIRST * self.epochs, max_steps=steps, time_limit=FIRST * self.time_limit
            )  # fmt: skip
        else:
            first = replace(self, max_steps=self.first_cycle)
        return first, replace(self, rate_after_fit=1.0)  # a field found in haste is no end to start from

    @property
    def latest(self) -> float:
        """Seconds after which a run ends at the latest."""
        return self.time_limit or (math.inf if self.limited else self.longest)

    def steps(self, of_pass: float) -> float:
        """Return how many steps were asked for, inf where no limit but a clock ends the run.

        Parameters
        ----------
        of_pass : steps of a pass over all rays
        """
        asked = [float(self.max_steps)] if self.max_steps else []
        return min([*asked, *([self.epochs * of_pass] if self.epochs else [])], default=math.inf)

    @property
    def limited(self) -> bool:
        """Whether the run ends by a limit that was asked for."""
        return bool(self.epochs or self.max_steps or self.time_limit)
