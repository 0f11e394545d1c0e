"""Settings of the training of a network: its size, loss, sampling of rays, learning rates and limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Gt

from nerif.common.conventions import InputError
from nerif.common.settings import Checked, Developer, Natural, NonNegative, Positive
from nerif.fields.network_shape import NetworkShape
from nerif.forward.model_names import AUTO, MODEL_NAMES
from nerif.geometry.symmetry_names import NO_SYMMETRY
from nerif.reconstruction.shared_settings import SHORT_RUN, SharedSettings, Source

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["LossWeights", "TrainingSettings"]


@dataclass(frozen=True)
class LossWeights(Checked):
    """Weights of the terms of the loss."""

    consistency: NonNegative = 0.0
    """|grad(n)_AD - grad(n)_net| over sample points (paper: 1)."""
    numerical: NonNegative = 0.0
    """|d_ND - d| over rays (paper: 1)."""
    head: NonNegative = 0.0
    """|d_net - d| over rays (paper: 1)."""
    automatic: NonNegative = 1.0
    """|d_AD - d| over rays (paper: 0)."""
    gauge: NonNegative = 1.0
    """N over the ambient region."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.numerical + self.head + self.automatic == 0:
            raise InputError("expected a positive numerical, head or automatic weight, got none", field="loss weights")


@dataclass(frozen=True)
class TrainingSettings(SharedSettings):
    """Settings of every method that trains a network."""

    network: NetworkShape = field(default_factory=NetworkShape)
    """Size of the network."""
    wave_pixels: NonNegative = 2.5
    """Shortest wavelength of the encoding, in pixels at the centre of the box (0: all, as in the paper)."""
    weights: LossWeights = field(default_factory=LossWeights)
    """Weights of the loss terms."""
    norm: Literal["l2", "squared"] = "squared"
    """Loss of residuals: squared (maximum likelihood of Gaussian noise), or l2, their length (paper)."""
    model: Literal[*MODEL_NAMES] = AUTO  # type: ignore[valid-type]
    """Forward model. Displacements: lever_arm (auto), paraxial, or curved (along bent rays). Absorption: absorbance
    (auto), intensity (uniform detector noise) or poisson (photon counts), both for low transmission."""
    samples: tuple[int, int] = (0, 0)
    """Samples M per ray at the start and at the end; each step draws N from M - jitter to M + jitter (0 0: 12 24, or
    24 48 for a symmetric flow and one camera)."""
    sample_jitter: Natural = 4
    """Half-range of the random number of samples per ray, see samples."""
    sampling: Literal["adaptive", "random", "shifted", "regular"] = "adaptive"
    """Sample positions: adaptive (dense where the field varies), or in equal intervals: random (one draw per interval,
    paper), shifted (one draw per ray), regular (midpoints)."""
    source: Source = "auto"
    """Data to fit: displacements, images (pixel by pixel, after a start from displacements or blurred
    images), both, or auto (images where available)."""
    lens_rays: Natural = 0
    """Rays per pixel through the aperture at the end, even; a third of them at the start (0: 2 to 12, by the width
    of the cone in pixels)."""
    points_per_batch: Annotated[int, Gt(0)] = 8192
    """Sample points per step: points_per_batch / N pixels with N samples each."""
    optimiser: Literal["muon", "adam"] = "muon"
    """Optimiser: muon for weight matrices and Adam for the rest, or adam for all (paper)."""
    learning_rate: Positive = 1.5e-2
    """Maximum learning rate of Adam for a network of 4 x 128; scaled for other shapes (rates_by_shape)."""
    rates_by_shape: bool = True
    """Scale Adam's learning rates with the shape of the network, or use one for all weights (paper)."""
    betas: Annotated[tuple[float, float], Developer] = (0.9, 0.99)
    """Decay rates of Adam."""
    matrix_rate: Annotated[Positive, Developer] = 2.0
    """Learning rate of Muon relative to Adam's."""
    momentum: Annotated[float, Developer] = 0.9
    """Momentum of Muon."""
    warm_up: Annotated[int, Gt(0), Developer] = 15
    """Steps over which the learning rate rises, at most a sixth of max_steps (cosine schedule)."""
    schedule: Literal["cosine", "constant"] = "cosine"
    """Learning rate over the run: cosine (falls to 1 %), or constant (paper)."""
    epochs: NonNegative = 0.0
    """Limit in passes over all rays, n_outer of the paper (0: none). Without any limit the run ends when the residual
    on withheld rays stops falling."""
    max_steps: Natural = 0
    """Limit in steps (0: none)."""
    first_cycle: Annotated[int, Gt(0), Developer] = 400
    """Steps before the first convergence check of a run without a limit; doubled after each check."""
    stop_ratio: NonNegative = 0.0
    """Stop when the loss is below this share of the loss of the ambient field (0: never; paper: 0.005)."""
    fit_steps: Annotated[int, Gt(0), Developer] = 400
    """Steps in which the network is fitted to the initial field (--start-from)."""
    rate_after_fit: Annotated[Positive, Developer] = 0.3
    """Share of the learning rate used after such a fit."""
    seed: int = 0
    """Random seed of weights and samples; CPU runs without a time limit are reproducible."""
    precision: Literal["auto", "float32", "tf32", "bf16"] = "auto"
    """Floating-point precision: float32, tf32, bf16 (mixed; the end of the run in float32), or auto."""
    full_precision_from: Annotated[float, Developer] = 0.85
    """Share of the run after which bf16 changes to float32."""
    compile: Annotated[Literal["auto", "on", "off"], Developer] = "auto"
    """Compile the network: on, off, or auto (on CUDA by PyTorch; layers on a CPU in float32 by Numba)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        samples = self._samples()
        if not (len(samples) == 2 and min(samples) > self.sample_jitter):
            raise InputError(
                f"expected two counts above sample_jitter ({self.sample_jitter}), or 0 0, got {samples}",
                field="samples",
            )
        if self.lens_rays % 2:
            raise InputError(f"expected an even number, or 0 for automatic, got {self.lens_rays}", field="lens_rays")
        if self.points_per_batch < (ray := max(samples) + self.sample_jitter):
            raise InputError(
                f"expected at least the {ray} points of one ray, got {self.points_per_batch}", field="points_per_batch"
            )
        if (self.weights.head or self.weights.consistency) and not self.network.gradient_head:
            raise InputError("the head and consistency terms need gradient_head = true", field="weights")

    def resolved_by(self, measurement: Measurement) -> TrainingSettings:
        """Return the settings with the encoding and the samples per ray that suit a measurement."""
        pixel = min(measurement.pixel_sizes) / (max(measurement.box.edges) / 2)
        network = self.network.without_waves_below(self.wave_pixels * pixel)
        samples = self._samples(self.symmetry != NO_SYMMETRY and len(measurement.cameras) == 1)
        return replace(self, network=network, wave_pixels=0.0, samples=samples)

    def _samples(self, steep: bool = False) -> tuple[int, int]:
        """Return samples per ray at the start and at the end; more for the steep fronts of a single view."""
        if any(self.samples):
            return self.samples
        return (24, 48) if steep else (12, 24)

    def split_for_cross_validation(self) -> tuple[TrainingSettings, TrainingSettings]:
        steps = (
            (max(1, round(SHORT_RUN * self.max_steps)) if self.max_steps else 0) if self.limited else self.first_cycle
        )
        short = replace(self, epochs=SHORT_RUN * self.epochs, max_steps=steps, time_limit=SHORT_RUN * self.time_limit)
        return short, replace(self, rate_after_fit=1.0)  # a short run ends too early for a reduced rate

    def steps(self, of_pass: float) -> float:
        """Return the limit in steps, inf if there is none; `of_pass`: steps per pass over all rays."""
        limits = [self.max_steps or math.inf, self.epochs * of_pass if self.epochs else math.inf]
        return float(min(limits))

    @property
    def limited(self) -> bool:
        """Whether epochs, steps or time are limited by the user."""
        return bool(self.epochs or self.max_steps or self.time_limit)
