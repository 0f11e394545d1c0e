"""Claims of the paper, its numbers and ours, and a verdict computed from the records alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from statistics import median
from typing import NamedTuple

from benchmarks.study.paper import CORRELATION, L2, MEMORY_GB, MINUTES, NETWORK_LOSS, RESOLUTION, paper_value
from benchmarks.study.plan import NOISES, PHANTOMS
from benchmarks.study.resolution import SAMPLES
from benchmarks.study.results import NoResult, Results, Row, first_at, listed, score, slice_scores

VERDICTS = {True: "✓ reproduced", False: "✗ not reproduced", None: "○ not tested"}
VOXEL_METHODS = ("Tikhonov", "Landweber")  # the paper's
DIGITS = {"cc": 4, "l2": 5}
"""Digits of the paper's tables after the point, to which values are rounded before a comparison."""
EPOCHS, LIMIT = 50, 22  # "approximately 50"; minutes, "just over 20"
MARGIN = 0.05  # relative difference of errors between equal runs
LOWER = 1 / (1 - MARGIN), math.inf
"""Ratio of the other error to one that is lower by more than the margin."""

Values = dict[str, float]


class Claim(NamedTuple):
    """A claim, the paper's numbers, ours with their format and the range that agrees with the claim.

    `needed` is the number of values that have to agree (0: all).
    """

    text: str
    paper: str
    values: Callable[[Results], Values]
    form: str
    agrees: tuple[float, float]
    needed: int = 0

    def judged(self, results: Results) -> tuple[str, str, str, str]:
        """Return verdict, claim, the paper's numbers and ours; without the records, it is not tested."""
        try:
            values = self.values(results)
        except NoResult as reason:
            return VERDICTS[None], self.text, self.paper, str(reason)
        texts = [f"{self.form.format(values[label])} ({label})" for label in sorted(values, key=lambda n: values[n])]
        bad = [label for label, value in values.items() if not self.agrees[0] <= value <= self.agrees[1]]
        count = len(values) - len(bad)
        few = len(values) <= 6  # listed one by one
        here = listed(texts) if few else f"{texts[0]} to {texts[-1]}; {count} of {len(values)} agree"
        here += f", not {listed(bad)}" if bad and not few else ""
        return VERDICTS[count >= (self.needed or len(values))], self.text, self.paper, here


def worse_than_paper(name: str, value: float, paper: float) -> bool:
    """Whether a metric ("cc" or "l2") is worse than the paper's, at the digits that the paper prints."""
    rounded = round(value, DIGITS[name])
    return rounded < paper if name == "cc" else rounded > paper


def _error(value: float, name: str) -> float:
    return 1 - value if name == "cc" else value


def _nerif(results: Results, name: str) -> Values:
    rows = results.cells(["NeRIF"])
    return {f"Phantom {p}, noise {noise:g}": score(row, name) for (p, noise, _), row in rows.items()}


def _advantage(
    results: Results, noise: float, rivals: Iterable[str], names: Iterable[str] = ("cc", "l2"), of_rivals: float = 0.0
) -> Values:
    """Return the errors of the best rival on each phantom over NeRIF's."""
    ratios = {}
    for name in names:
        for p in PHANTOMS:
            best = min(_error(score(results.cell(p, of_rivals, m), name), name) for m in rivals)
            nerif = _error(score(results.cell(p, noise, "NeRIF"), name), name)
            ratios[f"{name.upper()}, Phantom {p}"] = best / nerif if nerif else math.inf
    return ratios


def _as_the_paper(results: Results) -> Values:
    """Return errors over the paper's, at the digits that the paper prints."""
    ratios = {}
    for name, table in (("l2", L2), ("cc", CORRELATION)):
        for (p, noise, _), row in results.cells(["NeRIF"]).items():
            values = score(row, name), table[p][NOISES.index(noise)]
            here, paper = (round(_error(value, name), DIGITS[name]) for value in values)
            ratios[f"{name.upper()}, Phantom {p}, noise {noise:g}"] = here / paper
    return ratios


def _slices(results: Results, methods: Iterable[str], noise: float, name: str) -> list[float]:
    rows = results.cells(methods, [noise]).values()
    for row in rows:
        score(row, name)
    return slice_scores(rows, name)


def _median_cc(results: Results) -> Values:
    return {"median": median(_slices(results, VOXEL_METHODS, 0.0, "cc"))}


def _low_ssim(results: Results) -> Values:
    values = _slices(results, VOXEL_METHODS, 0.0, "ssim")
    return {f"median {median(values):.4f}": sum(value < 0.9 for value in values) / len(values)}


def _slices_of_nerif(results: Results) -> Values:
    pairs = [(name, noise) for name in ("cc", "ssim") for noise in NOISES]
    return {f"{name.upper()}, noise {n:g}": median(_slices(results, ["NeRIF"], n, name)) for name, n in pairs}


def _to_paper_error(results: Results, noise: float, across: str, enough: float) -> float:
    """Return epochs or seconds until the paper's L2 of Phantom 2; infinity if enough do not suffice."""
    row = results.cell("2", noise, "NeRIF")
    total, last = score(row, "time" if across == "seconds" else "epochs"), score(row, "l2")
    point = first_at(row, "l2", paper_value(L2, "2", "NeRIF", noise))
    if point is None and total < enough:
        raise NoResult(f"{row['key']} is too short: L2 still {last:.3%} after {total:.3g} {across}")
    return math.inf if point is None else float(point[across])


def _epochs(results: Results) -> Values:
    return {f"noise {noise:g}": _to_paper_error(results, noise, "epochs", EPOCHS) for noise in NOISES}


def _minutes(results: Results) -> Values:
    seconds = _to_paper_error(results, 0.0, "seconds", 60 * LIMIT)
    return {results.cell("2", 0.0, "NeRIF")["processor"]: seconds / 60}


def _speedup(results: Results) -> Values:
    ratios, nerif = {}, results.cell("2", 0.0, "NeRIF")
    score(nerif, "l2")
    for method in VOXEL_METHODS:
        rival = results.cell("2", 0.0, method)
        point = first_at(nerif, "l2", score(rival, "l2"))
        ratios[method] = rival["time"] / point["seconds"] if point else 0.0
    return ratios


def _memory(results: Results, methods: Iterable[str]) -> Values:
    return {m: max(score(row, "memory") for row in results.cells([m], [0.0]).values()) for m in methods}


def _over(one: Row, other: Row, name: str = "l2_variation") -> Values:
    return {f"{one['label']} over {other['label']}": score(one, name) / score(other, name)}


def _best(rows: Iterable[Row]) -> Row:
    return min(rows, key=lambda row: score(row, "l2_variation"))


def _network(results: Results) -> Values:
    plain, _, gradient_head = results.section("network").values()
    return _over(plain, gradient_head)


def _encoding(results: Results) -> Values:
    without, *others = results.section("encoding").values()
    return _over(without, _best(others))


def _too_many(results: Results, name: str) -> Values:
    rows = list(results.section("encoding").values())
    return _over(rows[-1], _best(rows), name)


def _sampling(results: Results) -> Values:
    random, _, regular = results.section("sampling").values()
    return _over(regular, random)


def resolution_of(row: Row) -> float:
    """Return line pairs per unit; where finer than the profiles resolve, their limit."""
    value = score(row, "resolution")["lp_per_unit"]
    return SAMPLES / 2 if value is None else value


CLAIMS = [
    Claim("CC of NeRIF exceeds 0.99 for all phantoms at all noise levels", "0.9944 to 0.9997",
          lambda results: _nerif(results, "cc"), "{:.4f}", (0.99, 1)),
    Claim("L2 of NeRIF is predominantly below 1% (here: in at least as many cells as in the paper)",
          "in 20 of 21; 0.343% to 1.041%", lambda results: _nerif(results, "l2"), "{:.3%}", (0, 0.01), 20),
    Claim("NeRIF beats Tikhonov and Landweber on every phantom, in CC and in L2 (without noise)", "on 7 of 7, in both",
          lambda results: _advantage(results, 0.0, VOXEL_METHODS), "{:.2g} times NeRIF's error", (1, math.inf)),
    Claim("Robust: with noise 0.15, the L2 of NeRIF stays below that of the voxel methods without noise",
          "the better voxel method has 2.2 to 6.9 times NeRIF's",
          lambda results: _advantage(results, 0.15, VOXEL_METHODS, ["l2"]), "{:.2g} times", (1, math.inf)),
    Claim("Slices of the voxel methods: CC around 0.9 (here: median 0.85 to 0.95)", "CC around 0.9", _median_cc,
          "{:.4f}", (0.85, 0.95)),
    Claim("Slices of the voxel methods: SSIM generally below 0.9 (here: in more than half)", "SSIM below 0.9",
          _low_ssim, "{:.0%}", (0.5, 1)),
    Claim("Slices of NeRIF: CC and SSIM approach 1 (here: medians of at least 0.95 at every noise)", "approaching 1",
          _slices_of_nerif, "{:.4f}", (0.95, 1)),
    Claim("NeRIF converges to an acceptable error within about 50 epochs (acceptable here: the paper's own final L2 of "
          "that case; Phantom 2)", "L2 0.423%, 0.419% and 0.343% at noise 0, 0.1 and 0.15", _epochs,
          "{:.3g} epochs", (0, EPOCHS)),
    Claim("NeRIF needs just over 20 minutes (here: at most 22, to the paper's L2 of Phantom 2 without noise)",
          "20 min, RTX 4090", _minutes, "{:.3g} min", (0, LIMIT)),
    Claim("The voxel methods need over 10 hours, 30 times as long (here: as NeRIF to the same L2 or lower, Phantom 2)",
          "10 h, 64 cores", _speedup, "{:.2g} times", (MINUTES["Tikhonov"] / MINUTES["NeRIF"], math.inf)),
    Claim("NeRIF runs in about 10 GB of memory (here: at most 11)", "10 GB",
          lambda results: _memory(results, ["NeRIF"]), "{:.3g} GB", (0, 1.1 * MEMORY_GB["NeRIF"])),
    Claim("The voxel methods need 184 GB for the matrix alone", "184 GB",
          lambda results: _memory(results, VOXEL_METHODS), "{:.3g} GB", (MEMORY_GB["Tikhonov"], math.inf)),
    Claim("The multi-head network with gradient head converges better than the plain one",
          f"loss {NETWORK_LOSS['multi-head']} against {NETWORK_LOSS['plain']}, of other terms and so not comparable",
          _network, "{:.3g} times the error", LOWER),
    Claim("Positional encoding speeds up convergence (here: a lower error at the end of equally long runs)", "a figure",
          _encoding, "{:.3g} times the error", LOWER),
    Claim("Too many octaves overfit, first part: the error is higher", "a remark",
          lambda results: _too_many(results, "l2_variation"), "{:.3g} times the error", LOWER),
    Claim("Too many octaves overfit, second part: the loss is no higher", "a remark",
          lambda results: _too_many(results, "loss"), "{:.3g} times the loss", (0, 1)),
    Claim("Random sampling along the rays is more accurate than regular sampling", "a remark", _sampling,
          "{:.3g} times the error", LOWER),
    Claim("The spatial resolution, at an MTF of 10%, is 61.58 lp/unit", "61.58 lp/unit",
          lambda results: {"NeRIF": resolution_of(results.section("resolution")["NeRIF"])}, "{:.2f} lp/unit",
          (RESOLUTION, math.inf)),
    Claim("Goal of nerif: on every phantom and noise level NeRIF is as accurate as in the paper's tables, in L2 and in "
          "CC (why not in L2: see √(1 − CC²) below the tables, which no ambient flatters)", "the tables",
          _as_the_paper, "{:.2g} times the paper's error", (0, 1)),
    Claim("Not in the paper: NeRIF beats total variation, too, on every phantom, in CC and in L2 (without noise)", "–",
          lambda results: _advantage(results, 0.0, ["TV"]), "{:.2g} times NeRIF's error", (1, math.inf)),
    Claim("Not in the paper: NeRIF beats Tikhonov, Landweber and total variation at equal noise of 0.1", "–",
          lambda results: _advantage(results, 0.1, [*VOXEL_METHODS, "TV"], of_rivals=0.1), "{:.2g} times NeRIF's error",
          (1, math.inf)),
]  # fmt: skip
