"""Claims of the paper on time, memory, network, encoding, sampling and resolution; claims.py has the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.study.paper import L2, MEMORY_GB, MINUTES, NETWORK_LOSS, RESOLUTION, paper_value
from benchmarks.study.plan import NOISES, PHANTOMS
from benchmarks.study.results import NoResult, Record, Results, finite, first_at, score, typical
from benchmarks.study.words import duration, factor, listed, memory, share

EPOCHS = 50  # "approximately 50"
JUST_OVER = 1.1  # "just over 20 minutes"
MARGIN = 0.05  # relative difference of errors between equal runs


@dataclass(frozen=True)
class Question:
    """A claim, the paper's numbers, and a function for ours and whether they confirm it (None: cannot be tested)."""

    text: str
    paper: str
    answer: Callable[[Results], tuple[str, bool | None]]


def to_paper_error(record: Record) -> dict[str, float] | None:
    """Return the first point of a curve whose L2 is at most the paper's of that phantom and noise, or None."""
    level = paper_value(L2, record["phantom"], "NeRIF", record["noise"])
    return None if level is None else first_at(record, "l2", level)


def _epochs(results: Results) -> tuple[str, bool | None]:
    parts: list[str] = []
    verdicts: list[bool | None] = []
    for noise in NOISES:
        record = results.one("2", noise, "NeRIF")
        point, ran = to_paper_error(record), finite(record.get("epochs")) or 0.0
        if point is not None:
            epochs = finite(point.get("epoch")) or 0.0
            parts.append(f"noise {noise:g}: L2 {share(finite(point['l2']))} after {epochs:.3g} epochs")
            verdicts.append(epochs <= EPOCHS)
        else:
            parts.append(f"noise {noise:g}: still {share(score(record, 'l2'))} at the end, {ran:.3g} epochs")
            verdicts.append(False if ran >= EPOCHS else None)
    holds = False if False in verdicts else None if None in verdicts else True
    short = f"; the run is too short: less than {EPOCHS} epochs" if holds is None else ""
    return "; ".join(parts) + short, holds


def _time(results: Results) -> tuple[str, bool | None]:
    record = results.one("2", 0.0, "NeRIF")
    point, total = to_paper_error(record), record["seconds"]
    allowed = 60 * JUST_OVER * MINUTES["NeRIF"]
    if point is not None:
        where = f"at the paper's L2 of Phantom 2 after {duration(point['seconds'])} ({record['device']})"
        return f"{where}; the whole run took {duration(total)}, a limit set by the study", point["seconds"] <= allowed
    text = f"not at the paper's L2 of Phantom 2 within {duration(total)}, the limit of the study"
    return f"{text}: still {share(score(record, 'l2'))}", False if total >= allowed else None


def _speedup(results: Results) -> tuple[str, bool]:
    record = results.one("2", 0.0, "NeRIF")
    ratios, parts = [], []
    for method in ("Tikhonov", "Landweber"):
        rival = results.one("2", 0.0, method)
        time = typical(results.cells([method], [0.0]).values(), "seconds") or rival["seconds"]
        point = first_at(record, "l2", score(rival, "l2"))
        here = f"{method} {duration(time)} ({rival['device']})"
        if point is None:
            parts.append(f"{here}, whose error NeRIF does not reach on Phantom 2")
            ratios.append(0.0)
        else:
            ratios.append(rival["seconds"] / point["seconds"])
            ratio = f"{factor(ratios[-1])} times as long"
            parts.append(f"{here}, on Phantom 2 {ratio} as NeRIF to the same L2 or a lower one")
    return "; ".join(parts), min(ratios) >= TIME_RATIO


def _memory(methods: tuple[str, ...], holds: Callable[[float], bool]) -> Callable[[Results], tuple[str, bool]]:
    def answer(results: Results) -> tuple[str, bool]:
        parts, verdicts = [], []
        for method in methods:
            records = list(results.cells([method], [0.0]).values())
            peak = max(finite(record.get("peak_memory_bytes")) or 0.0 for record in records)
            if not peak:
                raise NoResult(f"the memory of {method} was not measured")
            devices = listed(sorted({record["device"] for record in records}))
            parts.append(f"{method} {memory(peak)} ({devices})")
            verdicts.append(holds(peak / 1e9))
        return f"at most, over {len(PHANTOMS)} phantoms: {', '.join(parts)}", all(verdicts)

    return answer


def _compare(name: str, better: Record, worse: Record, words: tuple[str, str]) -> tuple[str, bool]:
    errors = [score(record, "l2_variation") for record in (better, worse)]
    text = ", ".join(f"{word} {share(error)}" for word, error in zip(words, errors, strict=True))
    return f"{name}: {text}", errors[0] < (1 - MARGIN) * errors[1]


def _network(results: Results) -> tuple[str, bool]:
    plain = _labelled(results, "network", "plain")
    multi = _labelled(results, "network", "multi-head, with gradient head")
    text, holds = _compare("error of the variation", multi, plain, ("multi-head", "plain"))
    losses = [finite(record.get("loss")) for record in (multi, plain)]
    if None not in losses:
        text += f"; loss {losses[0]:.2g} and {losses[1]:.2g}, of other terms and so not comparable"
    return text, holds


def _octaves(results: Results) -> dict[int, Record]:
    digits = {label: "".join(c for c in label if c.isdigit()) for label in results.labelled("encoding")}
    return dict(sorted((int(digits[label] or 0), record) for label, record in results.labelled("encoding").items()))


def _encoding(results: Results) -> tuple[str, bool]:
    runs = _octaves(results)
    none = runs.pop(0, None)
    if none is None:
        raise NoResult("no run without encoding")
    best = min(runs, key=lambda n: score(runs[n], "l2_variation"))
    return _compare("error of the variation at the end", runs[best], none, (f"N = {best}", "no encoding"))


def _too_many(results: Results) -> tuple[str, bool]:
    runs = _octaves(results)
    best = min(runs, key=lambda n: score(runs[n], "l2_variation"))
    most = max(runs)
    if best == most:
        return f"the most octaves, N = {most}, are the best: {share(score(runs[most], 'l2_variation'))}", False
    text, holds = _compare("error of the variation", runs[best], runs[most], (f"N = {best}", f"N = {most}"))
    losses = [finite(runs[n].get("loss")) for n in (best, most)]
    if losses[0] is None or losses[1] is None:
        return text, holds
    return f"{text}; loss {losses[0]:.3g} and {losses[1]:.3g}", holds and losses[1] <= losses[0]


def _sampling(results: Results) -> tuple[str, bool]:
    random, regular = (_labelled(results, "sampling", name) for name in ("random", "regular"))
    return _compare("error of the variation", random, regular, ("random", "regular"))


def _labelled(results: Results, section: str, start: str) -> Record:
    for label, record in results.labelled(section).items():
        if label.startswith(start):
            return record
    raise NoResult(f"no run is called {start}")


def resolution_of(record: Record) -> tuple[float | None, str]:
    """Return line pairs per unit, and as text; None where it is finer than the profiles resolve."""
    plain = record.get("resolution")
    if plain is None:
        raise NoResult(f"the resolution of {record['key']} was not measured")
    value = finite(plain.get("lp_per_unit"))
    if value is None:
        return None, f"finer than {plain['finest_lp_per_unit']:.4g} lp/unit"
    return value, f"{value:.2f} lp/unit" if value > 0 else "no edge"


def _resolution(results: Results) -> tuple[str, bool]:
    records = results.labelled("resolution")
    value, words = resolution_of(records["NeRIF"])
    pixels = finite(records["NeRIF"].get("pixels_per_unit"))
    limit = ""
    if pixels:
        times = f"the paper's is {2 * RESOLUTION / pixels:.2g} times that"
        limit = f"; the pixels sample {pixels / 2:.2f} lp/unit (Nyquist): {times}"
    others = "".join(f"; {name} {resolution_of(record)[1]}" for name, record in records.items() if name != "NeRIF")
    finest = finite(records["NeRIF"]["resolution"].get("finest_lp_per_unit")) or 0.0
    return f"{words}{limit}{others}", (finest if value is None else value) >= RESOLUTION


TIME_RATIO = MINUTES["Tikhonov"] / MINUTES["NeRIF"]

CLAIMS_OF_METHOD = (
    Question(
        f"NeRIF converges to an acceptable error within about {EPOCHS} epochs (acceptable here: the paper's own "
        "final L2 of that case; Phantom 2)",
        f"L2 {listed(share(paper_value(L2, '2', 'NeRIF', noise)) for noise in NOISES)} at noise "
        f"{listed(f'{noise:g}' for noise in NOISES)}",
        _epochs,
    ),
    Question(
        "NeRIF needs just over 20 minutes (here: at most 22, to the paper's L2 of Phantom 2 without noise)",
        f"{MINUTES['NeRIF']} min, RTX 4090",
        _time,
    ),
    Question(
        f"The voxel methods need over 10 hours, {TIME_RATIO:g} times as long (here: as NeRIF to the same error or "
        "a lower one)",
        f"{MINUTES['Tikhonov'] / 60:g} h, 64 cores",
        _speedup,
    ),
    Question(
        "NeRIF runs in about 10 GB of memory (here: at most 11)",
        f"{MEMORY_GB['NeRIF']} GB",
        _memory(("NeRIF",), lambda gigabytes: gigabytes <= 1.1 * MEMORY_GB["NeRIF"]),
    ),
    Question(
        "The voxel methods need 184 GB for the matrix alone",
        f"{MEMORY_GB['Tikhonov']} GB",
        _memory(("Tikhonov", "Landweber"), lambda gigabytes: gigabytes >= MEMORY_GB["Tikhonov"]),
    ),
    Question(
        "The multi-head network with gradient head converges better than the plain one",
        f"loss {NETWORK_LOSS['multi-head']} against {NETWORK_LOSS['plain']}",
        _network,
    ),
    Question(
        "Positional encoding speeds up convergence (here: a lower error at the end of equally long runs)",
        "a figure",
        _encoding,
    ),
    Question("Too many octaves overfit (here: a higher error at a loss that is no higher)", "a remark", _too_many),
    Question("Random sampling along the rays is more accurate than regular sampling", "a remark", _sampling),
    Question("The spatial resolution, at an MTF of 10%, is 61.58 lp/unit", f"{RESOLUTION} lp/unit", _resolution),
)
