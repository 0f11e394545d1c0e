"""The verdict follows from quantities that every measurement has, without the truth."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nerif.analysis.verdict import C_NOISE, N0_PIXELS, ONE_CAMERA, RATINGS, Estimate, Verdict, verdict
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.report.summary import headline
from nerif.results.directory import Gap, Result, ResultDirectory
from nerif.results.metrics_file import Metrics
from nerif.simulation.simulate import simulate
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

WHITE = {"grain": 1.0, "white": True, "cause": "", "share": 0.0, "row": 4.0, "column": 4.0, "correlated": 0.0}
CORRELATED = {"grain": 3.0, "white": False, "correlated": 0.36}
NOISE = {"rms_measured": 1.0, "rms_white": 0.02, "rms_sigma": 0.02, "pixels": 1000}


def view(name: str, rms: float = 0.05, withheld: bool = False, **test: Any) -> dict[str, Any]:
    """A view with a signal of 1 px rms."""
    row = {"name": name, "withheld": withheld, "rms": rms, "rms_predicted": 1.0, "residual_test": {**WHITE, **test}}
    return {**row, "measured": "displacement", "unit": "px"}


def noisy(name: str, rms: float, withheld: bool = False, **more: Any) -> dict[str, Any]:
    """A view with a signal of 1 px rms and a noise of 0.02 px."""
    return {**view(name, rms, withheld), **NOISE, **more}


def views_of(rms: float, names: str = "abcdef", **more: Any) -> list[dict[str, Any]]:
    return [noisy(name, rms, **more) for name in names]


def first_run(withheld: float, fitted: float = 0.03) -> dict[str, Any]:
    return {"views": [noisy("a", withheld, True)], "fitted_views": [noisy("b", fitted)], "seconds": 1.0}


def judged(settings: dict[str, Any] | None = None, **metrics: Any) -> Verdict:
    settings = {"method": "nerif", **(settings or {})}
    return verdict(Result(Path(), settings=settings, metrics=Metrics(**{"outcome": "steps", **metrics})))


VIEWS = [view(name) for name in "abcdef"]
FIRST = {"views": [view("a", 0.2, True)], "fitted_views": [view("b", 0.2)], "seconds": 1.0}
BLURRED = [view(name, 0.06, **CORRELATED, cause="blur") for name in "abcd"]


@pytest.mark.parametrize(
    ("metrics", "word"),
    [
        ({"views": VIEWS, "cross_validation": FIRST}, "use"),
        ({"views": VIEWS}, "cannot tell"),
        ({}, "cannot tell"),
        ({"views": [*VIEWS, view("g", 0.09, True)]}, "use"),
        ({"views": [*VIEWS, view("g", 0.2, True)]}, "use with care"),
        ({"views": [*VIEWS, view("g", 0.6, True)]}, "do not use"),
        ({"views": VIEWS, "cross_validation": {**FIRST, "views": [view("a", 0.8, True)]}}, "use with care"),
        ({"views": [*VIEWS[1:], view("a", 0.09)], "cross_validation": FIRST}, "use with care"),  # uneven
        ({"views": [*VIEWS[1:], view("a", 0.06, **CORRELATED)], "cross_validation": FIRST}, "do not use"),
        ({"views": [*VIEWS[1:], view("a", 0.02, **CORRELATED)], "cross_validation": FIRST}, "use with care"),
        ({"views": [view(n, 0.06, **CORRELATED) for n in "abcdef"], "cross_validation": FIRST}, "use"),  # windows
        ({"views": BLURRED, "cross_validation": FIRST}, "use with care"),
        ({"views": VIEWS, "cross_validation": FIRST, "outcome": "interrupted"}, "use with care"),
        ({"views": VIEWS, "cross_validation": FIRST, "outcome": "diverged"}, "do not use"),
        # less than half of the data explained
        ({"views": views_of(0.8)}, "do not use"),
        ({"views": views_of(0.8), "cross_validation": first_run(0.1)}, "do not use"),
        ({"views": [*views_of(0.02), noisy("g", 0.8, True)]}, "do not use"),
        ({"views": views_of(0.8, rms_white=0.79, rms_sigma=0.79)}, "cannot tell"),  # most of the residual is noise
        # early interruption: the residual of fitted views is no noise yet
        ({"views": [*views_of(0.45, "bcdef"), noisy("a", 0.5, True)], "outcome": "interrupted"}, "do not use"),
    ],
)
def test_words(metrics, word):
    values = judged(**metrics)
    assert values.rating == word
    assert word in RATINGS
    assert values.sentence.lower().startswith(word)


def test_misfit_and_noise_count_as_error():
    fine = judged(views=views_of(0.02), cross_validation=first_run(0.2))
    coarse = judged(views=views_of(0.2), cross_validation=first_run(0.2, 0.2))
    assert fine.error < 0.03
    assert coarse.low < coarse.error < coarse.high
    assert coarse.error > 0.08
    at_noise = judged(views=views_of(0.02), cross_validation=first_run(0.02, 0.02))
    louder = judged(views=views_of(0.2, rms_white=0.2, rms_sigma=0.2), cross_validation=first_run(0.2, 0.2))
    assert 0.002 < at_noise.error < louder.error


def test_the_misfit_of_a_first_run_scatters_as_that_of_its_one_view():
    """Six times the pixels would scatter by the root of six less; the misfit of the main run is at the noise."""
    first = first_run(0.07, 0.03)
    six_times = {**first, "fitted_views": [noisy("b", 0.03, pixels=6000)]}
    errors = [judged(views=views_of(0.02), cross_validation=run).error for run in (first, six_times)]
    noise = (C_NOISE * 0.02) ** 2 * N0_PIXELS / 6000
    assert (errors[0] ** 2 - noise) / (errors[1] ** 2 - noise) == pytest.approx(6**0.5, rel=0.05)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_sigma_changes_little(factor):
    right = judged(views=views_of(0.03), cross_validation=first_run(0.2)).error
    wrong = judged(views=views_of(0.03, rms_sigma=0.02 * factor), cross_validation=first_run(0.2)).error
    assert wrong == pytest.approx(right, rel=0.15)


def test_images_are_judged_instead_of_displacements_derived_from_them():
    images = [{**v, "measured": "flow", "unit": "1"} for v in views_of(0.02)]
    first = {**first_run(0.1), "views": [{**noisy("a", 0.1, True), "measured": "flow"}]}
    assert judged(views=[*images, *views_of(0.3)], cross_validation=first).error < 0.02


def test_images_that_were_not_fitted_are_not_judged():
    images = [{**v, "measured": "flow", "unit": "1"} for v in views_of(0.8)]
    first = first_run(0.1)
    both = {**first, "views": [*first["views"], {**noisy("a", 0.9, True), "measured": "flow"}]}
    settings = {"method": "nerif", "from": "displacements"}
    metrics = Metrics(outcome="steps", views=[*images, *views_of(0.02)], cross_validation=both)
    assert verdict(Result(Path(), settings=settings, metrics=metrics)).sentence == (
        judged(views=views_of(0.02), cross_validation=first).sentence
    )


REFINED = {"refine": ["cameras,shift"], "aperture": "auto", "withhold": ["auto"], "uncertainty": "fast"}
LEARNING = [noisy(n, 0.04, **{"residual_test": {**WHITE, **CORRELATED, "cause": "calibration"}}) for n in "abcd"]
UNLEARNED = [*LEARNING, noisy("e", 0.04), noisy("f", 0.07, **{"residual_test": LEARNING[0]["residual_test"]})]


def with_cause(cause: str) -> list[dict[str, Any]]:
    return [{**v, "residual_test": {**v["residual_test"], "cause": cause}} for v in LEARNING]


@pytest.mark.parametrize(
    ("cause", "option"),
    [("calibration", "--refine cameras"), ("offset", "--refine shift"), ("blur", "--aperture auto")],
)
@pytest.mark.parametrize("outcome", ["time_limit", "converged"])
def test_advice_leaves_out_what_the_run_has_in_use(cause, option, outcome):
    views = with_cause(cause)
    plain, using = (
        judged(settings, views=views, cross_validation=first_run(0.05), outcome=outcome) for settings in ({}, REFINED)
    )
    assert option in plain.reasons
    assert option not in using.reasons.replace(f"as {option} is in use", "")
    assert ("detail not yet learned (a longer --time-limit" in using.reasons) == (outcome == "time_limit")
    assert plain.error == using.error is not None


def test_detail_not_yet_learned_is_no_wrong_pose_of_a_refined_rig():
    metrics = {"views": UNLEARNED, "cross_validation": first_run(0.05), "outcome": "time_limit"}
    assert judged(**metrics).rating == "do not use"
    values = judged(REFINED, **metrics)
    assert (values.rating, values.error) == ("use with care", pytest.approx(0.03, rel=0.3))
    assert "f: 2.5% of the signal" in values.reasons
    assert "wrong camera pose" not in values.reasons
    far = [{**v, "rms": 0.4, "rms_white": 0.02} if v["name"] == "f" else v for v in UNLEARNED]
    assert judged(REFINED, **{**metrics, "views": far}).rating == "do not use"  # more than the estimate accounts for


@pytest.mark.parametrize(
    ("settings", "names", "advised"),
    [({}, "abcd", ("--withhold auto", "--uncertainty fast")), (REFINED, "abcd", ()),
     ({}, "abc", ("--uncertainty fast",)), ({"withhold": ["auto"]}, "abcd", ("--uncertainty fast",))],
)  # fmt: skip
def test_advice_where_nothing_gives_an_estimate(settings, names, advised):
    reasons = judged(settings, views=views_of(0.02, names)).reasons
    assert [option for option in ("--withhold auto", "--uncertainty fast") if option in reasons] == list(advised)


@pytest.mark.parametrize("settings", [{}, {"symmetry": "axis"}, {"symmetry": "planar"}])
@pytest.mark.parametrize("names", ["a", "abcde"])
def test_a_field_that_explains_little_names_the_next_command(settings, names):
    reasons = judged(settings, views=views_of(0.9, names)).reasons
    assert ("--symmetry axis" in reasons) == (names == "a" and not settings)
    assert ("nerif check" in reasons) == (names != "a")


@pytest.mark.parametrize("outcome", ["steps", "time_limit", "converged"])
@pytest.mark.parametrize("cause", ["blur", "scale", ""])
@pytest.mark.parametrize("ratio", [1.2, 2.0])
def test_residuals_near_the_noise_before_convergence_need_more_steps(outcome, cause, ratio):
    test = {**WHITE, **CORRELATED, "cause": cause}
    views = [noisy(n, 0.02 * ratio, residual_test=test if n == "a" or cause else WHITE) for n in "abcdef"]
    reasons = judged(views=views, cross_validation=first_run(0.05), outcome=outcome).reasons
    assert "spatially correlated" in reasons
    only = outcome != "converged" and ratio < 1.5
    assert ("not yet learned" in reasons) == (outcome != "converged")
    assert any(word in reasons for word in ("sharpness", "wrong scale", "nerif check")) != only


@pytest.mark.parametrize(("names", "symmetry"), [("a", "axis"), ("abcde", "")])
@pytest.mark.parametrize("rms", [0.02, 0.6, 0.9])
def test_a_flow_wider_than_the_images_is_the_cause(names, symmetry, rms):
    views = views_of(rms, names, residual_test={**WHITE, **CORRELATED, "cause": "scale"})
    views[-1] |= {"cut_edge": "left", "cut_signal": 0.8}
    result = judged({"symmetry": symmetry}, views=views, cross_validation=first_run(0.1))
    assert result.rating == ("cannot tell" if rms < 0.1 else "do not use")
    assert "displacement does not fall to zero at the edge of the view" in result.reasons
    assert "--open-faces" in result.reasons
    assert "--known" in result.reasons
    assert "wrong scale" not in result.reasons


AXIS = {"kind": "axis", "harmonics": 0}
HALVES = {"name": "a", "antisymmetry": 0.5, "cc": {"u": 0.4, "v": 0.6}}
BOTH = [*VIEWS[:2], *({**v, "measured": "flow"} for v in VIEWS[:2])]
LIMITED = {"views": VIEWS, "cross_validation": FIRST, "outcome": "time_limit", "seconds": 6.0}
TRIALS = {"kind": "full", "source": "bootstrap", "trials": 8, "diverged_trials": [], "seconds": 1.0}


def one_camera(*names: str) -> dict[str, Any]:
    measured = ["displacement", "absorption"]
    views = [{**noisy(n, 0.02), "measured": m} for n, m in zip(names, measured, strict=False)]
    return {"views": views, "cross_validation": first_run(0.1), "axis": {"symmetry": AXIS}}


def with_axis(views: list[dict[str, Any]] = VIEWS, **more: Any) -> dict[str, Any]:
    """Views of a flow that was reconstructed as symmetric."""
    return {"views": views, "cross_validation": FIRST, "axis": {"symmetry": {**AXIS, **more}}}


@pytest.mark.parametrize(
    ("settings", "metrics", "rating", "words"),
    [
        # a cross-validation run that was too short, or does not predict its view, gives no estimate
        ({}, {"views": views_of(0.02), "cross_validation": first_run(0.98, 0.97)}, "cannot tell", "too short"),
        ({}, {"views": views_of(0.6), "cross_validation": first_run(0.6, 0.6)}, "do not use", "estimated by"),
        ({}, {"views": views_of(0.02), "cross_validation": first_run(0.64, 0.6)}, "cannot tell",
         "more --max-steps makes it longer"),  # CC 0.77
        ({}, {"views": views_of(0.02), "cross_validation": first_run(0.3, 0.6)}, "use", "estimated by"),  # CC 0.95
        # a fit that the time limit cut short
        ({"time_limit": 60.0}, LIMITED, "use with care", "6 s of the time limit of 60 s"),
        ({"time_limit": 60.0}, {**LIMITED, "seconds": 40.0}, "use", "40 s of the time limit of 60 s"),
        ({"time_limit": 60.0}, {**LIMITED, "outcome": "converged"}, "use", "no view contradicts"),
        ({"time_limit": 60.0}, {**LIMITED, "uncertainty": TRIALS}, "use", "6 s of the time limit of 60 s"),
        # one camera is checked by no other; cameras are counted once for all techniques
        ({}, one_camera("cam"), "use with care", ONE_CAMERA),
        ({}, one_camera("cam", "cam"), "use with care", ONE_CAMERA),
        ({}, one_camera("cam left", "cam right"), "use with care", ONE_CAMERA),
        ({}, {"views": BOTH, "cross_validation": FIRST}, "use with care", "2 views leave"),
        ({}, with_axis(BOTH, harmonics=1), "use with care", "2 views leave"),
        ({}, with_axis(BOTH), "use", "no view contradicts"),
        ({}, with_axis(BOTH, kind="planar"), "use", "no view contradicts"),
        # halves of images may differ where the flow may
        ({}, {**with_axis(), "asymmetry": [HALVES]}, "do not use", "not axisymmetric"),
        ({}, {**with_axis(harmonics=2), "asymmetry": [HALVES]}, "use", "no view contradicts"),
        ({}, {**with_axis([*VIEWS[1:], view("a", 0.06, **CORRELATED)]), "asymmetry": [{**HALVES, "antisymmetry": 0.3}]},
         "do not use", "only roughly axisymmetric: the halves of a correlate by 0.40, and 30% of the signal is "
         "antisymmetric; the residual of view a is spatially correlated"),
        ({}, {"views": VIEWS, "axis": {"symmetry": AXIS, "better_direction": [1.0, 0.0, 0.0]}}, "do not use",
         "--axis-direction 1 0 0"),
        # a field that is smooth by its method is named before the measurement
        ({"method": "tv"}, {"views": with_cause("blur"), "cross_validation": first_run(0.05), "outcome": "converged"},
         "use with care", "as with smoothing by tv, or "),
        ({}, {"views": with_cause("scale"), "cross_validation": first_run(0.05), "outcome": "converged"},
         "use with care", "as with a wrong scale"),
    ],
)  # fmt: skip
def test_reasons(settings, metrics, rating, words):
    entry = judged(settings, **metrics)
    assert entry.rating == rating
    assert words in entry.reasons
    assert (entry.error is None) == (rating == "cannot tell" or "axis" in words)
    assert ("of the time limit" in entry.reasons) == ("of the time limit" in words)


def test_truth_and_stated_sigma_do_not_matter():
    values = judged(views=VIEWS, cross_validation=FIRST)
    assert judged(views=VIEWS, cross_validation=FIRST, cc=0.1, l2_variation=3.0) == values
    assert judged(views=[{**v, "rms_over_sigma": 40.0} for v in VIEWS], cross_validation=FIRST) == values


def test_standard_deviations_give_an_estimate():
    grid = Grid(Box.cube(2.0), (4, 5, 6))
    excess, std = torch.full(grid.shape, -1e-4), torch.full(grid.shape, 2e-6)
    excess[0], std[0] = 0.0, 1.0  # outside of the flow
    volumes = {"index_excess": Volume(excess, grid), "index_excess_std": Volume(std, grid, "index_excess_std")}

    def with_deviations(views):
        return verdict(Result(Path(), metrics=Metrics(views=views), volumes=volumes))

    values = with_deviations(VIEWS)
    assert (values.rating, values.error) == ("use", pytest.approx(0.02))
    assert "standard deviations" in values.sentence
    assert with_deviations(VIEWS[:3]).rating == "use with care"  # no deviation shows what three views leave open
    assert with_deviations([*VIEWS, view("g", 0.3, True)]).error > 0.07


def test_two_estimates_are_averaged_where_they_agree():
    views, deviations = Estimate.within(0.04, 2.0, "a"), Estimate.within(0.02, 1.5, "b")
    both = views.mean(deviations)
    assert deviations.error < both.error < (views.error * deviations.error) ** 0.5  # nearer to the narrower one
    assert both.high / both.error < deviations.high / deviations.error
    assert views.mean(Estimate.within(0.01, 1.5, "b")) == views
    assert views.mean(Estimate.within(0.2, 1.5, "b")).error == 0.2


@pytest.mark.parametrize(
    ("metrics", "sentence"),
    [
        ({"views": VIEWS, "cross_validation": FIRST}, "predicting view a, withheld from the cross-validation run;"),
        ({"views": [*VIEWS, view("g", 0.09, True)]}, "estimated by predicting view g, withheld from the run;"),
        ({"views": [*VIEWS, view("g", 0.09, True), view("h", 0.09, True)]}, "2 views, withheld from the run;"),
    ],
)
def test_the_error_is_stated_with_what_it_is_of_and_estimated_from(metrics, sentence):
    values = judged(**metrics).sentence
    assert re.match(r"Use: the field is wrong by about [\d.]+ % of its variation about the ambient \(rms, ", values)
    assert sentence in values


def test_the_headline_of_the_report():
    result = Result(Path(), settings={"method": "nerif"}, metrics=Metrics(views=VIEWS, cross_validation=FIRST))
    assert headline(result).text == verdict(result).sentence
    assert headline(result).level == "good"
    incomplete = Result(Path(), missing=(Gap("metrics.json", "metrics.json is missing"),))
    assert headline(incomplete).text.startswith("Cannot tell: metrics.json")


@pytest.mark.slow
def test_a_mirrored_view_is_detected(tmp_path):
    box = Box.cube(50.0)
    ring = Ring(views=8, arc=(0.0, 157.5), image_size=(32, 32), pixel_pitch=4.0 / 32)
    field = make_phantom("gaussians", box, 3, 0.0)
    good = simulate(field, ring.cameras(0.0), box, 1.00027, 0.02, seed=11, steps=60)
    mirrored = good.displacements.clone()
    mirrored[2] = mirrored[2].flip(1) * torch.tensor([-1.0, 1.0])
    words = []
    for name, displacement in {"good": good.displacement, "mirrored": mirrored}.items():
        measurement, method = replace(good, displacement=displacement), Tikhonov(voxels=24, device="cpu")
        reconstruct_into(tmp_path / name, measurement, method, RunSettings(report=False))
        words.append(ResultDirectory(tmp_path / name).metrics().verdict["rating"])
    assert words[0] in ("use", "use with care")
    assert words[1] == "do not use"
