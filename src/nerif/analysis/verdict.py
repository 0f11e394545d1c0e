"""The verdict on a result, in one of four words, from quantities that every measurement has; the truth is not used.

Estimated relative error of the variation of the field:

    error^2 = (A e)^2 + (B f)^2 + (C s)^2 N0 / N

with rms values relative to the signal,

    s    noise, of N pixels in all
    f    residual of the fitted views beyond the noise: unresolved detail, or views that contradict each other
    e    residual of a withheld view beyond the noise: what the other views leave undetermined

In cross-validation, e_1 and f_1 are those of the short cross-validation run without one view. The main run, with all
views, reduces the untrained part of e_1 in proportion to the misfit, and the undetermined part, all that exceeds K f_1,
by the factor G:

    e = max(f / f_1 e_1, G (e_1^2 - K^2 f_1^2)^(1/2))

The mean square residual of n pixels scatters by s^2 (2 / n)^(1/2), a lower limit for e, and, with the pixels of f_1,
for f and f_1 in their ratio. The coefficients are fitted to simulated measurements with and without defects; their
accuracy on others is in benchmarks/results/verdicts-cpu.md. Standard deviations give a second estimate, combined as in
`Estimate.mean`.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from nerif.analysis.asymmetry import camera_of
from nerif.analysis.image_edges import REMEDY
from nerif.analysis.metrics import FLOW
from nerif.analysis.remedies import CHECK, DEVIATIONS, SYMMETRY, WITHHOLD, advice, is_fitted, likely_cause, longer
from nerif.common.conventions import percent
from nerif.data.quantity_names import field_of
from nerif.forward.registry import TECHNIQUES
from nerif.results.directory import Result
from nerif.results.metrics_file import HalfAsymmetry, ResidualTest, ViewScores

__all__ = ["RATINGS", "Estimate", "Verdict", "correlated_share", "cut_off", "time_of_fit", "verdict"]

RATINGS = ("use", "use with care", "do not use", "cannot tell")

A_WITHHELD, A_FIRST_RUN = 0.25, 0.4  # A, for a view withheld from the whole run, and from the cross-validation run only
B_MISFIT, C_NOISE, N0_PIXELS = 0.8, 0.2, 8000
K_UNTRAINED, G_UNDETERMINED = 3.5, 0.4
MIN_MISFIT_RATIO = 0.07  # smallest f / f_1
VIEWS_FACTOR, DEVIATIONS_FACTOR = 2.0, 1.5  # up and down, the range that holds in nine of ten cases

MIN_EXPLAINED = 0.5  # of the squared signal; a field that explains less is no reconstruction of these data
MIN_PREDICTED = 0.7  # of the squared signal of the view withheld from cross-validation, for an estimate of little error
MAX_USE, MAX_CARE = 0.035, 0.12  # error of the variation
DOUBTFUL, SEVERE = (1.7, 0.005), (2.2, 0.02)  # grain of a residual, and its correlated part over the signal
OUTLIER = 1.5  # times the correlated part of the median view
MIN_CAMERAS = 4
ASYMMETRIC, NOT_SYMMETRIC = 0.25, 0.4  # antisymmetric share of the signal of a flow taken as axisymmetric
UNEVEN = 1.35  # residual of the worst view over that of the median view, each relative to the signal
LITTLE = 0.2  # of the time limit: a fit that had less was cut short

ONE_CAMERA = (
    "with one camera no other view checks the calibration: lengths scale with its mm per px, and the index excess with "
    "the mm per px at the background over the distance from flow to background"
)

COMMON_MOTION = "without that of a common motion of field and refined cameras, which no view shows"

View = ViewScores
WHITE = ResidualTest(grain=1.0, white=True, cause="", share=0.0, row=0.0, column=0.0, correlated=0.0)


@dataclass(frozen=True)
class Estimate:
    """The relative error of the variation of a field."""

    error: float  #: estimate
    low: float  #: end of the range that holds in nine of ten cases like those of the benchmark
    high: float
    basis: str  #: what it was estimated from

    @classmethod
    def within(cls, error: float, factor: float, basis: str) -> Estimate:
        """Return the estimate with a range of a factor up and down."""
        return cls(error, error / factor, error * factor, basis)

    def mean(self, other: Estimate) -> Estimate:
        """Return the mean of logarithms, weighted by range, of two estimates whose ranges overlap; else the larger."""
        if other.high < self.low or self.high < other.low or not min(self.error, other.error) > 0:
            return max(self, other, key=lambda e: e.error)
        weights = [math.log(e.high / e.error) ** -2 for e in (self, other)]
        total = sum(weights)
        mean = sum(w * math.log(e.error) for w, e in zip(weights, (self, other), strict=True)) / total
        return Estimate.within(math.exp(mean), math.exp(total**-0.5), f"{self.basis}, and {other.basis}")


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be used."""

    rating: str  #: one of RATINGS
    error: float | None  #: estimated relative error of the variation, or None
    reasons: str  #: for it
    low: float | None = None  #: end of the range of the error
    high: float | None = None

    @classmethod
    def of(cls, rating: str, estimate: Estimate | None, reasons: Sequence[str]) -> Verdict:
        """Return a verdict with its reasons, the basis of the estimate first."""
        if estimate is None:
            return cls(rating, None, "; ".join(filter(None, reasons)))
        text = "; ".join(filter(None, (estimate.basis, *reasons)))
        return cls(rating, estimate.error, text, estimate.low, estimate.high)

    @property
    def sentence(self) -> str:
        """The verdict with its reasons."""
        head = f"{self.rating[0].upper()}{self.rating[1:]}: "
        if self.error is None:
            return f"{head}{self.reasons}."
        span = "" if self.low is None or self.high is None else f", {_percent(self.low)} to {_percent(self.high)}"
        error = f"the field is wrong by about {_percent(self.error)} of its variation about the ambient (rms{span})"
        return f"{head}{error}, {self.reasons}."


def verdict(result: Result) -> Verdict:
    """Judge a result by its metrics, and its standard deviations where it has some."""
    metrics = result.metrics
    outcome = metrics.outcome
    if outcome in ("diverged", "collapsed"):
        return Verdict.of("do not use", None, [f"the run {outcome}"])
    views = _fitted_quantities(metrics.views, result)
    fitted, withheld = ([v for v in views if bool(v["withheld"]) is role] for role in (False, True))
    cameras = len({camera_of(v["name"]) for v in fitted})  # a view has an entry for each technique, or each half
    remedy = advice([SYMMETRY], result.settings) if cameras == 1 else CHECK.words
    cut = cut_off(fitted)
    for group, role in ((fitted, "fitted"), (withheld, "withheld")):
        share = _explained(group, _noise(fitted))
        if share is not None and share < MIN_EXPLAINED:
            text = f"the field explains {max(share, 0.0):.0%} of the squared signal of the {role} views (noise removed)"
            return Verdict.of("do not use", None, [text, cut or remedy, time_of_fit(result)])
    estimate, unavailable = _from_views(result, withheld, fitted)
    deviation = _deviation(result)
    if deviation is not None:
        other = Estimate.within(deviation, DEVIATIONS_FACTOR, "estimated from its standard deviations")
        estimate = other if estimate is None else estimate.mean(other)
    doubt, severe = _contradiction(fitted, result, estimate)
    symmetry = metrics.axis["symmetry"] if metrics.axis else {}
    if metrics.axis and (better := metrics.axis.get("better_direction")):
        direction = " ".join(f"{x:g}" for x in better)
        text = f"not axisymmetric about z: --axis-direction {direction}, about which a coarse field fits far better"
        return Verdict.of("do not use", None, [text])
    axisymmetric = bool(symmetry) and not symmetry.get("harmonics")  # with harmonics the halves may differ
    if axisymmetric and any(d["antisymmetry"] > ASYMMETRIC for d in metrics.asymmetry):
        uneven, not_symmetric = _asymmetry(metrics.asymmetry)
        doubt, severe = "; ".join(filter(None, (uneven, doubt))), severe or not_symmetric
    time, common = time_of_fit(result), COMMON_MOTION if is_fitted("calibration", result.settings) else ""
    if severe:
        return Verdict.of("do not use", None, [cut or doubt, "" if cut or "nerif check" in doubt else remedy])
    if estimate is not None and estimate.error > MAX_CARE:
        return Verdict.of("do not use", estimate, [common, cut or doubt, "" if cut else remedy, time])
    if cut:  # no estimate includes what lies outside the images
        return Verdict.of("cannot tell", None, [cut, time])
    if estimate is None and doubt:
        return Verdict.of("use with care", None, [doubt, unavailable, time])
    if estimate is None:
        remedies = [WITHHOLD, DEVIATIONS] if cameras >= MIN_CAMERAS or axisymmetric else [DEVIATIONS]
        reasons = [unavailable or "no view was withheld", advice(remedies, result.settings), time]
        return Verdict.of("cannot tell", None, reasons)
    doubts = [doubt]
    if cameras == 1:
        doubts.append(ONE_CAMERA)
    elif cameras < MIN_CAMERAS and not axisymmetric:  # no metric shows what few views leave open
        doubts.append(f"{cameras} views leave much of the field undetermined")
    if outcome == "interrupted":
        doubts.append("the run was interrupted")
    if any(doubts) or estimate.error > MAX_USE or _short_of_time(result):
        return Verdict.of("use with care", estimate, [common, *(f"but {text}" for text in doubts if text), time])
    if not withheld and (poor := _poor_first_run(result)):
        return Verdict.of("cannot tell", None, [poor, time])
    return Verdict.of("use", estimate, [common, "no view contradicts the others", time])


def cut_off(fitted: Sequence[View]) -> str:
    """Return the view in which the flow is cut off most by an edge of the image, and the remedy; empty without one."""
    worst = max((v for v in fitted if "cut_edge" in v), key=lambda v: v["cut_signal"], default=None)
    if worst is None:
        return ""
    return (
        f"the {worst['measured']} does not fall to zero at the edge of the view ({worst['name']}, {worst['cut_edge']}: "
        f"{worst['cut_signal']:.0%} of the rms of the image): the flow is wider than the images, and no estimate "
        f"includes what lies outside; {REMEDY}"
    )


def _poor_first_run(result: Result) -> str:
    """Why cross-validation gives no estimate: a view that its run explains too little of; empty if none."""
    first = result.metrics.cross_validation
    views = _fitted_quantities(first["views"] if first else [], result)
    share = _explained(views, _noise(_fitted_quantities(first["fitted_views"] if first else [], result)))
    if share is None or share >= MIN_PREDICTED:
        return ""
    more = f"; {longer(result)} makes it longer" if longer(result) else ""
    text = f"the cross-validation run explains {share:.0%} of the squared signal of its withheld view"
    return f"{text} {views[0]['name']}: too little for an estimate{more}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"


def _complete(view: View) -> bool:
    return view["rms_predicted"] > 0 and math.isfinite(view["rms"])


def _fitted_quantities(views: Sequence[View], result: Result) -> list[View]:
    """Return the complete views, without the images of a measurement whose displacements were fitted."""
    displacements = result.settings.get("from") == "displacements"
    images = {kind.measured for kind in TECHNIQUES.values() if kind.derived} if displacements else set()
    return [v for v in views if _complete(v) and v["measured"] not in images]


def _quantities(views: Sequence[View]) -> list[str]:
    """What was measured, without quantities derived from images among them: windows blur those."""
    measured = list(dict.fromkeys(v["measured"] for v in views))
    derived = {TECHNIQUES[k.derived].measured for k in TECHNIQUES.values() if k.derived and k.measured in measured}
    return [name for name in measured if name not in derived]


def _noise(fitted: Sequence[View]) -> dict[str, float]:
    """The rms noise of a view for each measured quantity.

    The pixel-to-pixel noise of the residuals or, where larger (correlated noise), the stated sigma, but at most the
    residual of the fitted views.
    """
    noise = {}
    for name in dict.fromkeys(v["measured"] for v in fitted):
        group = [v for v in fitted if v["measured"] == name]
        residual = statistics.median(v["rms"] for v in group)
        white = statistics.median(v.get("rms_white", residual) for v in group)
        stated = statistics.median(v.get("rms_sigma", white) for v in group)
        noise[name] = max(white, min(stated, residual))
    return noise


def _squares(view: View, noise: float) -> tuple[float, float]:
    """Mean squares of the residual and of the signal of a view, less that of the noise."""
    signal = view["rms_predicted"] ** 2
    if "rms_measured" in view:
        signal = view["rms_measured"] ** 2 - noise**2
    return max(view["rms"] ** 2 - noise**2, 0.0), max(signal, 0.0)


def _explained(views: Sequence[View], noise: dict[str, float]) -> float | None:
    """The explained share of the squared signal, smallest of all quantities; None without a signal."""
    shares = []
    for name in _quantities(views):
        squares = [_squares(v, noise[name]) for v in views if v["measured"] == name and name in noise]
        signal = sum(s for _, s in squares)
        if signal > 0:
            shares.append(1 - sum(r for r, _ in squares) / signal)
    return min(shares, default=None)


def _from_views(
    result: Result, withheld: Sequence[View], fitted: Sequence[View]
) -> tuple[Estimate | None, str]:  # fmt: skip
    """The estimate from withheld views, of the whole run else of cross-validation; or None, and why there is none."""
    first = result.metrics.cross_validation
    first_views, first_fitted = (
        _fitted_quantities(first[key] if first else [], result) for key in ("views", "fitted_views")
    )
    noise = _noise(fitted)
    for views, basis in (
        (withheld, "withheld from the run"),
        (first_views, "withheld from the cross-validation run"),
    ):
        usable = [v for v in views if v["measured"] in noise and v["measured"] in _quantities(views)]
        if not usable:
            continue
        largest, factor = max(_withheld(v, noise) for v in usable), A_WITHHELD
        if views is first_views:
            share = _explained(first_fitted, noise)
            if share is not None and share < MIN_EXPLAINED:
                run = f"the cross-validation run, without view {usable[0]['name']}, was too short"
                more = f"; {longer(result)} makes it longer" if longer(result) else ""
                return None, f"{run}: it explains {share:.0%} of its data{more}"
            largest, factor = _after_first_run(largest, fitted, first_fitted, noise), A_FIRST_RUN
        misfit, white, pixels = _misfit(fitted, noise)
        noisy = white * math.sqrt(N0_PIXELS / pixels) if pixels else white
        error = math.hypot(factor * largest, B_MISFIT * misfit, C_NOISE * noisy)
        if not math.isfinite(error):
            return None, "the signal of a view is below the noise"
        names = list(dict.fromkeys(v["name"] for v in usable))
        whose = f"view {names[0]}" if len(names) == 1 else f"{len(names)} views"
        return Estimate.within(error, VIEWS_FACTOR, f"estimated by predicting {whose}, {basis}"), ""
    return None, ""


def _withheld(view: View, noise: dict[str, float]) -> float:
    """e of a withheld view."""
    white = noise[view["measured"]]
    residual, signal = _squares(view, white)
    return _ratio(max(residual, white**2 * _scatter(view.get("pixels") or 0)), signal)


def _after_first_run(
    error: float, fitted: Sequence[View], first_fitted: Sequence[View], noise: dict[str, float]
) -> float:  # fmt: skip
    """e after the main run from e_1 (error); e_1 itself where the misfit of the cross-validation run is unknown."""
    if not first_fitted:
        return error
    (after, *_), (before, white, pixels) = _misfit(fitted, noise), _misfit(first_fitted, noise)
    scatter = white**2 * _scatter(pixels)  # of the one view of which f_1 is known
    trained = min(max(_ratio(after**2 + scatter, before**2 + scatter), MIN_MISFIT_RATIO), 1.0)
    undetermined = math.sqrt(max(error**2 - (K_UNTRAINED * before) ** 2, 0.0))
    return max(trained * error, G_UNDETERMINED * undetermined)


def _scatter(pixels: int) -> float:
    """Relative standard deviation of the mean square of white noise."""
    return math.sqrt(2 / pixels) if pixels else 0.0


def _ratio(square: float, of: float) -> float:
    return math.sqrt(square / of) if of > 0 else math.inf


def _misfit(fitted: Sequence[View], noise: dict[str, float]) -> tuple[float, float, int]:
    """f, s and N of the measured quantity with the largest misfit."""
    misfits = []
    for name in _quantities(fitted):
        group = [v for v in fitted if v["measured"] == name and name in noise]
        if group:
            squares = [_squares(v, noise[name]) for v in group]
            residual, signal = (statistics.fmean(column) for column in zip(*squares, strict=True))
            pixels = sum(v.get("pixels") or 0 for v in group)
            misfits.append((_ratio(residual, signal), _ratio(noise[name] ** 2, signal), pixels))
    return max(misfits)


def _deviation(result: Result) -> float | None:
    """The rms standard deviation in the flow over the rms of the field there."""
    name = field_of(result.volumes)
    std = result.volumes.get(f"{name}_std")
    if name is None or std is None:
        return None
    values = result.volumes[name].values.double()
    flow = values.abs() > FLOW * values.nan_to_num(0.0).abs().max()
    size = float(values[flow].norm())
    return float(std.values.double()[flow].norm()) / size if size > 0 else None


def _contradiction(fitted: Sequence[View], result: Result, estimate: Estimate | None) -> tuple[str, bool]:
    """Which view contradicts the others, and whether severely.

    Correlated noise, as of interrogation windows, is in every view; a contradiction is an outlier, or has a pattern.
    Where the fit includes the cause of the pattern, the residual is severe if the estimate does not account for it.
    """
    for name in dict.fromkeys(v["measured"] for v in fitted):
        group = [v for v in fitted if v["measured"] == name]
        parts = {v["name"]: correlated_share(v) for v in group}
        limit = OUTLIER * statistics.median(parts.values())
        tests = {v["name"]: v.get("residual_test", WHITE) for v in group}
        doubtful = [
            view for view, test in tests.items()
            if test["grain"] > DOUBTFUL[0] and parts[view] > DOUBTFUL[1] and (test["cause"] or parts[view] > limit)
        ]  # fmt: skip
        if doubtful:
            worst = max(doubtful, key=lambda view: parts[view])
            grain, cause, part = tests[worst]["grain"], tests[worst]["cause"], parts[worst]
            views = f"residuals of {len(doubtful)} views are"
            views = views if len(doubtful) > 1 else f"the residual of view {worst} is"
            severe = grain > SEVERE[0] and part > SEVERE[1] and part > limit
            if severe and is_fitted(cause, result.settings):
                cause, severe = "", estimate is None or part > estimate.high
            likely = likely_cause(cause, result, _over_noise(group, worst))
            return f"{views} spatially correlated ({worst}: {percent(part)} of the signal), as with {likely}", severe
        shares = {v["name"]: v["rms"] / v["rms_predicted"] for v in group}
        worst, median = max(shares, key=lambda k: shares[k]), statistics.median(shares.values())
        if median > 0 and shares[worst] > UNEVEN * median:
            return f"view {worst}: residual {shares[worst] / median:.1f} × the median of all views", False
    return "", False


def _over_noise(views: Sequence[View], name: str) -> float:
    """The rms of the residual of a view over the stated noise, else over that of neighbouring pixels."""
    view = next(v for v in views if v["name"] == name)
    noise = view.get("rms_sigma") or view.get("rms_white") or 0.0
    return view["rms"] / noise if noise > 0 else math.inf


def _asymmetry(asymmetry: Sequence[HalfAsymmetry]) -> tuple[str, bool]:
    """How far the measurement is from axisymmetric, and whether too far."""
    worst = max(asymmetry, key=lambda d: d["antisymmetry"])
    cc, share = min(worst["cc"].values()), worst["antisymmetry"]
    halves = f"the halves of {worst['name']} correlate by {cc:.2f}, and {share:.0%} of the signal is antisymmetric"
    severe = share > NOT_SYMMETRIC
    return f"the flow is {'not' if severe else 'only roughly'} axisymmetric: {halves}", severe


def correlated_share(view: View) -> float:
    """Return the spatially correlated part of the residual of a view, relative to the rms prediction."""
    test = view.get("residual_test")
    return float(test["correlated"] * view["rms"] / (view.get("rms_predicted") or math.inf)) if test else 0.0


def time_of_fit(result: Result) -> str:
    """Return how much of the time limit the fit had; empty if it did not end there."""
    share = _share_of_limit(result)
    if share is None:
        return ""
    seconds = share * result.settings["time_limit"]
    return f"the fit had {seconds:.0f} s of the time limit of {result.settings['time_limit']:g} s ({share:.0%})"


def _short_of_time(result: Result) -> bool:
    """Whether the time limit has cut the fit short; a bootstrap trial has as much time as the fit."""
    share, uncertainty = _share_of_limit(result), result.metrics.uncertainty
    trials = uncertainty["trials"] if uncertainty and uncertainty.get("source") == "bootstrap" else 0
    return share is not None and share * (1 + trials) < LITTLE


def _share_of_limit(result: Result) -> float | None:
    limit, seconds = float(result.settings.get("time_limit", 0.0)), result.metrics.seconds
    return seconds / limit if result.metrics.outcome == "time_limit" and limit and seconds is not None else None
