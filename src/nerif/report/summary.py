"""The first screen of a report: the measurement, the reconstruction and its accuracy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerif.analysis.asymmetry import asymmetry_sentence
from nerif.analysis.evaluation import rms_with_unit
from nerif.analysis.remedies import WITHHOLD, Remedy, advice, likely_cause, longer
from nerif.analysis.verdict import correlated_share, cut_off, time_of_fit, verdict
from nerif.common.conventions import percent, with_unit
from nerif.data.quantity_names import INDEX, field_of, name_of
from nerif.forward.registry import TECHNIQUES
from nerif.geometry.symmetry import Axis
from nerif.physics.media import stored_medium
from nerif.plotting.drawing import LABELS, plotted_quantities, plotted_values
from nerif.plotting.notebook import number, span
from nerif.reconstruction.field_files import FIELD
from nerif.reconstruction.reconstructor import END
from nerif.reconstruction.rig_parameters import refinement_lines
from nerif.report.packing import relation
from nerif.results.directory import METRICS, VOLUME, Result
from nerif.results.metrics_file import ViewScores

__all__ = [
    "Statement", "accuracy_rows", "cross_validated", "field_rows", "headline", "measurement_rows", "statements",
]  # fmt: skip

VITAL = (FIELD, METRICS, VOLUME)  # without these there is no verdict
LEVELS = ("good", "note", "warning", "bad")
LEVEL_OF_RATING = {"use": "good", "use with care": "warning", "do not use": "bad", "cannot tell": "note"}
MIN_CC = 0.95  # of a withheld view; reached in all our simulated cases with nine views
TRUTH_CC = 0.98, 0.9  # good and fair in our simulated cases
MAX_NAMES = 4  # of views in a sentence
CORRELATED = 0.01  # of the signal; smaller correlated residuals change a field less than noise does
NOISE_RANGE = 0.7, 1.4  # rms residual over sigma that noise alone explains; sigma is uncertain by a factor of about 2

View = ViewScores
Rows = list[tuple[str, str]]


@dataclass(frozen=True)
class Statement:
    """A statement on the accuracy of a result, with the remedy where there is one."""

    level: str  #: good, note, warning or bad
    text: str  #: one or two sentences


def measurement_rows(result: Result) -> Rows:
    """Return names and values of the measurement."""
    m = result.measurement
    if m is None:
        return [("Measurement", str(result.settings.get("measurement", "unknown")))]
    withheld = result.settings.get("withhold", ()) if result.reprojection is None else result.reprojection.withheld
    return m.summary(len(set(withheld) & set(m.names)))


def field_rows(result: Result) -> Rows:
    """Return names and values of the reconstruction: method, ranges of the quantities, cost."""
    rows = [("Method", result.method)]
    for quantity in plotted_quantities(result.volumes):
        volume = result.volumes[quantity]
        name, unit = LABELS.get(quantity, (quantity, volume.unit))
        digits = 4 if quantity == "temperature" else 3
        rows.append((name if quantity == "n" else name.capitalize(), span(plotted_values(volume), unit, digits)))
    ambient = _ambient_temperature(result)
    if ambient is not None:
        rows.append(("Ambient temperature, implied", f"{ambient:.1f} K"))
    if result.volumes:
        shape = next(iter(result.volumes.values())).grid.shape
        rows.append(("Voxels", " × ".join(str(n) for n in shape[::-1]) + " (x, y, z)"))
    if result.metrics.seconds is not None:
        memory = result.metrics.peak_memory_bytes
        gib = f", {memory / 2**30:.2f} GiB" if memory else ""
        rows.append(("Time of the fit", f"{result.metrics.seconds:.0f} s on {result.metrics.device or '?'}{gib}"))
    return rows


def _ambient_temperature(result: Result) -> float | None:
    """Temperature that corresponds to n_ambient in the assumed gas, K."""
    volume = result.volumes.get("temperature")
    if volume is None or "molar_mass_kg_mol-1" not in volume.attributes:
        return None
    ambient = relation("temperature", volume.attributes)
    return ambient["factor"] / ambient["offset"] if ambient["offset"] > 0 else None


def accuracy_rows(result: Result) -> Rows:
    """Return names and values of the accuracy: withheld and fitted views, outcome, truth, standard deviations."""
    metrics, rows = result.metrics, []
    withheld, fitted, first_run = _views(result, True), _views(result, False), cross_validated(result)
    for title, views in (("Withheld view", withheld), ("Fitted views", fitted)):
        quantities = dict.fromkeys(v["measured"] for v in views)
        for measured in quantities:
            group = [v for v in views if v["measured"] == measured]
            plural = "s" if views is withheld and len(group) > 1 else ""
            name = f"{title}{plural}{f', {measured}' if len(quantities) > 1 else ''}"
            rows.append((name, _scores(group)))
        if not views and not (views is withheld and first_run):
            rows.append((title, "none" if fitted else "unknown"))
    for view in first_run:
        place = _place(view, first_run)
        rows.append((f"View {place}, withheld from the cross-validation run", _scores([view])))
        same = [v for v in fitted if (v["name"], v["measured"]) == (view["name"], view["measured"])]
        rows += [(f"View {place}, fitted by the main run", _scores([v])) for v in same]
    rows += [(f"{view['name']}, camera refined", _scores([view])) for view in metrics.withheld_views]
    rig = [row for row in metrics.rig if "rms_after" in row]
    if rig:
        before, after = (max(row[name] for row in rig) for name in ("rms_before", "rms_after"))
        rows.append(("Worst view, before and after refinement", f"rms {before:.2f} σ, {after:.2f} σ"))
    if metrics.outcome is not None:
        rows.append(("Why it ended", END.get(metrics.outcome, metrics.outcome)))
    if metrics.l2 is not None and metrics.l2_variation is not None:
        errors = f"L2 {metrics.l2:.2%}"
        if field_of(result.volumes) in (None, INDEX):  # the paper's L2 includes the ambient
            errors += f", of the variation {metrics.l2_variation:.2%}"
        scores = f"CC {number(metrics.cc, 5)}, SSIM {number(metrics.ssim, 4)}"
        rows.append(("Against the truth", f"{errors}; {scores}"))
    spread = result.volumes.get("density_std", result.volumes.get(f"{field_of(result.volumes)}_std"))
    if metrics.uncertainty and spread is not None:
        quantity = spread.quantity.removesuffix("_std")
        rms = float(np.sqrt(np.nanmean(spread.values.double().numpy() ** 2)))
        name, unit = LABELS.get(quantity, (quantity, spread.unit))
        source = metrics.uncertainty.get("source", "bootstrap")
        samples = {"bootstrap": "bootstrap of", "posterior": "posterior draws:"}[source]
        title = f"Standard deviation, {samples} {metrics.uncertainty['trials']}"
        rows.append((title, f"rms {with_unit(number(rms, 2), unit)} of {name}"))
    if detail := metrics.detail:
        residuals = f"residual {detail['residual_before']:.2f} σ without it, {detail['residual_after']:.2f} σ with it"
        mean = "about the blurred field" if detail["blurred"] else "about the field"
        rows.append(("Detail", f"{mean}, {detail['voxels']} voxels; {residuals}"))
    if coverage := metrics.coverage:
        text = f"{coverage['two_sigma']:.0%} of the voxels, {coverage['two_sigma_in_flow']:.0%} of those in the flow"
        rows.append(("Truth within ±2 standard deviations", text))
    return rows


def _scores(views: list[View]) -> str:
    """The worst scores of some views."""
    cc, noise = _extreme(views, "cc", min), _extreme(views, "rms_over_sigma")
    rms = rms_with_unit(max(views, key=lambda v: v["rms"]), 3)
    least, most = ("at least ", "at most ") if len(views) > 1 else ("", "")
    return f"CC {least}{number(cc, 5)}, rms residual {most}{rms}{'' if noise is None else f' = {noise:.2f} σ'}"


def _extreme(views: Sequence[Any], key: str, extreme: Callable[..., float | None] = max) -> float | None:
    return extreme((v[key] for v in views if key in v and math.isfinite(v[key])), default=None)


def _place(view: View, views: list[View]) -> str:
    """Name of a view and, where several quantities were measured, of the quantity."""
    several = len({v["measured"] for v in views}) > 1
    return f"{view['name']}, {view['measured']}" if several else str(view["name"])


def _views(result: Result, withheld: bool) -> list[View]:
    return [v for v in result.metrics.views if v["withheld"] is withheld]


def cross_validated(result: Result) -> list[View]:
    """Return the scores of the view that was withheld from the run of a cross-validation."""
    first_run = result.metrics.cross_validation
    return list(first_run["views"]) if first_run else []


def headline(result: Result) -> Statement:
    """Return the verdict, or the file that is missing for one."""
    gap = next((gap for gap in result.missing if gap.name in VITAL), None)
    if gap is not None:
        return Statement("bad", f"Cannot tell: {gap.name} is missing or damaged, see below.")
    judgement = verdict(result)
    return Statement(LEVEL_OF_RATING[judgement.rating], judgement.sentence)


def statements(result: Result) -> list[Statement]:
    """Return what limits the accuracy of a result, and what supports it, most severe first."""
    remarks = [Statement("bad" if gap.name in VITAL else "note", gap.sentence) for gap in result.missing]
    for part in (
        _of_outcome, _of_withheld_views, _of_residuals, _of_correlated_residuals, _of_truth, _of_gas, _of_masks,
        _of_bootstrap, _of_rig, _of_axis,
    ):  # fmt: skip
        remarks += part(result)
    return sorted(remarks, key=lambda s: -LEVELS.index(s.level))


def _of_outcome(result: Result) -> list[Statement]:
    outcome, message = result.metrics.outcome, result.metrics.message or ""
    time = time_of_fit(result)
    limit = f"The run stopped at its {{}}{f' ({time})' if time else ''}; {longer(result)} may reduce the error."
    level, text = {
        "diverged": ("bad", f"The run diverged. {message}"),
        "collapsed": ("bad", f"The field collapsed to the ambient. {message}"),
        "interrupted": ("warning", "The run was interrupted; --resume continues it."),
        "time_limit": ("note", limit.format("time limit")),
        "steps": ("note", limit.format("limit of steps")),
    }.get(str(outcome), ("", ""))
    return [Statement(level, text.strip())] if text else []


def _of_withheld_views(result: Result) -> list[Statement]:
    withheld, first_run = _views(result, True), cross_validated(result)
    if not withheld and not first_run:
        if not _views(result, False):
            text = "The field was not compared with any view; nerif evaluate --measurement FILE does so."
        else:
            text = "No view was withheld, so the field is not validated against independent data. "
            repeat = Remedy("Repeat with --withhold auto, or the name of a view.", WITHHOLD.setting, WITHHOLD.values)
            text += advice([repeat], result.settings) or "Repeat with --withhold and the name of a view."
        return [Statement("warning", text)]
    views = [v for v in withheld or first_run if math.isfinite(v["cc"])]
    if not views:
        return [Statement("warning", "The withheld views have no valid pixels to compare.")]
    worst = min(views, key=lambda v: v["cc"])
    cc, noise, name = worst["cc"], _extreme(views, "rms_over_sigma"), _place(worst, views)
    among = f" (worst of {len(views)})" if len(views) > 1 else ""
    if not withheld:  # a run from which the verdict extrapolates
        text = f"The cross-validation run, without view {name}{among}, predicts it with CC {cc:.4f}; "
        return [Statement("good" if cc >= MIN_CC else "note", text + "the main run uses all views.")]
    if cc >= MIN_CC:
        beyond = "" if noise is None or noise <= 2 else f", but its residual is {noise:.1f} × the noise"
        text = f"The withheld view {name}{among} is predicted with CC {cc:.4f}{beyond}."
        return [Statement("warning" if beyond else "good", text)]
    text = f"The withheld view {name}{among} is predicted poorly: CC {cc:.3f}. "
    level = "warning" if cc >= 0.8 or (noise is not None and noise <= 2) else "bad"
    remedies = ", ".join(filter(None, ("More views", longer(result), "or a check of the calibration (nerif check)")))
    return [Statement(level, f"{text}{remedies}, may help.")]


def _of_residuals(result: Result) -> list[Statement]:
    fitted = _views(result, False)
    if not fitted:
        text = "No fitted view was compared, so it is unknown whether the residuals are noise. "
        text += "nerif evaluate --measurement FILE compares the views of the reconstruction."
        return [Statement("note", text)] if _views(result, True) else []
    views = [v for v in fitted if math.isfinite(v.get("rms_over_sigma", math.nan))]
    if not views:
        of_images = any(k.background for k in TECHNIQUES.values() if k.measured == fitted[0]["measured"])
        remedy = "nerif displacement writes sigma." if of_images else "Give its sigma."
        text = "The noise of the measurement is unknown, so it is unknown whether the residuals are noise."
        return [Statement("note", f"{text} {remedy}")]
    lowest, highest = (extreme(views, key=lambda v: v["rms_over_sigma"]) for extreme in (min, max))
    low, high = lowest["rms_over_sigma"], highest["rms_over_sigma"]
    remarks = []
    if high > NOISE_RANGE[1]:
        white = bool((highest.get("residual_test") or {"white": False})["white"])
        level = "warning" if high <= 3 or white else "bad"  # a white residual may be noise with a wrong sigma
        text = f"Fitted view {_place(highest, views)}: residual {high:.1f} times the noise: "
        faces = "" if result.settings.get("open_faces") else "flow that leaves the box (--open-faces), "
        causes = f"possible causes: {faces}the calibration (run nerif check), a sigma that is too small."
        text += f"run longer first ({longer(result)}); if it stays, run nerif check." if longer(result) else causes
        remarks.append(Statement(level, text))
    if low < NOISE_RANGE[0]:
        text = f"The residual of fitted view {_place(lowest, views)} is {low:.2f} times the noise: "
        remarks.append(Statement("warning", text + "the field fits noise, or sigma is too large."))
    return remarks or [Statement("good", f"The residuals of the fitted views are {low:.2f} to {high:.2f} × the noise.")]


def _of_correlated_residuals(result: Result) -> list[Statement]:
    views = [v for v in _views(result, False) if correlated_share(v) and not v["residual_test"]["white"]]
    if cut := cut_off(_views(result, False)):  # it leaves residuals of any pattern
        return [Statement("warning", f"{cut[0].upper()}{cut[1:]}.")]
    remarks = []
    for cause in dict.fromkeys(v["residual_test"]["cause"] for v in views):
        group = sorted(
            (v for v in views if v["residual_test"]["cause"] == cause), key=lambda v: -v["residual_test"]["grain"]
        )
        worst, share = group[0], correlated_share(group[0])
        names = ", ".join(_place(v, views) for v in group[:MAX_NAMES]) + (", ..." if len(group) > MAX_NAMES else "")
        verb = f"Residuals of {len(group)} fitted views ({names}) are"
        verb = verb if len(group) > 1 else f"The residual of fitted view {names} is"
        where = f"row {worst['residual_test']['row']:.0f}, column {worst['residual_test']['column']:.0f}"
        size = f"up to {percent(share)} of the signal"
        text = f"{verb} spatially correlated, {size} in {_place(worst, views)} around {where}."
        text += f" Likely cause: {likely_cause(cause, result, worst.get('rms_over_sigma', math.inf))}."
        remarks.append(Statement("warning" if share > CORRELATED else "note", text))
    return remarks


def _of_truth(result: Result) -> list[Statement]:
    cc, variation = result.metrics.cc, result.metrics.l2_variation
    if cc is None or variation is None:
        return []
    level = "good" if cc >= TRUTH_CC[0] else "warning" if cc >= TRUTH_CC[1] else "bad"
    quantity = field_of(result.volumes) or INDEX
    name = "n" if quantity == INDEX else name_of(quantity)
    return [Statement(level, f"Against the truth: CC {cc:.4f}, error {variation:.1%} of the variation of {name}.")]


def _of_gas(result: Result) -> list[Statement]:
    medium = stored_medium(result.settings)
    if (field := result.field) is None or medium is None or field.n_ambient is None:
        return []
    return [
        Statement("warning" if line.startswith("density") else "note", f"{line[0].upper()}{line[1:]}.")
        for line in medium.remarks(field)
    ]


def _of_bootstrap(result: Result) -> list[Statement]:
    uncertainty = result.metrics.uncertainty
    diverged = uncertainty["diverged_trials"] if uncertainty else []
    names = ", ".join(map(str, diverged))
    text = f"Bootstrap trials {names} diverged and are excluded from the standard deviations."
    return [Statement("warning", text)] if diverged else []


def _of_rig(result: Result) -> list[Statement]:
    table = result.metrics.rig
    if not table:
        return []
    first, *lines = refinement_lines(table)
    remarks = [Statement("note", f"Camera refinement: {first}.")]
    return remarks + [Statement("warning", f"{line[0].upper()}{line[1:]}.") for line in lines]


def _of_axis(result: Result) -> list[Statement]:
    """The axis of a symmetric flow, and the halves of its images."""
    axis = result.metrics.axis
    lines = [line[0].upper() + line[1:] for line in Axis.of_record(axis).sentences] if axis else []
    lines += [f"View {asymmetry_sentence(row)}" for row in result.metrics.asymmetry]
    return [Statement("note", f"{line}.") for line in lines]


def _of_masks(result: Result) -> list[Statement]:
    remarks = []
    for quantity in plotted_quantities(result.volumes):
        volume = result.volumes[quantity]
        count = int(volume.notes.get("masked_voxels", 0))
        if not count:
            continue
        share = count / volume.values.numel()
        voxels = "voxel" if count == 1 else "voxels"
        where = volume.notes.get("masked_where")
        text = f"{name_of(quantity).capitalize()} is masked in {count} {voxels} ({percent(share, 2)}): {where}."
        remarks.append(Statement("note" if share < 0.05 else "warning", text))
    return remarks
