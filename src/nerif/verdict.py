"""The verdict on a reconstruction, in one of a few words, by figures that any measurement has.

    e = sqrt(max(r_unseen^2 - r_seen^2, 0)) / rms predicted,      error of the field, over its variation = ratio e

r_unseen is the rms error of a view that was not seen, r_seen that of the views that were, which is their noise whatever
was stated. Standard deviations, where there are some, count if they tell more. The ratios, and the limits below, are
those of simulated measurements, good and spoiled; what they are worth on others is in
benchmarks/results/verdicts-cpu.md. No truth is looked at.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nerif.residuals import CAUSES
from nerif.result import Result
from nerif.volume import field_of

__all__ = ["WORDS", "Verdict", "verdict"]

WORDS = ("use", "use with care", "do not use", "cannot tell")

RATIO = 0.3  # error of the field over e of a view that a whole run has not seen
HASTE = {"nerif": 0.08}  # of e in a first, short run, which a network ends far from where it will be
USE, NOT = 0.035, 0.12  # of the variation: below it is to be used, above not
DOUBT, GRAVE = (1.7, 0.005), (2.2, 0.02)  # grain of a view's residual, and what is alike over what is predicted
FEW = 4  # views
STANDS = 1.5  # times what is alike in the median view
ODD, ALIEN = 0.25, 0.4  # what is odd about the axis, over what was measured, of a flow taken as axisymmetric
UNEVEN = 1.35  # residual of the worst view over that of the median one, each over what is predicted
FLOW = 0.02  # share of the largest value above which a voxel counts as flow


@dataclass(frozen=True)
class Verdict:
    """What to do with a result.

    Parameters
    ----------
    word : one of WORDS
    error : likely error of the field over its variation, or None
    why : what speaks for it, in words
    """

    word: str
    error: float | None
    why: str

    @property
    def sentence(self) -> str:
        """The verdict and what it rests on."""
        error = "" if self.error is None else f"its error is likely some {self.error:.1%} of the variation, judged by "
        return f"{self.word[0].upper()}{self.word[1:]}: {error}{self.why}."


def verdict(result: Result) -> Verdict:
    """Judge a result by its figures alone."""
    metrics = result.metrics
    outcome = metrics.get("outcome")
    if outcome in ("diverged", "collapsed"):
        return Verdict("do not use", None, f"the run {outcome}")
    views = metrics.get("views")
    views = [v for v in views if _known(v)] if isinstance(views, list) else []
    seen = [v for v in views if not v["held_out"]]
    error, by = _error(result, views, seen)
    doubt, grave = _contradicted(seen)
    symmetry = (metrics.get("axis") or {}).get("symmetry") or {}
    alike = bool(symmetry) and not symmetry.get("harmonics")  # one view shows it all; with harmonics halves may differ
    if alike and any(d["departure"] > ODD for d in metrics.get("departures") or []):
        uneven, alien = _asymmetric(metrics["departures"])
        doubt, grave = "; ".join(filter(None, (uneven, doubt))), grave or alien
    if grave:
        return Verdict("do not use", None, doubt)
    if error is not None and error > NOT:
        return Verdict("do not use", error, "; ".join(filter(None, (by, doubt))))
    if error is None:
        why = "no view was kept out, and there are no standard deviations (--uncertainty fast)"
        return Verdict("use with care" if doubt else "cannot tell", None, doubt or why)
    cameras = len({v["name"] for v in seen})  # a view has an entry for each technique
    if cameras < FEW and not alike:  # what they do not show is in no figure
        open_ = f"{cameras} view{'s leave' if cameras > 1 else ' leaves'} much open"
        doubt = "; ".join(filter(None, (doubt, open_)))
    doubts = [by, *([doubt] if doubt else []), *(["the run was interrupted"] if outcome == "interrupted" else [])]
    if len(doubts) > 1 or error > USE:
        return Verdict("use with care", error, "; but ".join(doubts))
    return Verdict("use", error, f"{by}; no view contradicts the others")


def _known(view: Any) -> bool:
    return isinstance(view, dict) and bool(view.get("rms_predicted")) and view.get("rms") is not None


def _error(result: Result, views: Sequence[dict[str, Any]], seen: Sequence[dict[str, Any]]) -> tuple[float | None, str]:
    """The likely error over the variation, and what it is judged by."""
    told = [(deviation, "its standard deviations")] if (deviation := _deviation(result)) is not None else []
    predicted, by = _unseen(result, views, seen)
    told += [(predicted, by)] if predicted is not None else []
    return max(told) if told else (None, "")


def _unseen(
    result: Result, views: Sequence[dict[str, Any]], seen: Sequence[dict[str, Any]]
) -> tuple[float | None, str]:
    """The same by how well a view was predicted that had not been seen."""
    if not seen:
        return None, ""
    noise = {name: statistics.median(v["rms"] for v in seen if v["measured"] == name) for name in _measured(seen)}
    left_out = (result.metrics.get("ensemble") or {}).get("left_out") or []
    looked = (result.metrics.get("first_look") or {}).get("views") or []
    haste = HASTE.get(str(result.settings.get("method", "")), RATIO)
    for unseen, ratio, by in (
        ([v for v in views if v["held_out"]], RATIO, "what is predicted of a view that was held out"),
        (left_out, RATIO, "what is predicted of views that were left out"),
        (looked, haste, "what was predicted of a view before it was used"),
    ):
        known = [v for v in unseen if _known(v) and v["measured"] in noise]
        if known:
            largest = max(
                math.sqrt(max(v["rms"] ** 2 - noise[v["measured"]] ** 2, 0.0)) / v["rms_predicted"] for v in known
            )
            return ratio * largest, by
    return None, ""


def _measured(views: Sequence[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(v["measured"] for v in views))


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


def _contradicted(seen: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    """Which view the others contradict, in words, and whether gravely.

    Noise that is alike, as windows leave it, is so in every view; what contradicts stands out, or has a pattern.
    """
    for name in _measured(seen):
        own = [v for v in seen if v["measured"] == name]
        alike = {v["name"]: _alike(v) for v in own}
        middle, worst = statistics.median(alike.values()), max(alike, key=lambda k: alike[k])
        lefts = {v["name"]: v.get("leftover") or {"grain": 1.0, "cause": ""} for v in own}
        out = [
            view for view, left in lefts.items()
            if left["grain"] > DOUBT[0] and alike[view] > DOUBT[1] and (left["cause"] or alike[view] > STANDS * middle)
        ]  # fmt: skip
        if out:
            views = f"{len(out)} view{'s' if len(out) > 1 else ''}"
            text = f"what is left of {views} is no noise, {alike[worst]:.1%} of what {worst} shows"
            grain, cause = lefts[worst]["grain"], lefts[worst]["cause"]
            text += f", as where {CAUSES[cause]}" if cause else "; nerif check may tell what is wrong with it"
            return text, grain > GRAVE[0] and alike[worst] > GRAVE[1] and alike[worst] > STANDS * middle
        shares = {v["name"]: v["rms"] / v["rms_predicted"] for v in own}
        worst, middle = max(shares, key=lambda k: shares[k]), statistics.median(shares.values())
        if middle > 0 and shares[worst] > UNEVEN * middle:
            return f"view {worst} is met {shares[worst] / middle:.1f} times worse than others", False
    return "", False


def _asymmetric(departures: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    """How far what was measured is from that of an axisymmetric flow, in words, and whether it is none."""
    worst = max(departures, key=lambda d: d["departure"])
    cc, odd = min(worst["cc"].values()), worst["departure"]
    halves = f"the halves of {worst['name']} correlate by {cc:.2f}, and {odd:.0%} of it is odd about the axis"
    alien = odd > ALIEN
    return (f"the flow is {'not' if alien else 'only roughly'} axisymmetric: {halves}"), alien


def _alike(view: dict[str, Any]) -> float:
    """What is alike in the residual of a view, over what is predicted."""
    left = view.get("leftover")
    return float(left["alike"] * view["rms"] / view["rms_predicted"]) if left else 0.0
