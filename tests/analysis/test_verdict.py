"""The verdict follows from figures that any measurement has, and from no truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nerif.analysis.verdict import ONE_CAMERA, WORDS, Estimate, verdict
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.report.summary import headline
from nerif.results.directory import Missing, Result, ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.workflow.job import Run
from nerif.workflow.pipeline import reconstruct_into

WHITE = {"grain": 1.0, "white": True, "cause": "", "share": 0.0, "row": 4.0, "column": 4.0, "alike": 0.0}


def view(name: str, rms: float = 0.05, withheld: bool = False, **left: Any) -> dict[str, Any]:
    """Scores of a view that shows 1 px rms."""
    kind = {"measured": "displacement", "unit": "px"}
    return {"name": name, "withheld": withheld, "rms": rms, "rms_predicted": 1.0, "leftover": {**WHITE, **left}, **kind}


SMEARED = [view(name, 0.06, grain=3.0, white=False, alike=0.36, cause="blur") for name in "abcd"]
SEEN = [view(name) for name in "abcdef"]
FIRST = {"views": [view("a", 0.2, True)], "fitted_views": [view("b", 0.2)], "seconds": 1.0}
ALIKE = {"grain": 3.0, "white": False, "alike": 0.36}


def judged(**metrics: Any) -> Any:
    return verdict(Result(Path(), settings={"method": "nerif"}, metrics={"outcome": "steps", **metrics}))


@pytest.mark.parametrize(
    ("metrics", "word"),
    [
        ({"views": SEEN, "cross_validation": FIRST}, "use"),
        ({"views": SEEN}, "cannot tell"),
        ({}, "cannot tell"),
        ({"views": [*SEEN, view("g", 0.09, True)]}, "use"),
        ({"views": [*SEEN, view("g", 0.2, True)]}, "use with care"),
        ({"views": [*SEEN, view("g", 0.6, True)]}, "do not use"),
        ({"views": SEEN, "cross_validation": {**FIRST, "views": [view("a", 0.8, True)]}}, "use with care"),
        ({"views": SEEN, "cross_validation": {"views": [view("a", 0.2, True)]}}, "use with care"),  # older
        ({"views": [*SEEN[1:], view("a", 0.09)], "cross_validation": FIRST}, "use with care"),  # far worse
        ({"views": [*SEEN[1:], view("a", 0.06, **ALIKE)], "cross_validation": FIRST}, "do not use"),
        ({"views": [*SEEN[1:], view("a", 0.02, **ALIKE)], "cross_validation": FIRST}, "use with care"),
        ({"views": [view(n, 0.06, **ALIKE) for n in "abcdef"], "cross_validation": FIRST}, "use"),  # windows
        ({"views": SMEARED, "cross_validation": FIRST}, "use with care"),
        ({"views": SEEN, "cross_validation": FIRST, "outcome": "interrupted"}, "use with care"),
        ({"views": SEEN, "cross_validation": FIRST, "outcome": "diverged"}, "do not use"),
        ({"views": [{"name": "a", "withheld": False, "rms": 0.1, "measured": "displacement"}]}, "cannot tell"),  # older
    ],
)  # fmt: skip
def test_words(metrics, word):
    found = judged(**metrics)
    assert found.word == word
    assert word in WORDS
    assert found.sentence.lower().startswith(word)


KNOWN = {"rms_measured": 1.0, "rms_white": 0.02, "rms_sigma": 0.02, "pixels": 1000}


def known(name: str, rms: float, withheld: bool = False, **more: Any) -> dict[str, Any]:
    """Scores of a view with a signal of 1 px rms and a noise of 0.02 px."""
    return {**view(name, rms, withheld), **KNOWN, **more}


def first_run(withheld: float, fitted: float = 0.03) -> dict[str, Any]:
    return {"views": [known("a", withheld, True)], "fitted_views": [known("b", fitted)], "seconds": 1.0}


def views_of(rms: float, names: str = "abcdef", **more: Any) -> list[dict[str, Any]]:
    return [known(name, rms, **more) for name in names]


def test_a_field_that_explains_less_than_half_of_the_data_is_not_to_be_used():
    assert judged(views=views_of(0.8)).word == "do not use"
    assert judged(views=views_of(0.8), cross_validation=first_run(0.1)).word == "do not use"
    assert judged(views=[*views_of(0.02), known("g", 0.8, True)]).word == "do not use"
    assert judged(views=views_of(0.6), cross_validation=first_run(0.6, 0.6)).word != "cannot tell"
    noisy = {"rms_white": 0.79, "rms_sigma": 0.79}  # most of the residual is noise
    assert judged(views=views_of(0.8, **noisy)).word == "cannot tell"


def test_a_first_run_that_did_not_train_tells_nothing():
    found = judged(views=views_of(0.02), cross_validation=first_run(0.98, 0.97))
    assert (found.word, found.error) == ("cannot tell", None)
    assert "too short" in found.why


def test_a_misfit_of_all_views_counts_as_error():
    """Views that fit no better than the withheld one are no sign of a small error."""
    fine = judged(views=views_of(0.02), cross_validation=first_run(0.2))
    coarse = judged(views=views_of(0.2), cross_validation=first_run(0.2, 0.2))
    assert fine.error < 0.03
    assert coarse.error > 0.08
    assert coarse.low < coarse.error < coarse.high


def test_a_withheld_view_at_the_noise_hides_an_error():
    found = judged(views=views_of(0.02), cross_validation=first_run(0.02, 0.02))
    louder = {"rms_white": 0.2, "rms_sigma": 0.2}
    noisy = judged(views=views_of(0.2, **louder), cross_validation=first_run(0.2, 0.2))
    assert 0.002 < found.error < noisy.error


def test_an_early_interruption_is_no_small_error():
    """The residual of fitted views is no noise yet, and is not taken off that of the withheld one."""
    views = [*views_of(0.45, "bcdef"), known("a", 0.5, True)]
    found = judged(views=views, outcome="interrupted")
    assert found.error > 0.2
    assert found.word == "do not use"


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_sigma_changes_little(factor):
    right = judged(views=views_of(0.03), cross_validation=first_run(0.2)).error
    wrong = judged(views=views_of(0.03, rms_sigma=0.02 * factor), cross_validation=first_run(0.2)).error
    assert wrong == pytest.approx(right, rel=0.15)


def test_images_are_judged_and_not_the_displacements_from_their_windows():
    blurred = [{**v, "rms": 0.3} for v in views_of(0.3)]
    images = [{**v, "measured": "flow", "unit": "1"} for v in views_of(0.02)]
    first = {**first_run(0.1), "views": [{**known("a", 0.1, True), "measured": "flow"}]}
    assert judged(views=[*images, *blurred], cross_validation=first).error < 0.02


@pytest.mark.parametrize("names", [["cam"], ["cam", "cam"], ["cam left", "cam right"]])
def test_one_camera_is_checked_by_no_other(names):
    measured = ["displacement", "absorption"]
    views = [{**known(n, 0.02), "measured": m} for n, m in zip(names, measured, strict=False)]
    found = judged(views=views, cross_validation=first_run(0.1), axis={"symmetry": ABOUT})
    assert found.word == "use with care"
    assert ONE_CAMERA in found.why


UNLIKE = [{"name": "a", "departure": 0.5, "cc": {"u": 0.4, "v": 0.6}}]
ABOUT = {"kind": "axis", "harmonics": 0}


@pytest.mark.parametrize(
    ("symmetry", "word"),
    [(ABOUT, "do not use"), ({**ABOUT, "harmonics": 2}, "use")],
)
def test_halves_may_differ_where_the_flow_may(symmetry, word):
    metrics = {"views": SEEN, "cross_validation": FIRST, "axis": {"symmetry": symmetry}, "asymmetry": UNLIKE}
    assert judged(**metrics).word == word


def test_a_view_that_the_others_contradict_is_not_excused_by_unlike_halves():
    roughly = [{**UNLIKE[0], "departure": 0.3}]
    views = [*SEEN[1:], view("a", 0.06, **ALIKE)]
    found = judged(views=views, cross_validation=FIRST, axis={"symmetry": ABOUT}, asymmetry=roughly)
    assert found.word == "do not use"
    assert "only roughly axisymmetric" in found.why
    assert "spatially correlated" in found.why


@pytest.mark.parametrize(
    ("symmetry", "words"),
    [(None, "2 views leave"), ({**ABOUT, "harmonics": 1}, "2 views leave"),
     (ABOUT, "no view contradicts"), ({**ABOUT, "kind": "planar"}, "no view contradicts")],
)  # fmt: skip
def test_few_cameras_are_few_whatever_they_measured_by(symmetry, words):
    images = [{**v, "measured": "flow"} for v in SEEN[:2]]
    found = judged(views=[*SEEN[:2], *images], cross_validation=FIRST, axis={"symmetry": symmetry})
    assert words in found.why


def test_the_truth_is_not_looked_at():
    known = {"views": SEEN, "cross_validation": FIRST}
    assert judged(**known, cc=0.1, l2_variation=3.0) == judged(**known)


def test_what_sigma_is_stated_does_not_matter():
    wrong = [{**v, "rms_over_sigma": 40.0} for v in SEEN]
    assert judged(views=wrong, cross_validation=FIRST) == judged(views=SEEN, cross_validation=FIRST)


def test_standard_deviations_tell_the_error():
    grid = Grid(Box.cube(2.0), (4, 5, 6))
    excess = torch.full(grid.shape, -1e-4)
    excess[0] = 0.0
    std = torch.full(grid.shape, 2e-6)
    std[0] = 1.0  # outside of the flow
    volumes = {"index_excess": Volume(excess, grid), "index_excess_std": Volume(std, grid, "index_excess_std")}
    found = verdict(Result(Path(), metrics={"views": SEEN}, volumes=volumes))
    assert found.error == pytest.approx(0.02)
    assert found.word == "use"
    assert "standard deviations" in found.sentence
    three = verdict(Result(Path(), metrics={"views": SEEN[:3]}, volumes=volumes))
    assert three.word == "use with care"  # what three views do not show is in no deviation
    worse = {"views": [*SEEN, view("g", 0.3, True)]}
    assert verdict(Result(Path(), metrics=worse, volumes=volumes)).error > 0.07


def test_two_estimates_are_averaged_where_they_agree():
    views, deviations = Estimate.within(0.04, 2.0, "a"), Estimate.within(0.02, 1.5, "b")
    both = views.combined(deviations)
    assert deviations.error < both.error < (views.error * deviations.error) ** 0.5  # nearer to the closer one
    assert both.high / both.error < deviations.high / deviations.error
    assert views.combined(Estimate.within(0.01, 1.5, "b")) == views
    assert views.combined(Estimate.within(0.2, 1.5, "b")).error == 0.2


def test_the_first_screen_has_it():
    result = Result(Path(), settings={"method": "nerif"}, metrics={"views": SEEN, "cross_validation": FIRST})
    assert headline(result).text == verdict(result).sentence
    assert headline(result).level == "good"
    gone = Result(Path(), metrics={}, missing=(Missing("metrics.json", "metrics.json is not there"),))
    assert headline(gone).text.startswith("Cannot tell: metrics.json")


@pytest.mark.slow
def test_a_mirrored_view_is_not_to_be_used(tmp_path):
    """And where nothing is wrong the same rig does not condemn."""
    box = Box.cube(50.0)
    ring = Ring(views=8, arc=(0.0, 157.5), image_size=(32, 32), pixel_pitch=4.0 / 32)
    field = make_phantom("gaussians", box, 3, 0.0)
    good = simulate(field, ring.cameras(0.0), box, 1.00027, 0.02, seed=11, steps=60)
    mirrored = good.displacements.clone()
    mirrored[2] = mirrored[2].flip(1) * torch.tensor([-1.0, 1.0])
    words = []
    for name, displacement in {"good": good.displacement, "mirrored": mirrored}.items():
        measurement, method = replace(good, displacement=displacement), Tikhonov(voxels=24, device="cpu")
        reconstruct_into(tmp_path / name, measurement, method, Run(report=False))
        words.append(ResultDirectory(tmp_path / name).metrics()["verdict"]["word"])
    assert words[0] in ("use", "use with care")
    assert words[1] == "do not use"
