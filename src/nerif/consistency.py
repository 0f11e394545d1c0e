"""Do the views of a measurement agree with one another? And if not, which one is it, and what happened to it?

Each view is predicted by a quick reconstruction from the others. Mistakes that happen (mistakes.py) are undone one at a
time: the one that lets a reconstruction from all views fit clearly better is reported, then looked for another. What
fits equally well either way cannot be found: a flipped sign of everything, a mirrored picture of a symmetric flow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from nerif.conventions import InputError
from nerif.finding import Finding
from nerif.geometry import Grid
from nerif.geometry.plausibility import rig_findings
from nerif.measurement import Measurement
from nerif.mistakes import Correction, everywhere, exchanges, of_one_view, orders
from nerif.observation import Observation, integrals_of
from nerif.quick_views import (
    binned,
    compare,
    disagreement,
    fit,
    predicted_by_others,
    values_of,
    with_values,
    without_spikes,
)
from nerif.reconstruction.aperture import seen_through
from nerif.reconstruction.threads import on_free_cores
from nerif.symptoms import looks, open_faces
from nerif.unrelated import NOISY, repeatable, unrelated, unrelated_finding
from nerif.volume import INDEX

__all__ = ["Consistency", "ViewAgreement", "check_consistency"]

LONGEST = 48  # px along the longer edge of the pictures that are compared, whatever the size of the sensor
BETTER = 0.97  # a mistake is one if undoing it brings the objective of the joint fit below this share
SHORTLIST = 0.95  # worth a joint fit: undoing it brings the disagreement with the other views below this share
NO_EXCHANGE = 1.15  # two views are not worth a joint fit if they fit each other's prediction so much worse
EXCHANGE = 1.03  # two views are exchanged only if what the other views predict of them does not speak against it
BETTER_EVERYWHERE = 0.8  # and below this if it is to have happened to all views
FEW, BETTER_OF_FEW = 9, 0.9  # with fewer views, neighbours are further apart, and an exchange needs stronger evidence
UNLIKE = 0.5  # a view that agrees less than this share of the median, for no reason that is known
GAIN = 1.6  # a view whose values are this many times too large or too small


@dataclass(frozen=True)
class ViewAgreement:
    """How well one view agrees with the others.

    Parameters
    ----------
    name : of the view
    valid : share of its pixels that can be used
    agreement : correlation of what is measured with what the other views predict, mistakes that were found undone
    gain : factor by which measured values are larger than predicted
    verdict : what is wrong with it, or nothing
    measured : what is compared
    """

    name: str
    valid: float
    agreement: float
    gain: float
    verdict: str
    measured: str = "displacement"


@dataclass(frozen=True)
class Consistency:
    """What was found.

    Parameters
    ----------
    views : agreement of every view; empty if there are too few views to compare
    findings : mistakes, the worst first: no view predicted by the others, then the rig, then single views
    remarks : what a user should know besides
    corrections : what undoes the mistakes that can be undone, of each technique by its name (`corrected`)
    """

    views: tuple[ViewAgreement, ...]
    findings: tuple[Finding, ...]
    remarks: tuple[str, ...]
    corrections: Mapping[str, tuple[Correction, ...]] = field(default_factory=dict)


@on_free_cores
def check_consistency(
    measurement: Measurement, voxels: int = 24, on_step: Callable[[int, int], None] = lambda done, total: None,
    aperture: str = "auto",
) -> Consistency:  # fmt: skip
    """Compare every view with a quick reconstruction from the others, technique by technique.

    Parameters
    ----------
    measurement : of three views or more; of fewer only the data themselves are looked at
    voxels : of the quick reconstructions, along the longest edge
    on_step : called with the number of reconstructions done, and of those in this round
    aperture : whether views see through the whole of their lens (seen_through)

    Raises
    ------
    InputError
        If the aperture is "on" and none is known.
    """
    measurement = seen_through(measurement, aperture)
    observations = integrals_of(measurement)
    several = len(observations) > 1
    views: list[ViewAgreement] = []
    rig = rig_findings(measurement.cameras, measurement.box)
    past = {name for finding in rig if finding.code == "beside" for name in finding.views}
    findings: list[Finding] = []
    remarks: list[str] = []
    corrections: dict[str, tuple[Correction, ...]] = {}
    for observation in observations:
        try:
            own = _check(observation, measurement, voxels, on_step, past, [name for f in rig for name in f.views])
        except InputError as error:
            if not rig:
                raise
            remarks.append(f"views were not compared: {error}")
            continue
        of = f"{observation.technique.name}: " if several else ""
        views += own.views
        corrections |= own.corrections
        findings += [replace(finding, sentence=of + finding.sentence) for finding in own.findings]
        remarks += [of + remark for remark in own.remarks]
    hopeless = [finding for finding in findings if finding.code == "unrelated"]
    others = [finding for finding in findings if finding.code != "unrelated"]
    return Consistency(tuple(views), (*hopeless, *rig, *others), tuple(remarks), corrections)


def _check(
    observation: Observation, measurement: Measurement, voxels: int, on_step: Callable[[int, int], None],
    past: Collection[str], suspicious: Collection[str],
) -> Consistency:  # fmt: skip
    """Compare the views of one technique but those that look past the box; cameras of some may be wrong."""
    kind, measurement = observation.technique, observation.alone(measurement)
    seeing = [name for name in measurement.names if name not in past]
    if not seeing:
        return Consistency((), (), ("no view looks at the box: nothing can be compared",))
    measurement = measurement.select(seeing)
    small = without_spikes(binned(measurement, LONGEST))
    pixels = measurement.usable.flatten(1).sum(dim=1).tolist()
    valid = [n / (c.image_size[0] * c.image_size[1]) for n, c in zip(pixels, measurement.cameras, strict=True)]
    remarks = looks(measurement, small, valid)
    names = small.names
    if len(names) < 3:
        return Consistency((), (), (*remarks, "fewer than three views: they cannot be compared with one another"))
    found: list[Correction] = []
    uncorrected = small
    for _ in range(max(1, len(names) // 2)):
        correction = _most_likely_mistake(small, voxels, on_step)
        if correction is None:
            break
        found.append(correction)
        small = _without(correction, small)
    everything, objective = fit(small, voxels)
    if not objective > 0:
        nothing = f"every {kind.measured} of rays through the box is 0: there is nothing to compare"
        return Consistency((), (), (*remarks, nothing))
    views: list[ViewAgreement] = []
    compared = _compared(small, voxels)
    if unrelated([agreement for agreement, _ in compared], small):
        compared = _compared(uncorrected, voxels) if found else compared
        numbers = [i for i, name in enumerate(names) if name in suspicious]
        agreements = [agreement for agreement, _ in compared]
        finding = unrelated_finding(uncorrected, agreements, voxels, numbers, on_step)
        words = "not predicted by the others"
        for name, share, (agreement, gain) in zip(names, valid, compared, strict=True):
            views.append(ViewAgreement(name, share, agreement, gain, words, kind.measured))
        return Consistency(tuple(views), (finding,), tuple(remarks))
    if repeatable(small) < NOISY:
        remarks.append("noise hides most of what was measured, and with it whether the views agree")
    findings = [_finding(c, names) for c in found]
    middle = float(torch.tensor([a for a, _ in compared]).median())
    oddest = max(range(len(names)), key=lambda i: abs(math.log(max(compared[i][1], 1e-6))))  # it pulls at the others
    for i, (agreement, gain) in enumerate(compared):
        own = [c for c in found if i in c.views and len(c.views) < len(names)]
        verdict, code = "; ".join(c.words for c in own), ""
        if not own and agreement < UNLIKE * middle and middle > 0.3 and len(names) > 4:
            verdict, code = "does not fit the other views: wrong calibration, other flow, or other time?", "unlike"
        elif not own and i == oddest and not 1 / GAIN < gain < GAIN and agreement > 0.5:
            verdict = f"{kind.measured} {gain:.2g} times what the other views predict: {kind.misscaled}?"
            code = "misscaled"
        if code:
            findings.append(Finding(code, f"view {names[i]}: {verdict}", (names[i],)))
        views.append(ViewAgreement(names[i], valid[i], agreement, gain, verdict, kind.measured))
    if not any(v.verdict for v in views) or found:  # a view that does not fit has rays through every face
        findings += open_faces(everything, small)
    if kind.quantity == INDEX:
        mean = float(everything.sample(Grid.of_resolution(small.box, voxels)).mean())
        gas = "lighter (hot gas, helium)" if mean < 0 else "denser (cold or heavy gas)"
        remarks.append(f"the flow comes out {gas} than the ambient; if that is wrong, every sign is flipped")
    undone = {kind.name: tuple(found)} if found else {}
    return Consistency(tuple(views), tuple(findings), tuple(remarks), undone)


def _most_likely_mistake(small: Measurement, voxels: int, on_step: Callable[[int, int], None]) -> Correction | None:
    """The one mistake whose undoing helps the joint fit most, if it helps clearly."""
    views = range(len(small.names))
    observation, d = small.observations[0], values_of(small)
    alike, done = [*everywhere(observation, small.cameras), *orders(small.cameras)], 0

    def step(total: int) -> None:
        nonlocal done
        done += 1
        on_step(done, total)

    likely, agreements, predictions = [], [], []
    for i in views:
        predicted = predicted_by_others(small, [i], voxels)[i]
        now = disagreement(predicted, small, i, d[i])
        agreements.append(compare(predicted, small, i)[0])
        ways = of_one_view(i, observation, small.cameras)
        left = [disagreement(predicted, small, i, c.undo(d, small.cameras)[i]) for c in ways]
        likely += [c for c, x in zip(ways, left, strict=True) if x < SHORTLIST * now]
        predictions.append(predicted)
        step(2 * len(views))
    likely += [c for c in exchanges(small.cameras) if _crossed(dict(enumerate(predictions)), small, c) < NO_EXCHANGE]
    _, before = fit(small, voxels, 1e-4)
    if not before > 0:  # nothing was measured
        return None
    results = []
    for correction in [*likely, *alike]:
        gain = fit(_without(correction, small), voxels, 1e-4)[1] / before
        limit = BETTER_EVERYWHERE if len(correction.views) == len(views) else BETTER
        results.append((gain / limit, gain, correction))  # what all views have must gain more than what a few have
        step(len(views) + len(likely) + len(alike))
    enough = UNLIKE * float(torch.tensor(agreements).median())
    for over_limit, gain, correction in sorted(results, key=lambda r: r[0]):
        if over_limit > 1:
            return None
        if correction.change is None and len(correction.views) == 2:
            clear = len(views) >= FEW or gain < BETTER_OF_FEW
            expected = predicted_by_others(small, correction.views, voxels)
            if not clear or _crossed(expected, small, correction) > EXCHANGE:
                continue
        if len(correction.views) == len(views) or _fits(_without(correction, small), correction.views, enough, voxels):
            return correction
    return None


def _fits(mended: Measurement, views: Sequence[int], enough: float, voxels: int) -> bool:
    """Whether views agree with the others once mended; one that does not has something else."""
    predicted = predicted_by_others(mended, views, voxels)
    return all(compare(predicted[i], mended, i)[0] >= enough for i in views)


def _without(correction: Correction, small: Measurement) -> Measurement:
    return with_values(small, correction.undo(values_of(small), small.cameras))


def _crossed(predicted: dict[int, Tensor], small: Measurement, pair: Correction) -> float:
    """Disagreement of two views with predictions of each other, as a share of that with their own."""
    i, j = pair.views
    d = values_of(small)
    straight = sum(disagreement(predicted[k], small, k, d[k]) for k in (i, j))
    crossed = disagreement(predicted[i], small, i, d[j]) + disagreement(predicted[j], small, j, d[i])
    return crossed / max(straight, 1e-30)


def _compared(small: Measurement, voxels: int) -> list[tuple[float, float]]:
    """Agreement and gain of every view with what the others predict of it."""
    return [compare(predicted_by_others(small, [i], voxels)[i], small, i) for i in range(len(small.names))]


def _finding(correction: Correction, names: Sequence[str]) -> Finding:
    views = tuple(names[i] for i in correction.views)
    return Finding(correction.code, f"{Finding.subject(views, len(names))}: {correction.words}", views)
