"""The verdict on a result, in one of four words, from figures that any measurement has; no truth is used.

    error^2 = (A e)^2 + (B f)^2 + (C s)^2 N0 / N        over the variation of the field

with, each an rms over that of the signal,

    s    the noise, of N pixels in all,
    f    the residual of the fitted views beyond the noise: detail that the field lacks, or views that contradict it,
    e    the residual of a withheld view beyond the noise: what the views leave open between them.

A view that was withheld from a first, short run shows an error of that run, e_1, which the whole run reduces: what was
not trained yet about as much as the misfit of the fitted views, to f / f_1; and what the views leave open, which is
what exceeds K f_1, to G,

    e = max(f / f_1 e_1, G (e_1^2 - K^2 f_1^2)^(1/2)).

Noise scatters, so that a mean square residual cannot show what is below s^2 (2 / n)^(1/2) of n pixels: e, and f and f_1
in their ratio, are no less. The coefficients are those of simulated measurements, good and spoiled; how well they hold
on others is in benchmarks/results/verdicts-cpu.md. Standard deviations, where there are some, are a second estimate:
the mean of both counts where their ranges overlap, else the larger.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nerif.analysis.asymmetry import camera_of
from nerif.analysis.residuals import CAUSES
from nerif.data.volume import field_of
from nerif.forward.registry import TECHNIQUES
from nerif.results.directory import Result

__all__ = ["WORDS", "Estimate", "Verdict", "verdict"]

WORDS = ("use", "use with care", "do not use", "cannot tell")

WITHHELD, FIRST_RUN = 0.25, 0.4
"""A, for a view withheld from the whole run and from a first one."""
MISFIT, NOISE, PIXELS = 0.8, 0.2, 8000
"""B, C and N0"""
UNTRAINED, LEFT_OPEN = 3.5, 0.4
"""K and G"""
LEAST = 0.07
"""Least f / f_1 that is believed."""
SPREAD = {"views": 2.0, "deviations": 1.5}
"""Factor, up and down, within which nine in ten estimates hold, from views and from standard deviations."""

EXPLAINED = 0.5  # of the squared signal; a field that explains less is no reconstruction of these data
USE, NOT = 0.035, 0.12  # of the variation: up to which it is to be used, and above which not
DOUBT, GRAVE = (1.7, 0.005), (2.2, 0.02)  # grain of a view's residual, and its correlated part over the signal
FEW = 4  # cameras
STANDS = 1.5  # times the correlated part in the median view
ASYMMETRIC, NOT_SYMMETRIC = 0.25, 0.4  # antisymmetric part of the signal of a flow taken as axisymmetric
UNEVEN = 1.35  # residual of the worst view over that of the median one, each over the signal
FLOW = 0.02  # share of the largest value above which a voxel counts as flow

ONE_CAMERA = (
    "with one camera no other view checks the calibration: lengths scale with its mm per px, and the index excess with "
    "the mm per px at the background over the distance from flow to background"
)


@dataclass(frozen=True)
class Estimate:
    """The relative error of a field, over its variation.

    Parameters
    ----------
    error : estimate
    low, high : range that holds in nine of ten cases like those of the benchmark
    basis : what it was estimated from
    """

    error: float
    low: float
    high: float
    basis: str

    @classmethod
    def within(cls, error: float, factor: float, basis: str) -> Estimate:
        """Return the estimate with a range of a factor up and down."""
        return cls(error, error / factor, error * factor, basis)

    def combined(self, other: Estimate) -> Estimate:
        """Return the mean of two estimates that agree, of logarithms weighed by their ranges; else the larger one."""
        if other.high < self.low or self.high < other.low or not min(self.error, other.error) > 0:
            return max(self, other, key=lambda e: e.error)
        weights = [math.log(e.high / e.error) ** -2 for e in (self, other)]
        total = sum(weights)
        mean = sum(w * math.log(e.error) for w, e in zip(weights, (self, other), strict=True)) / total
        return Estimate.within(math.exp(mean), math.exp(total**-0.5), f"{self.basis} and {other.basis}")


@dataclass(frozen=True)
class Verdict:
    """What to do with a result.

    Parameters
    ----------
    word : one of WORDS
    error : estimated error of the field over its variation, or None
    why : the reasons, in words
    low, high : range of the error, or None
    """

    word: str
    error: float | None
    why: str
    low: float | None = None
    high: float | None = None

    @classmethod
    def of(cls, word: str, estimate: Estimate | None, reasons: Sequence[str], joint: str = "; ") -> Verdict:
        """Return a verdict with its reasons, the basis of the estimate first."""
        why = joint.join(reason for reason in reasons if reason)
        if estimate is None:
            return cls(word, None, why)
        basis = f"{estimate.basis}{joint if why else ''}{why}"
        return cls(word, estimate.error, basis, estimate.low, estimate.high)

    @property
    def sentence(self) -> str:
        """The verdict and what it rests on."""
        head = f"{self.word[0].upper()}{self.word[1:]}: "
        if self.error is None:
            return f"{head}{self.why}."
        span = "" if self.low is None or self.high is None else f" ({percent(self.low)} to {percent(self.high)})"
        return f"{head}estimated error {percent(self.error)} of the variation{span}, {self.why}."


def verdict(result: Result) -> Verdict:
    """Judge a result by its figures alone."""
    metrics = result.metrics
    outcome = metrics.get("outcome")
    if outcome in ("diverged", "collapsed"):
        return Verdict.of("do not use", None, [f"the run {outcome}"])
    views = metrics.get("views")
    views = [v for v in views if _complete(v)] if isinstance(views, list) else []
    fitted = [v for v in views if not v["withheld"]]
    for group, whose in ((fitted, "fitted views"), ([v for v in views if v["withheld"]], "withheld views")):
        share = _explained(group, _noise(fitted))
        if share is not None and share < EXPLAINED:
            text = f"the field explains {max(share, 0.0):.0%} of the squared signal of the {whose}, noise apart"
            return Verdict.of("do not use", None, [text])
    estimate, void = _estimate(result, views, fitted)
    doubt, grave = _contradiction(fitted)
    symmetry = (metrics.get("axis") or {}).get("symmetry") or {}
    alike = bool(symmetry) and not symmetry.get("harmonics")  # one view shows it all; with harmonics halves may differ
    if alike and any(d["departure"] > ASYMMETRIC for d in metrics.get("asymmetry") or []):
        uneven, none = _asymmetry(metrics["asymmetry"])
        doubt, grave = "; ".join(filter(None, (uneven, doubt))), grave or none
    if grave:
        return Verdict.of("do not use", None, [doubt])
    if estimate is not None and estimate.error > NOT:
        return Verdict.of("do not use", estimate, [doubt])
    if estimate is None:
        if doubt:
            return Verdict.of("use with care", None, [doubt, void])
        remedy = "--uncertainty fast computes standard deviations"
        return Verdict.of("cannot tell", None, [void or "no view was withheld", remedy])
    cameras = len({camera_of(v["name"]) for v in fitted})  # a view has an entry for each technique, or each half
    doubts = [doubt]
    if cameras == 1:
        doubts.append(ONE_CAMERA)
    elif cameras < FEW and not alike:  # what they do not show is in no figure
        doubts.append(f"{cameras} views leave much of the field undetermined")
    if outcome == "interrupted":
        doubts.append("the run was interrupted")
    if any(doubts) or estimate.error > USE:
        return Verdict.of("use with care", estimate, doubts, "; but ")
    return Verdict.of("use", estimate, ["no view contradicts the others"])


def percent(share: float) -> str:
    """Return a share in percent, two digits."""
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"


def _complete(view: Any) -> bool:
    return isinstance(view, dict) and bool(view.get("rms_predicted")) and view.get("rms") is not None


def _kinds(views: Sequence[dict[str, Any]]) -> list[str]:
    """What was measured; not what was derived from images that are there too: its windows blur it."""
    measured = list(dict.fromkeys(v["measured"] for v in views))
    coarser = {
        TECHNIQUES[kind.derived].measured for kind in TECHNIQUES.values() if kind.derived and kind.measured in measured
    }
    return [name for name in measured if name not in coarser]


def _noise(fitted: Sequence[dict[str, Any]]) -> dict[str, float]:
    """The rms noise of a view, by what was measured.

    It is what differs from pixel to pixel in the residuals or, where that is larger (correlated noise), the stated
    sigma, but no more than the residuals of the fitted views.
    """
    noise = {}
    for name in dict.fromkeys(v["measured"] for v in fitted):
        own = [v for v in fitted if v["measured"] == name]
        residual = statistics.median(v["rms"] for v in own)
        white = statistics.median(v.get("rms_white", residual) for v in own)
        stated = statistics.median(v.get("rms_sigma", white) for v in own)
        noise[name] = max(white, min(stated, residual))
    return noise


def _squares(view: dict[str, Any], noise: float) -> tuple[float, float]:
    """Mean squares of the residual and of the signal of a view, noise apart."""
    signal = view["rms_predicted"] ** 2
    if "rms_measured" in view:
        signal = view["rms_measured"] ** 2 - noise**2
    return max(view["rms"] ** 2 - noise**2, 0.0), max(signal, 0.0)


def _explained(views: Sequence[dict[str, Any]], noise: dict[str, float]) -> float | None:
    """The smallest share, of any kind, of the squared signal that is explained; None where there is no signal."""
    shares = []
    for name in _kinds(views):
        squares = [_squares(v, noise[name]) for v in views if v["measured"] == name and name in noise]
        signal = sum(s for _, s in squares)
        if signal > 0:
            shares.append(1 - sum(r for r, _ in squares) / signal)
    return min(shares, default=None)


def _estimate(
    result: Result, views: Sequence[dict[str, Any]], fitted: Sequence[dict[str, Any]]
) -> tuple[Estimate | None, str]:
    """The estimated error, or None, and why a withheld view gives none."""
    by_views, void = _from_views(result, views, fitted)
    deviation = _deviation(result)
    if deviation is None:
        return by_views, void
    by_deviations = Estimate.within(deviation, SPREAD["deviations"], "from its standard deviations")
    return (by_deviations if by_views is None else by_views.combined(by_deviations)), void


def _from_views(
    result: Result, views: Sequence[dict[str, Any]], fitted: Sequence[dict[str, Any]]
) -> tuple[Estimate | None, str]:
    """The estimate from views that were withheld, of the whole run or of others."""
    metrics = result.metrics
    first = metrics.get("cross_validation") or {}
    noise = _noise(fitted)
    own = [v for v in first.get("fitted_views") or [] if _complete(v)]
    share = _explained(own, noise)
    for withheld, basis in (
        ([v for v in views if v["withheld"]], "cross-validated on a withheld view"),
        (first.get("views") or [], "cross-validated in a first run without a view"),
    ):
        shown = [v for v in withheld if _complete(v) and v["measured"] in noise and v["measured"] in _kinds(withheld)]
        if not shown:
            continue
        largest, factor = max(_withheld(v, noise) for v in shown), WITHHELD
        if withheld is first.get("views"):
            if share is not None and share < EXPLAINED:
                short = f"without view {shown[0]['name']}, was too short for cross-validation: it explains {share:.0%}"
                return None, f"the first run, {short} of its data"
            largest, factor = _after_first_run(largest, fitted, own, noise), FIRST_RUN
        misfit, white, pixels = _of_fitted(fitted, noise)
        noisy = white * math.sqrt(PIXELS / pixels) if pixels else white
        error = math.hypot(factor * largest, MISFIT * misfit, NOISE * noisy)
        if not math.isfinite(error):
            return None, "a view shows no signal above the noise"
        return Estimate.within(error, SPREAD["views"], basis), ""
    return None, ""


def _withheld(view: dict[str, Any], noise: dict[str, float]) -> float:
    """e of a withheld view."""
    white = noise[view["measured"]]
    residual, signal = _squares(view, white)
    return _ratio(max(residual, white**2 * _scatter(view.get("pixels") or 0)), signal)


def _after_first_run(
    error: float, fitted: Sequence[dict[str, Any]], first: Sequence[dict[str, Any]], noise: dict[str, float]
) -> float:
    """e after the whole run, by e_1, the misfit then and now; e_1 where the first run's misfit is not known."""
    if not first:
        return error
    (after, white, pixels), (before, *_) = _of_fitted(fitted, noise), _of_fitted(first, noise)
    hidden = white**2 * _scatter(pixels)
    trained = min(max(_ratio(after**2 + hidden, before**2 + hidden), LEAST), 1.0)
    open_ = math.sqrt(max(error**2 - (UNTRAINED * before) ** 2, 0.0))
    return max(trained * error, LEFT_OPEN * open_)


def _scatter(pixels: int) -> float:
    """Standard deviation of the mean square of white noise in so many pixels, over the mean square."""
    return math.sqrt(2 / pixels) if pixels else 0.0


def _ratio(square: float, of: float) -> float:
    return math.sqrt(square / of) if of > 0 else math.inf


def _of_fitted(fitted: Sequence[dict[str, Any]], noise: dict[str, float]) -> tuple[float, float, int]:
    """f, s and N of fitted views, of what was measured with the largest misfit."""
    figures = []
    for name in _kinds(fitted):
        own = [v for v in fitted if v["measured"] == name and name in noise]
        if own:
            squares = [_squares(v, noise[name]) for v in own]
            residual, signal = (statistics.fmean(column) for column in zip(*squares, strict=True))
            pixels = sum(v.get("pixels") or 0 for v in own)
            figures.append((_ratio(residual, signal), _ratio(noise[name] ** 2, signal), pixels))
    return max(figures)


def _deviation(result: Result) -> float | None:
    """The rms standard deviation in the flow over the rms of the field there."""
    name = field_of(result.volumes)
    std = result.volumes.get(f"{name}_std")
    if name is None or std is None:
        return None
    values = result.volumes[name].values.double()
    flow = values.abs() > FLOW * values.abs().max()
    size = float(values[flow].norm())
    return float(std.values.double()[flow].norm()) / size if size > 0 else None


def _contradiction(fitted: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    """Which view the others contradict, in words, and whether gravely.

    Correlated noise, as windows leave it, is in every view; a contradiction stands out, or has a pattern.
    """
    for name in dict.fromkeys(v["measured"] for v in fitted):
        own = [v for v in fitted if v["measured"] == name]
        parts = {v["name"]: _correlated(v) for v in own}
        middle, worst = statistics.median(parts.values()), max(parts, key=lambda k: parts[k])
        tests = {v["name"]: v.get("leftover") or {"grain": 1.0, "cause": ""} for v in own}
        out = [
            view for view, test in tests.items()
            if test["grain"] > DOUBT[0] and parts[view] > DOUBT[1] and (test["cause"] or parts[view] > STANDS * middle)
        ]  # fmt: skip
        if out:
            views = f"residuals of {len(out)} views are" if len(out) > 1 else f"the residual of view {out[0]} is"
            text = f"{views} spatially correlated, in {worst} {parts[worst]:.1%} of the signal"
            grain, cause = tests[worst]["grain"], tests[worst]["cause"]
            text += f", as where {CAUSES[cause]}" if cause else "; nerif check compares the views with one another"
            return text, grain > GRAVE[0] and parts[worst] > GRAVE[1] and parts[worst] > STANDS * middle
        shares = {v["name"]: v["rms"] / v["rms_predicted"] for v in own}
        worst, middle = max(shares, key=lambda k: shares[k]), statistics.median(shares.values())
        if middle > 0 and shares[worst] > UNEVEN * middle:
            return f"view {worst}: residual {shares[worst] / middle:.1f} × the median of all views", False
    return "", False


def _asymmetry(asymmetry: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    """How far the measurement is from that of an axisymmetric flow, in words, and whether it is none."""
    worst = max(asymmetry, key=lambda d: d["departure"])
    cc, share = min(worst["cc"].values()), worst["departure"]
    halves = f"the halves of {worst['name']} correlate by {cc:.2f}, and {share:.0%} of the signal is antisymmetric"
    none = share > NOT_SYMMETRIC
    return f"the flow is {'not' if none else 'only roughly'} axisymmetric: {halves}", none


def _correlated(view: dict[str, Any]) -> float:
    """The spatially correlated part of the residual of a view, over the signal."""
    test = view.get("leftover")
    return float(test["alike"] * view["rms"] / view["rms_predicted"]) if test else 0.0
