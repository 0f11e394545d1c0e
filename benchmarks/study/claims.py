"""Claims of the paper with its numbers, ours, and a verdict computed from the records alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from statistics import median
from typing import Literal

from benchmarks.study.paper import CORRELATION, L2, MEMORY_GB, MINUTES, NETWORK_LOSS, RESOLUTION, paper_value
from benchmarks.study.plan import NOISES, PHANTOMS
from benchmarks.study.results import NoResult, Record, Results, finite, first_at, score, typical
from benchmarks.study.words import cc, duration, factor, listed, memory, share

Verdict = Literal["reproduced", "not reproduced", "not tested"]
Answer = Callable[[Results], tuple[str, bool | None]]
"""Our numbers, and whether they confirm the claim (None: cannot be tested)."""

VOXEL_METHODS = ("Tikhonov", "Landweber")  # the paper's
DIGITS = {"cc": 4, "l2": 5}
"""Digits of the paper's tables after the point, to which values are rounded before a comparison."""
WHY = "; why: see √(1 − CC²) below the tables, which no ambient flatters"
AROUND, NEAR_1 = (0.85, 0.95), 0.95  # "around 0.9" and "approaching 1"
EPOCHS = 50  # "approximately 50"
JUST_OVER = 1.1  # "just over 20 minutes"
MARGIN = 0.05  # relative difference of errors between equal runs
TIME_RATIO = MINUTES["Tikhonov"] / MINUTES["NeRIF"]
NERIF_CC, NERIF_L2 = ([v for p in PHANTOMS for v in table[p][: len(NOISES)]] for table in (CORRELATION, L2))
L2_BELOW = sum(value < 0.01 for value in NERIF_L2)
PAPER_RATIOS = [min(L2[p][3:]) / L2[p][2] for p in PHANTOMS]


@dataclass(frozen=True)
class Claim:
    """A claim, the paper's numbers, ours (or why there are none), and the verdict."""

    text: str
    paper: str
    here: str
    verdict: Verdict


CLAIMS: list[tuple[str, str, Answer]] = []


def claim(text: str, paper: str) -> Callable[[Answer], Answer]:
    """Register the test of a claim; they stand on the page in the order of this file."""

    def register(answer: Answer) -> Answer:
        CLAIMS.append((text, paper, answer))
        return answer

    return register


def claims(results: Results) -> list[Claim]:
    """Return every claim with its verdict; one whose records are missing or failed is not tested."""
    judged = []
    for text, paper, answer in CLAIMS:
        verdict: Verdict = "not tested"
        try:
            here, holds = answer(results)
        except NoResult as reason:
            here, holds = f"{reason}", None
        if holds is not None:
            verdict = "reproduced" if holds else "not reproduced"
        judged.append(Claim(text, paper, here, verdict))
    return judged


def worse_than_paper(name: str, value: float, paper: float) -> bool:
    """Whether a metric ("cc" or "l2") is worse than the paper's, at the digits that the paper prints."""
    rounded = round(value, DIGITS[name])
    return rounded < paper if name == "cc" else rounded > paper


# -- tables and slices -------------------------------------------------------------------------------------------------


@claim("CC of NeRIF exceeds 0.99 for all phantoms at all noise levels", f"{cc(min(NERIF_CC))} to {cc(max(NERIF_CC))}")
def _correlation(results: Results) -> tuple[str, bool]:
    scores = {cell: score(record, "cc") for cell, record in results.cells(["NeRIF"]).items()}
    worst = min(scores, key=lambda cell: scores[cell])
    least = f"{cc(scores[worst])} (Phantom {worst[0]}, noise {worst[1]:g})"
    above = sum(value > 0.99 for value in scores.values())
    return f"{least} to {cc(max(scores.values()))}; above 0.99 in {above} of {len(scores)}", above == len(scores)


@claim(
    "L2 of NeRIF is predominantly below 1% (here: in at least as many cells as in the paper)",
    f"in {L2_BELOW} of {len(NERIF_L2)}; {share(min(NERIF_L2))} to {share(max(NERIF_L2))}",
)
def _l2(results: Results) -> tuple[str, bool]:
    errors = [score(record, "l2") for record in results.cells(["NeRIF"]).values()]
    below = sum(value < 0.01 for value in errors)
    return f"below 1% in {below} of {len(errors)}; {share(min(errors))} to {share(max(errors))}", below >= L2_BELOW


def _beats(results: Results, noise: float, rivals: tuple[str, ...]) -> tuple[str, bool]:
    records = results.cells(["NeRIF", *rivals], [noise])
    parts, lost = [], False
    for name, sign, words in (("cc", -1, "CC higher"), ("l2", 1, "L2 lower")):
        values = {cell: sign * score(record, name) for cell, record in records.items()}
        bad = [p for p in PHANTOMS if values[p, noise, "NeRIF"] >= min(values[p, noise, m] for m in rivals)]
        lost |= bool(bad)
        but = f" (not on {listed(bad, 7)})" if bad else ""
        parts.append(f"{words} on {len(PHANTOMS) - len(bad)} of {len(PHANTOMS)} phantoms{but}")
    return "; ".join(parts), not lost


@claim("NeRIF beats Tikhonov and Landweber on every phantom, in CC and in L2 (without noise)", "on 7 of 7, in both")
def _beats_voxel_methods(results: Results) -> tuple[str, bool]:
    return _beats(results, 0.0, VOXEL_METHODS)


@claim(
    f"Robust: with noise {NOISES[-1]:g}, the L2 of NeRIF stays below that of the voxel methods without noise",
    f"the better voxel method has {min(PAPER_RATIOS):.2g} to {max(PAPER_RATIOS):.2g} times NeRIF's",
)
def _robust(results: Results) -> tuple[str, bool]:
    nerif, voxels = results.cells(["NeRIF"], [NOISES[-1]]), results.cells(VOXEL_METHODS, [0.0])
    ratios = {
        p: min(score(voxels[p, 0.0, m], "l2") for m in VOXEL_METHODS) / score(nerif[p, NOISES[-1], "NeRIF"], "l2")
        for p in PHANTOMS
    }
    bad = [p for p, ratio in ratios.items() if ratio <= 1]
    but = f"; not on Phantom {listed(bad, 7)}" if bad else ""
    spread = f"{min(ratios.values()):.2g} to {max(ratios.values()):.2g} times NeRIF's"
    return f"the better voxel method has {spread}{but}", not bad


def _of_slices(records: Iterable[Record], name: str) -> list[float]:
    slices = (s for record in records for s in record["metrics"].get("slices") or [])
    values = [value for value in (finite(s.get(name)) for s in slices) if value is not None]
    if not values:
        raise NoResult(f"no slice has a {name.upper()}")
    return values


@claim(
    f"Slices of the voxel methods: CC around 0.9 (here: median {AROUND[0]} to {AROUND[1]}), SSIM generally below 0.9 "
    "(here: in more than half)",
    "CC around 0.9, SSIM below 0.9",
)
def _voxel_slices(results: Results) -> tuple[str, bool]:
    records = results.cells(VOXEL_METHODS, [0.0]).values()
    centre, similar = median(_of_slices(records, "cc")), _of_slices(records, "ssim")
    below = sum(value < 0.9 for value in similar) / len(similar)
    text = f"median CC {cc(centre)}; SSIM below 0.9 in {below:.0%} of the slices, median {cc(median(similar))}"
    return text, AROUND[0] <= centre <= AROUND[1] and below > 0.5


@claim(f"Slices of NeRIF: CC and SSIM approach 1 (here: medians of at least {NEAR_1} at every noise)", "approaching 1")
def _nerif_slices(results: Results) -> tuple[str, bool]:
    parts, lowest = [], 1.0
    for noise in NOISES:
        records = results.cells(["NeRIF"], [noise]).values()
        middles = [median(_of_slices(records, name)) for name in ("cc", "ssim")]
        lowest = min(lowest, *middles)
        parts.append(f"noise {noise:g}: {cc(middles[0])} and {cc(middles[1])}")
    return f"medians of CC and SSIM: {'; '.join(parts)}", lowest >= NEAR_1


# -- convergence, time and memory --------------------------------------------------------------------------------------


def to_paper_error(record: Record) -> dict[str, float] | None:
    """Return the first point of a curve whose L2 is at most the paper's of that phantom and noise, or None."""
    level = paper_value(L2, record["phantom"], "NeRIF", record["noise"])
    return None if level is None else first_at(record, "l2", level)


@claim(
    f"NeRIF converges to an acceptable error within about {EPOCHS} epochs (acceptable here: the paper's own final L2 "
    "of that case; Phantom 2)",
    f"L2 {listed(share(paper_value(L2, '2', 'NeRIF', noise)) for noise in NOISES)} at noise "
    f"{listed(f'{noise:g}' for noise in NOISES)}",
)
def _epochs(results: Results) -> tuple[str, bool | None]:
    parts: list[str] = []
    verdicts: list[bool | None] = []
    for noise in NOISES:
        record = results.one("2", noise, "NeRIF")
        point, total = to_paper_error(record), finite(record.get("epochs")) or 0.0
        if point is not None:
            epochs = finite(point.get("epoch")) or 0.0
            parts.append(f"noise {noise:g}: L2 {share(finite(point['l2']))} after {epochs:.3g} epochs")
            verdicts.append(epochs <= EPOCHS)
        else:
            parts.append(f"noise {noise:g}: still {share(score(record, 'l2'))} at the end, {total:.3g} epochs")
            verdicts.append(False if total >= EPOCHS else None)
    holds = False if False in verdicts else None if None in verdicts else True
    short = f"; the run is too short: less than {EPOCHS} epochs" if holds is None else ""
    return "; ".join(parts) + short, holds


@claim(
    "NeRIF needs just over 20 minutes (here: at most 22, to the paper's L2 of Phantom 2 without noise)",
    f"{MINUTES['NeRIF']} min, RTX 4090",
)
def _time(results: Results) -> tuple[str, bool | None]:
    record = results.one("2", 0.0, "NeRIF")
    point, total = to_paper_error(record), record["seconds"]
    allowed = 60 * JUST_OVER * MINUTES["NeRIF"]
    if point is not None:
        where = f"at the paper's L2 of Phantom 2 after {duration(point['seconds'])} ({record['device']})"
        return f"{where}; the whole run took {duration(total)}, a limit set by the study", point["seconds"] <= allowed
    text = f"not at the paper's L2 of Phantom 2 within {duration(total)}, the limit of the study"
    return f"{text}: still {share(score(record, 'l2'))}", False if total >= allowed else None


@claim(
    f"The voxel methods need over 10 hours, {TIME_RATIO:g} times as long (here: as NeRIF to the same error or lower)",
    f"{MINUTES['Tikhonov'] / 60:g} h, 64 cores",
)
def _speedup(results: Results) -> tuple[str, bool]:
    record = results.one("2", 0.0, "NeRIF")
    ratios, parts = [], []
    for method in VOXEL_METHODS:
        rival = results.one("2", 0.0, method)
        time = typical(results.cells([method], [0.0]).values(), "seconds") or rival["seconds"]
        point = first_at(record, "l2", score(rival, "l2"))
        ratios.append(rival["seconds"] / point["seconds"] if point else 0.0)
        ratio = f", on Phantom 2 {factor(ratios[-1])} times as long as NeRIF to the same L2 or a lower one"
        missed = ", whose error NeRIF does not reach on Phantom 2"
        parts.append(f"{method} {duration(time)} ({rival['device']}){ratio if point else missed}")
    return "; ".join(parts), min(ratios) >= TIME_RATIO


def _memory(results: Results, methods: Iterable[str]) -> tuple[str, list[float]]:
    parts, peaks = [], []
    for method in methods:
        records = results.cells([method], [0.0]).values()
        peaks.append(max(finite(record.get("peak_memory_bytes")) or 0.0 for record in records))
        if not peaks[-1]:
            raise NoResult(f"the memory of {method} was not measured")
        parts.append(f"{method} {memory(peaks[-1])} ({listed(sorted({record['device'] for record in records}))})")
    return f"at most, over {len(PHANTOMS)} phantoms: {', '.join(parts)}", [peak / 1e9 for peak in peaks]


@claim("NeRIF runs in about 10 GB of memory (here: at most 11)", f"{MEMORY_GB['NeRIF']} GB")
def _memory_of_nerif(results: Results) -> tuple[str, bool]:
    text, gigabytes = _memory(results, ["NeRIF"])
    return text, max(gigabytes) <= 1.1 * MEMORY_GB["NeRIF"]


@claim("The voxel methods need 184 GB for the matrix alone", f"{MEMORY_GB['Tikhonov']} GB")
def _memory_of_voxels(results: Results) -> tuple[str, bool]:
    text, gigabytes = _memory(results, VOXEL_METHODS)
    return text, min(gigabytes) >= MEMORY_GB["Tikhonov"]


# -- network, encoding, sampling, resolution ---------------------------------------------------------------------------


def _compare(better: Record, worse: Record, words: tuple[str, str], when: str = "") -> tuple[str, bool]:
    errors = [score(record, "l2_variation") for record in (better, worse)]
    text = ", ".join(f"{word} {share(error)}" for word, error in zip(words, errors, strict=True))
    return f"error of the variation{when}: {text}", errors[0] < (1 - MARGIN) * errors[1]


def _labelled(results: Results, section: str, start: str) -> Record:
    for label, record in results.labelled(section).items():
        if label.startswith(start):
            return record
    raise NoResult(f"no run is called {start}")


@claim(
    "The multi-head network with gradient head converges better than the plain one",
    f"loss {NETWORK_LOSS['multi-head']} against {NETWORK_LOSS['plain']}",
)
def _network(results: Results) -> tuple[str, bool]:
    plain = _labelled(results, "network", "plain")
    multi = _labelled(results, "network", "multi-head, with gradient head")
    text, holds = _compare(multi, plain, ("multi-head", "plain"))
    losses = [finite(record.get("loss")) for record in (multi, plain)]
    if None not in losses:
        text += f"; loss {losses[0]:.2g} and {losses[1]:.2g}, of other terms and so not comparable"
    return text, holds


def _octaves(results: Results) -> tuple[dict[int, Record], int]:
    """Return the records by the number of octaves, and the best number above 0."""
    records = results.labelled("encoding").items()
    runs = dict(sorted((int("".join(filter(str.isdigit, label)) or 0), record) for label, record in records))
    return runs, min((n for n in runs if n), key=lambda n: score(runs[n], "l2_variation"))


@claim("Positional encoding speeds up convergence (here: a lower error at the end of equally long runs)", "a figure")
def _encoding(results: Results) -> tuple[str, bool]:
    runs, best = _octaves(results)
    if 0 not in runs:
        raise NoResult("no run without encoding")
    return _compare(runs[best], runs[0], (f"N = {best}", "no encoding"), " at the end")


@claim("Too many octaves overfit (here: a higher error at a loss that is no higher)", "a remark")
def _too_many(results: Results) -> tuple[str, bool]:
    runs, _ = _octaves(results)
    best, most = min(runs, key=lambda n: score(runs[n], "l2_variation")), max(runs)
    if best == most:
        return f"the most octaves, N = {most}, are the best: {share(score(runs[most], 'l2_variation'))}", False
    text, holds = _compare(runs[best], runs[most], (f"N = {best}", f"N = {most}"))
    losses = [finite(runs[n].get("loss")) for n in (best, most)]
    if losses[0] is None or losses[1] is None:
        return text, holds
    return f"{text}; loss {losses[0]:.3g} and {losses[1]:.3g}", holds and losses[1] <= losses[0]


@claim("Random sampling along the rays is more accurate than regular sampling", "a remark")
def _sampling(results: Results) -> tuple[str, bool]:
    random, regular = (_labelled(results, "sampling", name) for name in ("random", "regular"))
    return _compare(random, regular, ("random", "regular"))


def resolution_of(record: Record) -> tuple[float | None, str]:
    """Return line pairs per unit, and as text; None where it is finer than the profiles resolve."""
    plain = record.get("resolution")
    if plain is None:
        raise NoResult(f"the resolution of {record['key']} was not measured")
    value = finite(plain.get("lp_per_unit"))
    if value is None:
        return None, f"finer than {plain['finest_lp_per_unit']:.4g} lp/unit"
    return value, f"{value:.2f} lp/unit" if value > 0 else "no edge"


@claim("The spatial resolution, at an MTF of 10%, is 61.58 lp/unit", f"{RESOLUTION} lp/unit")
def _resolution(results: Results) -> tuple[str, bool]:
    records = results.labelled("resolution")
    value, text = resolution_of(records["NeRIF"])
    pixels = finite(records["NeRIF"].get("pixels_per_unit"))
    if pixels:
        times = f"the paper's is {2 * RESOLUTION / pixels:.2g} times that"
        text += f"; the pixels sample {pixels / 2:.2f} lp/unit (Nyquist): {times}"
    text += "".join(f"; {name} {resolution_of(record)[1]}" for name, record in records.items() if name != "NeRIF")
    finest = finite(records["NeRIF"]["resolution"].get("finest_lp_per_unit")) or 0.0
    return text, (finest if value is None else value) >= RESOLUTION


# -- goals of nerif ----------------------------------------------------------------------------------------------------


@claim(
    "Goal of nerif: on every phantom and noise level NeRIF is as accurate as in the paper's tables, in L2 and in CC",
    "the tables",
)
def _as_the_paper(results: Results) -> tuple[str, bool]:
    records = results.cells(["NeRIF"])
    parts, lost = [], False
    for name, table in (("l2", L2), ("cc", CORRELATION)):
        bad: dict[str, list[str]] = {}
        for (phantom, noise, _), record in records.items():
            if worse_than_paper(name, score(record, name), table[phantom][NOISES.index(noise)]):
                bad.setdefault(phantom, []).append(f"{noise:g}")
        count = len(records) - sum(map(len, bad.values()))
        where = [f"Phantom {phantom} (noise {', '.join(noises)})" for phantom, noises in bad.items()]
        but = f", not {listed(where, 7)}" if bad else ""
        parts.append(f"{name.upper()} in {count} of {len(records)} cells{but}")
        lost |= bool(bad)
    return "; ".join(parts) + (WHY if lost else ""), not lost


@claim("Not in the paper: NeRIF beats total variation, too, on every phantom, in CC and in L2 (without noise)", "–")
def _beats_total_variation(results: Results) -> tuple[str, bool]:
    return _beats(results, 0.0, ("TV",))


@claim("Not in the paper: NeRIF beats Tikhonov, Landweber and total variation at equal noise of 0.1", "–")
def _beats_all_with_noise(results: Results) -> tuple[str, bool]:
    return _beats(results, 0.1, (*VOXEL_METHODS, "TV"))
