"""Tables of phantoms, noises and methods with the paper's values: correlation, L2, slices, time and memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import median

from benchmarks.study.claims import to_paper_error, worse_than_paper
from benchmarks.study.paper import CORRELATION, L2, MEMORY_GB, MINUTES, paper_value
from benchmarks.study.plan import METHODS, NOISES, PHANTOMS
from benchmarks.study.results import Results, finite, metric
from benchmarks.study.words import NOTHING, cc, count, duration, listed, memory, numbers_table, share

WORSE = "▲"
"""Marks a value less accurate than the paper's."""

Column = tuple[str, float]
"""Method and noise."""

FIRST: tuple[Column, ...] = (*(("NeRIF", noise) for noise in NOISES), *((m, 0.0) for m in METHODS[1:]))
SECOND: tuple[Column, ...] = tuple((m, noise) for m in METHODS[1:] for noise in NOISES[1:])
FORMS: dict[str, tuple[Callable[[float | None], str], dict[str, tuple[float, ...]]]] = {
    "cc": (cc, CORRELATION),
    "l2": (share, L2),
    "l2_variation": (share, {}),
}
LEFT_BY_CC = (
    "L2 has the ambient in its denominator, so fields that fill more or less of their box cannot be compared by it; "
    "the paper's flames are not ours. By the correlation they can: whatever scale and offset are given to the "
    "reconstruction, the rms error is √(1 − CC²) of the standard deviation of the truth or more. Each cell is *here "
    "(paper)*; the paper's are computed from the four digits of its table."
)


def accuracy(results: Results) -> list[str]:
    """Return correlation and L2 of every phantom, noise and method, and the error of the variation."""
    key = (
        f"Each cell is *here (paper)*; {WORSE} and bold: less accurate here, at the digits the paper prints; "
        f"{NOTHING}: not done yet. The number after a method is the noise, as a share of the rms displacement."
    )
    blocks = [*_summary(results), key]
    for name, title in (("cc", "Correlation coefficient"), ("l2", "L2 error, |n_gt − n_rec| / |n_gt − 1|")):
        blocks += [f"### {title}", _table(results, FIRST, name)]
        blocks += ["The classical methods with noise, which the paper does not have:", _table(results, SECOND, name)]
    title = "Error of the variation, |n_gt − n_rec| / |n_gt − n_ambient|"
    blocks += [f"### {title}", _table(results, FIRST, "l2_variation"), _table(results, SECOND, "l2_variation")]
    return [*blocks, "### Lower bound of the error from the correlation, √(1 − CC²)", LEFT_BY_CC, _left_by_cc(results)]


def _heads(columns: Sequence[Column]) -> list[str]:
    return ["Phantom", *(f"{method} {noise:g}" for method, noise in columns)]


def _left_by_cc(results: Results) -> str:
    def cell(phantom: str, method: str, noise: float) -> str:
        here = metric(results.cell(phantom, noise, method), "cc")
        paper = paper_value(CORRELATION, phantom, method, noise)
        text = share(None if here is None else math.sqrt(1 - here**2))
        return text if paper is None else f"{text} ({math.sqrt(1 - paper**2):.1%})"

    return numbers_table(_heads(FIRST), [[p, *(cell(p, *column) for column in FIRST)] for p in PHANTOMS])


def _summary(results: Results) -> list[str]:
    """Return the range of NeRIF's errors, and where it is the most accurate method."""
    best, compared, errors, variations = 0, 0, [], []
    for phantom in PHANTOMS:
        for noise in NOISES:
            l2 = {m: metric(results.cell(phantom, noise, m), "l2") for m in METHODS}
            nerif, *others = l2.values()
            if nerif is None:
                continue
            errors.append(nerif)
            variations.append(metric(results.cell(phantom, noise, "NeRIF"), "l2_variation"))
            if all(v is not None for v in others):
                compared += 1
                best += nerif < min(v for v in others if v is not None)
    if not errors:
        return []
    finite_variations = [v for v in variations if v is not None]
    text = f"NeRIF's L2 runs from {share(min(errors))} to {share(max(errors))}"
    if finite_variations:
        text += f", its error of the variation from {share(min(finite_variations))} to {share(max(finite_variations))}"
    if compared:
        text += (
            f"; it has the lowest L2 of the {len(METHODS)} methods in {best} of {compared} cases of phantom and noise"
        )
    return [f"{text}."]


def _table(results: Results, columns: Sequence[Column], name: str) -> str:
    rows = [[p, *(_cell(results, p, noise, method, name) for method, noise in columns)] for p in PHANTOMS]
    return numbers_table(_heads(columns), rows)


def _cell(results: Results, phantom: str, noise: float, method: str, name: str) -> str:
    form, table = FORMS[name]
    value, paper = metric(results.cell(phantom, noise, method), name), paper_value(table, phantom, method, noise)
    text = "failed" if results.failed_cell(phantom, noise, method) else form(value)
    if paper is None:
        return text
    if value is not None and worse_than_paper(name, value, paper):
        text = f"{WORSE} **{text}**"
    return f"{text} ({form(paper)})"


def slices(results: Results) -> list[str]:
    """Return median and lowest score of the slices of all phantoms, by method and noise."""
    rows = []
    for method, noise in (*FIRST, *SECOND):
        records = [r for r in (results.cell(p, noise, method) for p in PHANTOMS) if r is not None]
        row = [f"{method} {noise:g}"]
        for name in ("cc", "ssim"):
            scores = (finite(s.get(name)) for r in records for s in r["metrics"].get("slices") or [])
            values = [v for v in scores if v is not None]
            below = f"{sum(v < 0.9 for v in values) / len(values):.0%}" if values else NOTHING
            row += [cc(median(values) if values else None), cc(min(values, default=None)), below]
        rows.append(row)
    head = ["Method and noise", "CC, median", "lowest", "below 0.9", "SSIM, median", "lowest", "below 0.9"]
    text = "Ten slices across z of each of the seven phantoms; the share below 0.9 is of all slices that are there."
    return [text, numbers_table(head, rows)]


def convergence(results: Results) -> list[str]:
    """Return when NeRIF reaches the paper's error on Phantom 2."""
    rows = []
    for noise in NOISES:
        record, level = results.cell("2", noise, "NeRIF"), paper_value(L2, "2", "NeRIF", noise)
        point = to_paper_error(record) if record is not None else None
        never = "not reached" if record is not None and record.get("curve") else NOTHING
        rows.append([
            f"{noise:g}", share(level),
            never if point is None else count(finite(point.get("epoch"))),
            never if point is None else duration(point["seconds"]),
            share(metric(record, "l2")), count(finite(record.get("epochs")) if record else None),
            duration(record["seconds"]) if record else NOTHING,
        ])  # fmt: skip
    head = ["Noise", "Paper's L2", "epochs to it", "time to it", "L2 at the end", "epochs in all", "time in all"]
    text = (
        "The error is computed twelve times in a run, so the epochs and times at which it is reached are upper bounds."
    )
    return [text, numbers_table(head, rows)]


def costs(results: Results) -> list[str]:
    """Return time and memory of each method, here and in the paper."""
    rows = []
    for method in METHODS:
        records = [r for r in (results.cell(p, 0.0, method) for p in PHANTOMS) if r is not None]
        finite_values = ([finite(r.get(name)) for r in records] for name in ("seconds", "peak_memory_bytes"))
        times, sizes = ([v for v in values if v is not None] for values in finite_values)
        minutes, gigabytes = MINUTES.get(method), MEMORY_GB.get(method)
        rows.append([
            method, listed(sorted({str(r["device"]) for r in records})) if records else NOTHING,
            duration(median(times) if times else None), duration(max(times, default=None)),
            f"{minutes} min" if minutes and minutes < 120 else f"over {minutes / 60:g} h" if minutes else NOTHING,
            memory(median(sizes) if sizes else None), memory(max(sizes, default=None)),
            f"{gigabytes} GB" if gigabytes else NOTHING,
        ])  # fmt: skip
    head = ["Method", "Device", "time, median", "longest", "paper", "memory, median", "highest", "paper"]
    text = (
        "Medians over the seven phantoms without noise. NeRIF's time is the limit that the study sets, not what it "
        "needs: see the error against time. The paper's voxel methods store the matrix of a Monte Carlo integration; "
        "those here integrate along the rays again in every iteration and store none. Memory is that of the whole "
        "process on a CPU, and of tensors on a GPU."
    )
    return [text, numbers_table(head, rows)]
