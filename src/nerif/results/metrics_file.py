"""metrics.json: the figures of a result, each section written by one step and read from here by all others."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired

from pydantic import BeforeValidator, ConfigDict, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from nerif.common.conventions import InputError, within
from nerif.common.files import read_json, write_json
from nerif.reconstruction.rig_parameters import RefinedView

__all__ = [
    "VERSION", "AxisEstimate", "Coverage", "DetailEntries", "HalfAsymmetry", "Metrics", "PredictionAccuracy",
    "ResidualTest", "SliceScores", "Uncertainty", "VerdictEntries", "ViewScores", "WithheldRun",
]  # fmt: skip

VERSION = 1
Score = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A figure; NaN (null in the file) where it is not defined, such as the correlation with a constant."""


class ResidualTest(TypedDict):
    """Test of the residual of a view for whiteness."""

    white: bool
    grain: float  #: 1 for white noise, larger for correlated residuals
    cause: str  #: whose pattern it has (remedies.CAUSES), or empty
    share: float  #: fraction of the correlated part that the cause explains
    row: float
    column: float  #: position of its largest part, px
    correlated: float  #: the spatially correlated part over the rms


class ViewScores(TypedDict):
    """Measurement of a view against its prediction, for one technique."""

    name: str
    withheld: bool
    measured: str  #: the quantity
    unit: str  #: unit of all rms values
    cc: Score
    ssim: Score
    psnr: Score  #: dB
    rms: Score  #: rms of the residual
    pixels: int
    rms_predicted: Score
    rms_measured: Score
    rms_white: NotRequired[Score]  #: pixel-to-pixel noise, estimated from the residual
    rms_sigma: NotRequired[Score]  #: stated noise
    rms_over_sigma: NotRequired[Score]
    residual_test: NotRequired[ResidualTest]  #: given enough pixels
    cut_edge: NotRequired[str]  #: edge of the image, left, right, top or bottom, at which the flow is cut off most
    cut_signal: NotRequired[Score]  #: rms of the signal along it over that of the image


class PredictionAccuracy(TypedDict):
    """How the views were predicted, for one technique."""

    measured: str
    unit: str
    method: str
    error: float  #: rms difference from the path integral through the field; 0 if the prediction is that integral
    pixels: int  #: pixels on which they were compared


class WithheldRun(TypedDict):
    """The cross-validation run, without one view."""

    views: list[ViewScores]  #: scores of the withheld view
    fitted_views: list[ViewScores]  #: scores of one of the others
    seconds: float


class AxisEstimate(TypedDict):
    """The axis of a symmetric flow; parameters by name, mm and rad."""

    symmetry: dict[str, Any]  #: fields of geometry.Symmetry
    values: dict[str, float]
    prior_sigma: dict[str, float]
    posterior_sigma: dict[str, float]
    constrained: dict[str, bool]  #: by the data
    better_direction: NotRequired[list[float]]  #: about which a coarse field fits far better


class HalfAsymmetry(TypedDict):
    """The two halves of a view of an axisymmetric flow against each other."""

    name: str
    measured: str
    cc: dict[str, float]
    antisymmetry: float  #: antisymmetric fraction of the signal


class Uncertainty(TypedDict):
    """Bootstrap trials, or draws from the posterior."""

    kind: str
    trials: int
    diverged_trials: list[int]  #: excluded ones
    seconds: float
    source: NotRequired[str]  #: bootstrap, or posterior


class DetailEntries(TypedDict):
    """Detail added to the field of the method (reconstruction/detail/detail.py)."""

    residual_before: float  #: rms over sigma, without and with it
    residual_after: float
    withheld_before: Score
    """The same of the withheld view in the cross-validation: of rough trials on a coarse grid, and of pixels by which
    nothing was chosen. NaN without one."""
    withheld_after: Score
    blurred: bool  #: whether it was added to the blurred field
    voxels: int  #: along the longest edge of the box
    iterations: int
    seconds: float


class VerdictEntries(TypedDict):
    """See analysis.verdict.Verdict."""

    rating: str
    error: float | None
    reasons: str
    low: float | None
    high: float | None


class SliceScores(TypedDict):
    """A slice across z against the truth."""

    z_mm: float
    cc: Score
    ssim: Score
    psnr: Score


class Coverage(TypedDict):
    """Fraction of the voxels whose truth lies within one and two standard deviations."""

    one_sigma: Score
    two_sigma: Score
    one_sigma_in_flow: Score
    two_sigma_in_flow: Score
    reliability: NotRequired[list[float]]  #: in the flow, within the bands of metrics.LEVELS
    spearman: Score  #: rank correlation of |error| and standard deviation


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Content of metrics.json; a section is None or empty where its step has not run."""

    version: Literal[1] = 1

    measurement: str | None = None  #: file of the views, absolute path
    seconds: float | None = None  #: duration of the main run
    peak_memory_bytes: int | None = None  #: tensors on a GPU, the whole process on a CPU
    device: str | None = None
    outcome: str | None = None  #: why it ended: converged, ...
    message: str | None = None
    cross_validation: WithheldRun | None = None

    detail: DetailEntries | None = None

    views: list[ViewScores] = field(default_factory=list)
    reprojection: list[PredictionAccuracy] = field(default_factory=list)

    rig: list[RefinedView] = field(default_factory=list)  #: refined cameras
    withheld_rig: list[RefinedView] = field(default_factory=list)
    """Cameras of withheld views, refined against the field."""
    withheld_views: list[ViewScores] = field(default_factory=list)  #: withheld views, predicted with these cameras

    axis: AxisEstimate | None = None
    asymmetry: list[HalfAsymmetry] = field(default_factory=list)

    uncertainty: Uncertainty | None = None
    verdict: VerdictEntries | None = None

    truth: str | None = None  #: file of the true field, absolute path
    quantity: str | None = None  #: quantity of the field that was compared with it
    l2: Score | None = None
    l2_variation: Score | None = None
    cc: Score | None = None
    ssim: Score | None = None
    psnr: Score | None = None
    slices: list[SliceScores] = field(default_factory=list)
    aligned: dict[str, Any] | None = None  #: the same after the best rigid motion, `rotation_rad` and `shift_mm`
    coverage: Coverage | None = None

    @classmethod
    def of(cls, entries: Any) -> Metrics:
        """Return the content of a file, checked."""
        if not isinstance(entries, dict):
            raise InputError("expected a table of names and values")
        if entries.get("version") != VERSION:
            raise InputError(
                f"expected version {VERSION} of the metrics, got {entries.get('version', 'none')}; "
                "remove it, and nerif evaluate writes the comparison with views and truth again",
                field="version",
            )
        try:
            return _adapter().validate_python(entries)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            place = ".".join(map(str, first["loc"]))
            expected, got = first["msg"][0].lower() + first["msg"][1:], repr(first["input"])[:60]
            raise InputError(f"{expected}, got {got}", field=place) from None

    @classmethod
    def read(cls, path: Path) -> Metrics:
        """Read a file."""
        entries = read_json(path)
        with within(path):
            return cls.of(entries)

    def write(self, path: Path) -> None:
        """Write a file, without empty sections, atomically."""
        write_json(path, {name: value for name, value in asdict(self).items() if value not in (None, [])})


_adapter = cache(partial(TypeAdapter, Metrics))
