"""The verdict follows from figures that any measurement has, and from no truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.tikhonov import Tikhonov
from nerif.report.summary import headline
from nerif.result import Missing, Result, ResultDirectory
from nerif.simulation import simulate
from nerif.verdict import WORDS, verdict
from nerif.volume import Volume
from nerif.workflow import Run, reconstruct_into

WHITE = {"grain": 1.0, "white": True, "cause": "", "share": 0.0, "row": 4.0, "column": 4.0, "alike": 0.0}


def view(name: str, rms: float = 0.05, held_out: bool = False, **left: Any) -> dict[str, Any]:
    """Scores of a view that shows 1 px rms."""
    kind = {"measured": "displacement", "unit": "px"}
    return {"name": name, "held_out": held_out, "rms": rms, "rms_predicted": 1.0, "leftover": {**WHITE, **left}, **kind}


SMEARED = [view(name, 0.06, grain=3.0, white=False, alike=0.36, cause="blur") for name in "abcd"]
SEEN = [view(name) for name in "abcdef"]
FIRST = {"views": [view("a", 0.2, True)], "seconds": 1.0}
ALIKE = {"grain": 3.0, "white": False, "alike": 0.36}


def judged(**metrics: Any) -> Any:
    return verdict(Result(Path(), settings={"method": "nerif"}, metrics={"outcome": "steps", **metrics}))


@pytest.mark.parametrize(
    ("metrics", "word"),
    [
        ({"views": SEEN, "first_look": FIRST}, "use"),
        ({"views": SEEN}, "cannot tell"),
        ({}, "cannot tell"),
        ({"views": [*SEEN, view("g", 0.1, True)]}, "use"),
        ({"views": [*SEEN, view("g", 0.2, True)]}, "use with care"),
        ({"views": [*SEEN, view("g", 0.6, True)]}, "do not use"),
        ({"views": SEEN, "first_look": {"views": [view("a", 0.7, True)]}}, "use with care"),
        ({"views": [*SEEN[1:], view("a", 0.09)], "first_look": FIRST}, "use with care"),  # much worse than the others
        ({"views": [*SEEN[1:], view("a", 0.06, **ALIKE)], "first_look": FIRST}, "do not use"),
        ({"views": [*SEEN[1:], view("a", 0.02, **ALIKE)], "first_look": FIRST}, "use with care"),
        ({"views": [view(n, 0.06, **ALIKE) for n in "abcdef"], "first_look": FIRST}, "use"),  # as windows leave it
        ({"views": SMEARED, "first_look": FIRST}, "use with care"),
        ({"views": SEEN, "first_look": FIRST, "outcome": "interrupted"}, "use with care"),
        ({"views": SEEN, "first_look": FIRST, "outcome": "diverged"}, "do not use"),
        ({"views": SEEN, "ensemble": {"members": 3, "left_out": [view("a", 0.1, True)]}}, "use"),
        ({"views": [{"name": "a", "held_out": False, "rms": 0.1, "measured": "displacement"}]}, "cannot tell"),  # older
    ],
)  # fmt: skip
def test_words(metrics, word):
    found = judged(**metrics)
    assert found.word == word
    assert word in WORDS
    assert found.sentence.lower().startswith(word)


UNLIKE = [{"name": "a", "departure": 0.5, "cc": {"u": 0.4, "v": 0.6}}]
ABOUT = {"kind": "axis", "harmonics": 0}


@pytest.mark.parametrize(
    ("symmetry", "word"),
    [(ABOUT, "do not use"), ({**ABOUT, "harmonics": 2}, "use")],
)
def test_halves_may_differ_where_the_flow_may(symmetry, word):
    metrics = {"views": SEEN, "first_look": FIRST, "axis": {"symmetry": symmetry}, "departures": UNLIKE}
    assert judged(**metrics).word == word


def test_a_view_that_the_others_contradict_is_not_excused_by_unlike_halves():
    roughly = [{**UNLIKE[0], "departure": 0.3}]
    views = [*SEEN[1:], view("a", 0.06, **ALIKE)]
    found = judged(views=views, first_look=FIRST, axis={"symmetry": ABOUT}, departures=roughly)
    assert found.word == "do not use"
    assert "only roughly axisymmetric" in found.why
    assert "no noise" in found.why


@pytest.mark.parametrize(
    ("symmetry", "words"),
    [(None, "2 views leave much open"), ({**ABOUT, "harmonics": 1}, "2 views leave much open"),
     (ABOUT, "no view contradicts"), ({**ABOUT, "kind": "planar"}, "no view contradicts")],
)  # fmt: skip
def test_few_cameras_are_few_whatever_they_measured_by(symmetry, words):
    pictures = [{**v, "measured": "flow"} for v in SEEN[:2]]
    found = judged(views=[*SEEN[:2], *pictures], first_look=FIRST, axis={"symmetry": symmetry})
    assert words in found.why


def test_the_truth_is_not_looked_at():
    known = {"views": SEEN, "first_look": FIRST}
    assert judged(**known, cc=0.1, l2_variation=3.0) == judged(**known)


def test_what_sigma_is_stated_does_not_matter():
    wrong = [{**v, "rms_over_sigma": 40.0} for v in SEEN]
    assert judged(views=wrong, first_look=FIRST) == judged(views=SEEN, first_look=FIRST)


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
    assert verdict(Result(Path(), metrics=worse, volumes=volumes)).error == pytest.approx(0.3 * 0.3, rel=0.05)


def test_the_first_screen_has_it():
    result = Result(Path(), settings={"method": "nerif"}, metrics={"views": SEEN, "first_look": FIRST})
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
