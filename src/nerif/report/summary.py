"""The first screen of a report: what was measured, what came out, can it be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from nerif.analysis.evaluation import rms_text
from nerif.analysis.residuals import CAUSES
from nerif.analysis.verdict import verdict
from nerif.common.conventions import with_unit
from nerif.data.volume import INDEX, field_of, name_of
from nerif.forward.registry import TECHNIQUES
from nerif.physics.quantities import TEMPERATURE_RANGE
from nerif.plotting.drawing import LABELS, drawn_of, shown
from nerif.plotting.notebook import number, percent, span
from nerif.reconstruction.files import FIELD
from nerif.reconstruction.rig.parameters import moved_lines
from nerif.report.packing import relation
from nerif.results.directory import METRICS, VOLUME, Result

__all__ = ["Statement", "came_out", "headline", "looked", "measured", "repeated", "trust", "trust_figures"]

VITAL = (FIELD, METRICS, VOLUME)
"""Without these nothing can be said of a result; without the others less can be shown."""

LEVELS = ("good", "note", "warning", "bad")
OF_WORD = {"use": "good", "use with care": "warning", "do not use": "bad", "cannot tell": "note"}
WITHHELD_CC = 0.95  # a view that was not seen is predicted this well in all our simulated cases with nine views
TRUTH_CC = 0.98, 0.9  # good and fair, of all our simulated cases
NAMED = 4  # views
ALIKE = 0.01  # of what is predicted: smaller leftovers, even if they are alike, move a field by less than noise does
NOISE_BAND = 0.7, 1.4  # rms residual over sigma that noise alone explains; sigma itself is known to a factor of about 2


@dataclass(frozen=True)
class Statement:
    """One thing to know before trusting a result.

    Parameters
    ----------
    level : good, note, warning or bad
    text : one or two sentences, with the remedy where there is one
    """

    level: str
    text: str


def measured(result: Result) -> list[tuple[str, str]]:
    """Return what was measured, as names and values with units."""
    m = result.measurement
    if m is None:
        return [("Measurement", str(result.settings.get("measurement", "unknown")))]
    withheld = result.settings.get("withhold", ()) if result.reprojection is None else result.reprojection.withheld
    return m.summary(len(set(withheld) & set(m.names)))


def came_out(result: Result) -> list[tuple[str, str]]:
    """Return what was reconstructed: ranges of the quantities, and what they rest on."""
    rows = [("Method", result.method)]
    for quantity in drawn_of(result.volumes):
        volume = result.volumes[quantity]
        name, unit = LABELS.get(quantity, (quantity, volume.unit))
        digits = 4 if quantity == "temperature" else 3
        rows.append((name if quantity == "n" else name.capitalize(), span(shown(volume), unit, digits)))
    ambient = _ambient_temperature(result)
    if ambient is not None:
        rows.append(("Ambient, implied", f"{ambient:.1f} K"))
    if result.volumes:
        shape = next(iter(result.volumes.values())).grid.shape
        rows.append(("Voxels", " × ".join(str(n) for n in shape[::-1]) + " (x, y, z)"))
    if result.metrics.get("seconds") is not None:
        memory = result.metrics.get("peak_memory_bytes")
        beside = f", {memory / 2**30:.2f} GiB" if memory else ""
        rows.append(("Time", f"{result.metrics['seconds']:.0f} s on {result.metrics.get('device', '?')}{beside}"))
    return rows


def _ambient_temperature(result: Result) -> float | None:
    """Temperature that n_ambient stands for under the assumptions made, K."""
    volume = result.volumes.get("temperature")
    if volume is None:
        return None
    found = relation("temperature", volume.attributes)
    return found["factor"] / found["offset"] if found["offset"] > 0 else None


def trust_figures(result: Result) -> list[tuple[str, str]]:
    """Return the figures by which to trust it: held-out and training views, outcome, truth, error bars."""
    held, seen = _views(result, True), _views(result, False)
    rows = []
    for title, views in (("Held-out view", held), ("Training views", seen)):
        of = dict.fromkeys(v["measured"] for v in views)
        for measured in of:
            own = [v for v in views if v["measured"] == measured]
            name = f"{title}{'s' if views is held and len(own) > 1 else ''}{f', {measured}' if len(of) > 1 else ''}"
            noise = _largest(own, "rms_over_sigma")
            beside = "" if noise is None else f" = {noise:.2f} σ"
            rms = rms_text(max(own, key=lambda v: v.get("rms") or 0.0), 3)
            worst = "" if len(own) == 1 else "at least "
            rows.append((name, f"CC {worst}{number(_smallest(own, 'cc'), 5)}, rms error {rms}{beside}"))
        if views is held and not views and looked(result):
            continue
        if not views:
            rows.append((title, "none" if seen else "not known"))
    for unseen in looked(result):
        place = _place(unseen, looked(result))
        rows.append((f"View {place}, while it was kept out", _scores(unseen)))
        same = [v for v in seen if (v["name"], v["measured"]) == (unseen["name"], unseen["measured"])]
        rows += [(f"View {place}, in the end", _scores(v)) for v in same]
    for view in result.metrics.get("views_refitted") or []:
        name = f"{view['name']}, camera refined"
        rows.append((name, _scores(view)))
    rig = [row for row in result.metrics.get("rig") or [] if "rms_after" in row]
    if rig:
        before, after = (max(row[name] for row in rig) for name in ("rms_before", "rms_after"))
        rows.append(("Worst view, as calibrated and refined", f"rms {before:.2f} σ, {after:.2f} σ"))
    if "outcome" in result.metrics:
        rows.append(("Outcome", str(result.metrics["outcome"]).replace("_", " ")))
    m = result.metrics
    if m.get("l2") is not None and m.get("l2_variation") is not None:
        errors = f"L2 {m['l2']:.2%}"
        if field_of(result.volumes) in (None, INDEX):  # the paper's L2 counts the ambient in
            errors += f", of the variation {m['l2_variation']:.2%}"
        rows.append(("Against the truth", f"{errors}; CC {number(m.get('cc'), 5)}, SSIM {number(m.get('ssim'), 4)}"))
    repetitions = repeated(result)
    found = field_of(result.volumes)
    spread = result.volumes.get("density_std", result.volumes.get(f"{found}_std"))
    if repetitions and spread is not None:
        base = spread.quantity.removesuffix("_std")
        size = float(np.sqrt(np.nanmean(spread.values.double().numpy() ** 2)))
        name, unit = LABELS.get(base, (base, spread.unit))
        text = f"σ of {name} rms {with_unit(number(size, 2), unit)}"
        rows.append((f"Error bars by {repetitions.get('members')} trials", text))
    coverage = result.metrics.get("coverage")
    if isinstance(coverage, dict):
        flow = coverage.get("share_in_flow")
        beside = "" if flow is None else f", {flow:.0%} of those in the flow"
        rows.append(("Truth within ±2 σ", f"{coverage['share']:.0%} of the voxels{beside}"))
    return rows


def _scores(view: dict[str, Any]) -> str:
    noise = view.get("rms_over_sigma")
    return f"CC {number(view['cc'], 5)}, rms error {rms_text(view, 3)}{'' if noise is None else f' = {noise:.2f} σ'}"


def trust(result: Result) -> list[Statement]:
    """Return what to know before trusting it, the gravest first."""
    found = [Statement("bad" if gap.what in VITAL else "note", gap.sentence) for gap in result.missing]
    found += _of_outcome(result) + _of_withheld(result) + _of_residual(result) + _of_leftovers(result)
    found += _of_truth(result)
    found += _of_gas(result) + _of_masks(result) + _of_repetitions(result) + _of_rig(result)
    return sorted(found, key=lambda s: -LEVELS.index(s.level))


def headline(result: Result) -> Statement:
    """Return the verdict, or that a file without which there is none is missing."""
    gap = next((gap for gap in result.missing if gap.what in VITAL), None)
    if gap is not None:
        return Statement("bad", f"Cannot tell: {gap.what} is missing or damaged, see below.")
    judged = verdict(result)
    return Statement(OF_WORD[judged.word], judged.sentence)


def _place(view: dict[str, Any], views: list[dict[str, Any]]) -> str:
    """Name of a view and, where several things were measured, of what is meant."""
    several = len({v["measured"] for v in views}) > 1
    return f"{view['name']}, {view['measured']}" if several else str(view["name"])


def _views(result: Result, withheld: bool) -> list[dict[str, Any]]:
    views = result.metrics.get("views")
    return [v for v in views if v.get("withheld") is withheld] if isinstance(views, list) else []


def looked(result: Result) -> list[dict[str, Any]]:
    """Scores of the view that was kept out of a short run first."""
    return list((result.metrics.get("cross_validation") or {}).get("views") or [])


def _values(views: list[dict[str, Any]], key: str) -> list[float]:
    return [float(v[key]) for v in views if v.get(key) is not None]


def _smallest(views: list[dict[str, Any]], key: str) -> float | None:
    return min(_values(views, key), default=None)


def _largest(views: list[dict[str, Any]], key: str) -> float | None:
    return max(_values(views, key), default=None)


def _of_outcome(result: Result) -> list[Statement]:
    outcome, message = result.metrics.get("outcome"), result.metrics.get("message", "")
    ended = "The run ended at its {}; a longer one may be more accurate."
    known = {
        "diverged": ("bad", f"The run diverged. {message}"),
        "collapsed": ("bad", f"The run found no field. {message}"),
        "interrupted": ("warning", f"The run was interrupted; --resume continues it. {message}"),
        "time_limit": ("note", ended.format("time limit")),
        "steps": ("note", ended.format("limit of steps")),
    }
    level, text = known.get(str(outcome), ("", ""))
    return [Statement(level, text.strip())] if text else []


def _of_withheld(result: Result) -> list[Statement]:
    seen, held = _views(result, False), _views(result, True)
    what = "The field predicts"
    if not held and looked(result):
        held, what = looked(result), "A first, short run predicts"
    if not held:
        if not seen:
            text = "The field was not compared with any view: nerif evaluate --measurement FILE does it."
            return [Statement("warning", text)]
        text = "No view was held out, so the field was not checked against data the reconstruction has not seen."
        return [Statement("warning", f"{text} Repeat with --withhold auto, or a view.")]
    known = [v for v in held if v.get("cc") is not None]
    if not known:
        return [Statement("warning", "The held-out views have no pixels to compare.")]
    worst = min(known, key=lambda v: v["cc"])
    cc, noise, name = worst["cc"], _largest(known, "rms_over_sigma"), _place(worst, known)
    among = f"; the worst of {len(known)}" if len(known) > 1 else ""
    if held == looked(result):  # of a short run, which is no measure of the long one: the verdict allows for that
        text = f"{what} what has not been seen (view {name}{among}) with CC {cc:.4f}; the whole run has used it."
        return [Statement("good" if cc >= WITHHELD_CC else "note", text)]
    if cc >= WITHHELD_CC:
        beyond = "" if noise is None or noise <= 2 else f", though the error is {noise:.1f} times the noise"
        text = f"{what} what has not been seen (view {name}{among}): CC {cc:.4f}{beyond}."
        return [Statement("warning" if beyond else "good", text)]
    text = f"{what} poorly what has not been seen (view {name}{among}): CC {cc:.3f}."
    remedy = "More views, or a look at the calibration (nerif check), may help."
    of_noise = noise is not None and noise <= 2
    return [Statement("warning" if cc >= 0.8 or of_noise else "bad", f"{text} {remedy}")]


def _of_residual(result: Result) -> list[Statement]:
    seen = _views(result, False)
    if not seen:
        text = "No training view was compared, so there is no telling whether what is left unexplained is noise."
        remedy = "nerif evaluate --measurement FILE compares the views of the reconstruction."
        return [Statement("note", f"{text} {remedy}")] if _views(result, True) else []
    known = [v for v in seen if v.get("rms_over_sigma") is not None]
    if not known:
        text = "The noise of the measurement is not known, so there is no telling whether the residual is noise."
        remedy = "nerif displacement writes sigma." if _of_images(seen[0]["measured"]) else "Give its sigma."
        return [Statement("note", f"{text} {remedy}")]
    lowest, highest = (f(known, key=lambda v: v["rms_over_sigma"]) for f in (min, max))
    low, high = lowest["rms_over_sigma"], highest["rms_over_sigma"]
    found = []
    if high > NOISE_BAND[1]:
        text = f"The residual of training view {_place(highest, known)} is {high:.1f} times the stated noise"
        remedy = "Look at the length of the run, open faces, the calibration (nerif check), whether sigma is too small."
        white = bool((highest.get("leftover") or {"white": False})["white"])
        level = "warning" if high <= 3 or white else "bad"  # what is white may be noise that is mis-stated
        found.append(Statement(level, f"{text}: not explained. {remedy}"))
    if low < NOISE_BAND[0]:
        text = f"The residual of training view {_place(lowest, known)} is {low:.2f} of the stated noise"
        found.append(Statement("warning", f"{text}: the field follows noise, or sigma is too large."))
    if not found:
        text = "What the field leaves unexplained in the training views"
        found.append(Statement("good", f"{text} is {low:.2f} to {high:.2f} of the noise."))
    return found


def _of_leftovers(result: Result) -> list[Statement]:
    """Residuals of which neighbours are alike, by what they have the pattern of."""
    seen = [v for v in _views(result, False) if not (v.get("leftover") or {"white": True})["white"]]
    found = []
    for cause in dict.fromkeys(v["leftover"]["cause"] for v in seen):
        own = sorted((v for v in seen if v["leftover"]["cause"] == cause), key=lambda v: -v["leftover"]["grain"])
        worst, size = own[0], _left_alike(own[0])
        names = ", ".join(_place(v, seen) for v in own[:NAMED]) + (", ..." if len(own) > NAMED else "")
        where = f"row {worst['leftover']['row']:.0f}, column {worst['leftover']['column']:.0f}"
        text = (
            f"What is left of {len(own)} training view{'s' if len(own) > 1 else ''} ({names}) is not white: neighbours "
            f"are alike, to {size:.1%} of what is predicted, most in {_place(worst, seen)} around {where}"
        )
        why = CAUSES.get(cause, "it has the pattern of no cause that is known: flow beyond the box, too short a run?")
        found.append(
            Statement("warning" if size > ALIKE else "note", f"{text}. As where {why}." if cause else f"{text}; {why}")
        )
    return found


def _left_alike(view: dict[str, Any]) -> float:
    """The size of what is alike in a residual, over what is predicted."""
    signal = view.get("rms_predicted") or float("inf")
    return float(view["leftover"]["alike"] * view["rms"] / signal)


def _of_images(measured: str) -> bool:
    """Whether nerif displacement measures it, from images of a background."""
    return any(kind.background for kind in TECHNIQUES.values() if kind.measured == measured)


def _of_truth(result: Result) -> list[Statement]:
    cc, variation = result.metrics.get("cc"), result.metrics.get("l2_variation")
    if cc is None or variation is None:
        return []
    level = "good" if cc >= TRUTH_CC[0] else "warning" if cc >= TRUTH_CC[1] else "bad"
    found = field_of(result.volumes) or INDEX
    of = "n" if found == INDEX else name_of(found)
    text = f"Against the truth: CC {cc:.4f}, error {variation:.1%} of the variation of {of}."
    return [Statement(level, text)]


def _of_gas(result: Result) -> list[Statement]:
    ambient = _ambient_temperature(result)
    low, high = TEMPERATURE_RANGE
    if ambient is None or low <= ambient <= high:
        return []
    text = f"The ambient index would mean {ambient:.3g} K in the gas assumed"
    return [Statement("warning", f"{text}: density and temperature do not apply here. See --gas.composition.")]


def repeated(result: Result) -> dict[str, Any]:
    """Return what metrics.json has of the trials of the bootstrap; nothing where there are none."""
    found = result.metrics.get("uncertainty")
    return found if isinstance(found, dict) else {}


def _of_repetitions(result: Result) -> list[Statement]:
    diverged = repeated(result).get("diverged") or []
    if not diverged:
        return []
    names = ", ".join(map(str, diverged))
    return [Statement("warning", f"Trials {names} diverged and are left out of the standard deviations.")]


def _of_rig(result: Result) -> list[Statement]:
    """What a refinement found: views that are not where they were calibrated, and those of which data tell nothing."""
    table = result.metrics.get("rig")
    if not table:
        return []
    first, *lines = moved_lines(table)
    found = [Statement("note", f"Cameras or images were {first}.")]
    return found + [Statement("warning", f"{line[0].upper()}{line[1:]}.") for line in lines]


def _of_masks(result: Result) -> list[Statement]:
    found = []
    for quantity in ("density", "temperature"):
        volume = result.volumes.get(quantity)
        count = int(volume.notes.get("masked_voxels", 0)) if volume is not None else 0
        if volume is None or not count:
            continue
        share = count / volume.values.numel()
        voxels = "voxel" if count == 1 else "voxels"
        where = volume.notes.get("masked_where")
        text = f"{quantity.capitalize()} is masked in {count} {voxels} ({percent(share)}): {where}."
        found.append(Statement("note" if share < 0.05 else "warning", text))
    return found
