"""Claims of the paper with its numbers, ours, and a verdict computed from the records alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from statistics import median
from typing import Literal

from benchmarks.study.claims_of_method import CLAIMS_OF_METHOD, Question
from benchmarks.study.paper import CORRELATION, L2, paper_value
from benchmarks.study.plan import NOISES, PHANTOMS
from benchmarks.study.results import NoResult, Record, Results, finite, score
from benchmarks.study.words import cc, listed, share

Verdict = Literal["reproduced", "not reproduced", "not tested"]

VOXEL_METHODS = ("Tikhonov", "Landweber")  # the paper's
DIGITS = {"cc": 4, "l2": 5}
"""Digits of the paper's tables after the point, to which values are rounded before a comparison."""

WHY = "; why: see √(1 − CC²) below the tables, which no ambient flatters"
AROUND, NEAR_1 = (0.85, 0.95), 0.95  # "around 0.9" and "approaching 1"


@dataclass(frozen=True)
class Claim:
    """A claim, the paper's numbers, ours (or why there are none), and the verdict."""

    text: str
    paper: str
    here: str
    verdict: Verdict


def claims(results: Results) -> list[Claim]:
    """Return every claim with its verdict; one whose records are missing or failed is not tested."""
    return [_judge(question, results) for question in (*ACCURACY, *CLAIMS_OF_METHOD, *OURS)]


def worse_than_paper(name: str, value: float, paper: float) -> bool:
    """Whether a metric ("cc" or "l2") is worse than the paper's, at the digits that the paper prints."""
    rounded = round(value, DIGITS[name])
    return rounded < paper if name == "cc" else rounded > paper


def _judge(question: Question, results: Results) -> Claim:
    try:
        here, holds = question.answer(results)
    except NoResult as reason:
        return Claim(question.text, question.paper, f"{reason}", "not tested")
    verdict: Verdict = "not tested" if holds is None else "reproduced" if holds else "not reproduced"
    return Claim(question.text, question.paper, here, verdict)


def _correlation(results: Results) -> tuple[str, bool]:
    scores = {cell: score(record, "cc") for cell, record in results.cells(["NeRIF"]).items()}
    worst = min(scores, key=lambda cell: scores[cell])
    least = f"{cc(scores[worst])} (Phantom {worst[0]}, noise {worst[1]:g})"
    above = sum(value > 0.99 for value in scores.values())
    return f"{least} to {cc(max(scores.values()))}; above 0.99 in {above} of {len(scores)}", above == len(scores)


def _l2(results: Results) -> tuple[str, bool]:
    errors = [score(record, "l2") for record in results.cells(["NeRIF"]).values()]
    below = sum(value < 0.01 for value in errors)
    return f"below 1% in {below} of {len(errors)}; {share(min(errors))} to {share(max(errors))}", below >= L2_BELOW


def _beats(noise: float, rivals: tuple[str, ...]) -> Callable[[Results], tuple[str, bool]]:
    def answer(results: Results) -> tuple[str, bool]:
        records = results.cells(["NeRIF", *rivals], [noise])
        parts, lost = [], False
        for name, sign, words in (("cc", -1, "CC higher"), ("l2", 1, "L2 lower")):
            values = {cell: sign * score(record, name) for cell, record in records.items()}
            bad = [p for p in PHANTOMS if values[p, noise, "NeRIF"] >= min(values[p, noise, m] for m in rivals)]
            lost |= bool(bad)
            but = f" (not on {listed(bad, 7)})" if bad else ""
            parts.append(f"{words} on {len(PHANTOMS) - len(bad)} of {len(PHANTOMS)} phantoms{but}")
        return "; ".join(parts), not lost

    return answer


def _robust(results: Results) -> tuple[str, bool]:
    ours = results.cells(["NeRIF"], [NOISES[-1]])
    theirs = results.cells(VOXEL_METHODS, [0.0])
    ratios = {
        p: min(score(theirs[p, 0.0, m], "l2") for m in VOXEL_METHODS) / score(ours[p, NOISES[-1], "NeRIF"], "l2")
        for p in PHANTOMS
    }
    bad = [p for p, ratio in ratios.items() if ratio <= 1]
    but = f"; not on Phantom {listed(bad, 7)}" if bad else ""
    spread = f"{min(ratios.values()):.2g} to {max(ratios.values()):.2g} times NeRIF's"
    return f"the better voxel method has {spread}{but}", not bad


def _of_slices(records: list[Record], name: str) -> list[float]:
    slices = (s for record in records for s in record["metrics"].get("slices") or [])
    values = [value for value in (finite(s.get(name)) for s in slices) if value is not None]
    if not values:
        raise NoResult(f"no slice has a {name.upper()}")
    return values


def _voxel_slices(results: Results) -> tuple[str, bool]:
    records = list(results.cells(VOXEL_METHODS, [0.0]).values())
    centre, similar = median(_of_slices(records, "cc")), _of_slices(records, "ssim")
    below = sum(value < 0.9 for value in similar) / len(similar)
    text = f"median CC {cc(centre)}; SSIM below 0.9 in {below:.0%} of the slices, median {cc(median(similar))}"
    return text, AROUND[0] <= centre <= AROUND[1] and below > 0.5


def _nerif_slices(results: Results) -> tuple[str, bool]:
    parts, lowest = [], 1.0
    for noise in NOISES:
        records = list(results.cells(["NeRIF"], [noise]).values())
        middles = [median(_of_slices(records, name)) for name in ("cc", "ssim")]
        lowest = min(lowest, *middles)
        parts.append(f"noise {noise:g}: {cc(middles[0])} and {cc(middles[1])}")
    return f"medians of CC and SSIM: {'; '.join(parts)}", lowest >= NEAR_1


def _as_the_paper(results: Results) -> tuple[str, bool]:
    records = results.cells(["NeRIF"])
    parts, lost = [], False
    for name, table in (("l2", L2), ("cc", CORRELATION)):
        bad: dict[str, list[str]] = {}
        for (phantom, noise, method), record in records.items():
            if worse_than_paper(name, score(record, name), _paper(table, phantom, method, noise)):
                bad.setdefault(phantom, []).append(f"{noise:g}")
        count = len(records) - sum(map(len, bad.values()))
        where = [f"Phantom {phantom} (noise {', '.join(noises)})" for phantom, noises in bad.items()]
        parts.append(
            f"{name.upper()} in {count} of {len(records)} cells" + (f", not {listed(where, 7)}" if bad else "")
        )
        lost |= bool(bad)
    return "; ".join(parts) + (WHY if lost else ""), not lost


def _paper(table: dict[str, tuple[float, ...]], phantom: str, method: str, noise: float) -> float:
    value = paper_value(table, phantom, method, noise)
    assert value is not None
    return value


def _paper_of(table: dict[str, tuple[float, ...]], methods: tuple[str, ...]) -> Iterator[float]:
    cells = ((p, m, noise) for p in PHANTOMS for m in methods for noise in NOISES)
    return (value for value in (paper_value(table, *cell) for cell in cells) if value is not None)


NERIF_CC, NERIF_L2 = (tuple(_paper_of(table, ("NeRIF",))) for table in (CORRELATION, L2))
L2_BELOW = sum(value < 0.01 for value in NERIF_L2)
PAPER_RATIOS = [min(L2[p][3:]) / L2[p][2] for p in PHANTOMS]

ACCURACY = (
    Question(
        "CC of NeRIF exceeds 0.99 for all phantoms at all noise levels",
        f"{cc(min(NERIF_CC))} to {cc(max(NERIF_CC))}",
        _correlation,
    ),
    Question(
        "L2 of NeRIF is predominantly below 1% (here: in at least as many cells as in the paper)",
        f"in {L2_BELOW} of {len(NERIF_L2)}; {share(min(NERIF_L2))} to {share(max(NERIF_L2))}",
        _l2,
    ),
    Question(
        "NeRIF beats Tikhonov and Landweber on every phantom, in CC and in L2 (without noise)",
        "on 7 of 7, in both",
        _beats(0.0, VOXEL_METHODS),
    ),
    Question(
        f"Robust: with noise {NOISES[-1]:g}, the L2 of NeRIF stays below that of the voxel methods without noise",
        f"the better voxel method has {min(PAPER_RATIOS):.2g} to {max(PAPER_RATIOS):.2g} times NeRIF's",
        _robust,
    ),
    Question(
        f"Slices of the voxel methods: CC around 0.9 (here: median {AROUND[0]} to {AROUND[1]}), "
        "SSIM generally below 0.9 (here: in more than half)",
        "CC around 0.9, SSIM below 0.9",
        _voxel_slices,
    ),
    Question(
        f"Slices of NeRIF: CC and SSIM approach 1 (here: medians of at least {NEAR_1} at every noise)",
        "approaching 1",
        _nerif_slices,
    ),
)
OURS = (
    Question(
        "Goal of nerif: on every phantom and noise level NeRIF is at least as accurate as in the paper's "
        "tables, in L2 and in CC",
        "the tables",
        _as_the_paper,
    ),
    Question(
        "Not in the paper: NeRIF beats total variation, too, on every phantom, in CC and in L2 (without noise)",
        "–",
        _beats(0.0, ("TV",)),
    ),
    Question(
        "Not in the paper: NeRIF beats Tikhonov, Landweber and total variation at equal noise of 0.1",
        "–",
        _beats(0.1, (*VOXEL_METHODS, "TV")),
    ),
)
