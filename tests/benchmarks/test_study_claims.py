"""Verdicts follow the records: they flip when values flip, and what is missing is not tested."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.study.claims import WHY, Claim, claims, worse_than_paper
from benchmarks.study.paper import CORRELATION, L2, paper_value
from benchmarks.study.plan import Case
from tests.benchmarks.study_records import Change, resolution, results


def claim(start: str, change: Change = lambda case: {}) -> Claim:
    """The claim whose text starts so."""
    return next(c for c in claims(results(change)) if c.text.startswith(start))


def only(key: str, **changes: Any) -> Change:
    return lambda case: dict(changes) if case.key == key else {}


def nerif(**changes: Any) -> Change:
    return lambda case: dict(changes) if case.method == "NeRIF" else {}


def voxels(**changes: Any) -> Change:
    return lambda case: dict(changes) if case.method in ("Tikhonov", "Landweber") else {}


def on_phantom_2(value: float) -> Change:
    """NeRIF as accurate as the paper, except for Phantom 2's L2."""
    return lambda case: {"l2": value} if case.phantom == "2" and case.method == "NeRIF" else {}


def section(name: str, start: str, **changes: Any) -> Change:
    return lambda case: dict(changes) if case.labels.get(name, "").startswith(start) else {}


def as_the_paper(case: Case) -> dict[str, float]:
    if case.method != "NeRIF" or "tables" not in case.labels:
        return {}
    tables = {"l2": L2, "cc": CORRELATION}
    return {n: paper_value(t, case.phantom, "NeRIF", case.noise) for n, t in tables.items()}  # type: ignore[misc]


CASES = [
    ("CC of NeRIF exceeds", nerif(cc=0.995), only("5-0.15-nerif", cc=0.989)),
    ("L2 of NeRIF is predominantly", only("1-0-nerif", l2=0.02), nerif(l2=0.02)),
    ("NeRIF beats Tikhonov", nerif(l2=0.015), only("3-0-nerif", l2=0.03)),
    ("NeRIF beats Tikhonov", nerif(), only("3-0-nerif", cc=0.5)),
    ("Robust", nerif(), only("6-0.15-nerif", l2=0.021)),
    ("Slices of the voxel", voxels(cc=0.9, ssim=0.8), voxels(cc=0.9, ssim=0.95)),
    ("Slices of the voxel", voxels(cc=0.88, ssim=0.8), voxels(cc=0.99, ssim=0.8)),
    ("Slices of NeRIF", nerif(ssim=0.97), nerif(ssim=0.9)),
    ("NeRIF converges", on_phantom_2(0.002), on_phantom_2(0.02)),
    ("NeRIF needs just over", on_phantom_2(0.002), lambda case: {"l2": 0.02, "seconds": 2000.0}),
    ("The voxel methods need over", voxels(seconds=36000.0), voxels(seconds=3.0)),
    ("NeRIF runs in about", nerif(peak_memory_bytes=10e9), only("4-0-nerif", peak_memory_bytes=30e9)),
    ("The voxel methods need 184", voxels(peak_memory_bytes=184e9), only("4-0-tikhonov", peak_memory_bytes=1e9)),
    (
        "The multi-head",
        section("network", "multi-head, with gradient", l2_variation=0.003),
        section("network", "multi-head, with gradient", l2_variation=0.02),
    ),
    (
        "Positional",
        section("encoding", "no encoding", l2_variation=0.05),
        section("encoding", "no encoding", l2_variation=0.001),
    ),
    (
        "Too many octaves",
        section("encoding", "N = 7", l2_variation=0.05, loss=0.01),
        section("encoding", "N = 7", l2_variation=0.05, loss=0.5),
    ),
    ("Too many octaves", section("encoding", "N = 7", l2_variation=0.05), section("encoding", "N = 7", l2_variation=0)),
    (
        "Random sampling",
        section("sampling", "random", l2_variation=0.004),
        section("sampling", "random", l2_variation=0.04),
    ),
    ("The spatial resolution", only("octahedron-nerif", resolution=resolution(62.0)), nerif()),
    ("Goal of nerif", as_the_paper, only("2-0.1-nerif", l2=0.0043)),
    ("Not in the paper: NeRIF beats total", nerif(), only("1-0-tv", l2=0.001)),
]


@pytest.mark.parametrize(("start", "good", "bad"), CASES, ids=[f"{i}-{c[0]}" for i, c in enumerate(CASES)])
def test_verdicts_flip_when_values_flip(start, good, bad):
    assert claim(start, good).verdict == "reproduced", claim(start, good)
    assert claim(start, bad).verdict == "not reproduced", claim(start, bad)


def test_every_claim_is_covered():
    assert {c.text for c in claims(results())} == {claim(start).text for start, _, _ in CASES} | {
        claim("Not in the paper: NeRIF beats Tikhonov").text
    }


@pytest.mark.parametrize("change", [lambda case: None, lambda case: {"failed": "RuntimeError: out of memory"}])
def test_without_records_nothing_is_tested(change):
    verdicts = claims(results(change))
    assert {c.verdict for c in verdicts} == {"not tested"}
    assert all(c.here for c in verdicts)


def test_reasons_are_stated():
    failed = only("3-0.1-nerif", failed="RuntimeError: out of memory")
    assert claim("CC of NeRIF", failed).here == "3-0.1-nerif failed: RuntimeError: out of memory"
    waiting = claim("CC of NeRIF", lambda case: None if case.phantom == "7" else {})
    assert waiting.verdict == "not tested"
    assert waiting.here == "18 of 21 reconstructions done"
    diverged = claim("CC of NeRIF", only("3-0.1-nerif", cc=float("nan"), outcome="diverged"))
    assert diverged.here == "cc of 3-0.1-nerif is not a number (the run ended with: diverged)"


def test_a_section_left_out_is_the_reason():
    whole = results()
    some = tuple(pair for pair in whole.pairs if "network" in pair[0].labels)
    verdicts = claims(type(whole)(some, ("network",)))
    assert next(c for c in verdicts if c.text.startswith("The multi-head")).verdict != "not tested"
    assert next(c for c in verdicts if c.text.startswith("CC of")).here.endswith("was left out")


def test_a_run_too_short_for_fifty_epochs_is_not_tested():
    short = claim("NeRIF converges", lambda case: {"l2": 0.02, "epochs": 20.0} if case.method == "NeRIF" else {})
    assert short.verdict == "not tested"
    assert "too short" in short.here


def test_cells_less_accurate_than_the_paper_are_listed():
    verdicts = claim(
        "Goal of nerif", lambda case: as_the_paper(case) | ({"l2": 0.0043} if case.key == "2-0.1-nerif" else {})
    )
    assert verdicts.here == "L2 in 20 of 21 cells, not Phantom 2 (noise 0.1); CC in 21 of 21 cells" + WHY


def test_comparison_is_at_the_digits_of_the_paper():
    assert not worse_than_paper("cc", 0.99966, 0.9997)
    assert worse_than_paper("cc", 0.99964, 0.9997)
    assert not worse_than_paper("l2", 0.005854, 0.00585)
    assert worse_than_paper("l2", 0.005856, 0.00585)


def test_resolution_finer_than_the_profiles_resolve_is_judged_by_their_limit():
    fine = claim("The spatial resolution", only("octahedron-nerif", resolution=resolution(None)))
    assert fine.verdict == "reproduced"
    assert fine.here.startswith("finer than 128 lp/unit; the pixels sample 25.00 lp/unit")
    assert (
        claim("The spatial resolution", only("octahedron-nerif", resolution=resolution(0.0))).verdict
        == "not reproduced"
    )
