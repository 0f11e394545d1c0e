"""The tables of phantoms, noises and methods, beside the paper's: correlation, L2, slices, time and memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from statistics import median

from study.cases import METHODS, NOISES, PHANTOMS
from study.claims import worse_than_paper
from study.claims_of_method import to_paper_error
from study.paper import CORRELATION, L2, MEMORY_GB, MINUTES, paper_value
from study.results import Record, Results, finite, metric
from study.words import NOTHING, cc, duration, listed, markdown_table, memory, share

__all__ = ["WORSE", "accuracy", "convergence", "costs", "slices"]

WORSE = "▲"
"""Marks what is less accurate here than in the paper."""

Column = tuple[str, float]
"""Method and noise."""

FIRST: tuple[Column, ...] = (*(("NeRIF", noise) for noise in NOISES), *((m, 0.0) for m in METHODS[1:]))
SECOND: tuple[Column, ...] = tuple((m, noise) for m in METHODS[1:] for noise in NOISES[1:])
FORMS: dict[str, tuple[Callable[[float | None], str], dict[str, tuple[float, ...]]]] = {
    "cc": (cc, CORRELATION),
    "l2": (share, L2),
    "l2_variation": (share, {}),
}


def accuracy(results: Results) -> list[str]:
    """Correlation and L2 of every phantom, noise and method, and the error of the variation."""
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
    return [*blocks, "### What the correlation leaves, √(1 − CC²)", LEFT_BY_CC, _left_by_cc(results)]


LEFT_BY_CC = (
    "L2 has the ambient in its denominator, so fields that fill more or less of their box cannot be compared by it; "
    "the paper's flames are not ours. By the correlation they can: whatever scale and offset are given to the "
    "reconstruction, the rms error is √(1 − CC²) of the standard deviation of the truth or more. Each cell is *here "
    "(paper)*; the paper's are computed from the four digits of its table."
)


def _left_by_cc(results: Results) -> str:
    rows = []
    for phantom in PHANTOMS:
        row = [phantom]
        for method, noise in FIRST:
            ours = metric(results.cell(phantom, noise, method), "cc")
            paper = paper_value(CORRELATION, phantom, method, noise)
            text = share(None if ours is None else math.sqrt(1 - ours**2))
            row.append(text if paper is None else f"{text} ({math.sqrt(1 - paper**2):.1%})")
        rows.append(row)
    return markdown_table(["Phantom", *(f"{method} {noise:g}" for method, noise in FIRST)], rows)


def _summary(results: Results) -> list[str]:
    """Where NeRIF is the most accurate of all, and its range."""
    best, compared, errors, honest = 0, 0, [], []
    for phantom in PHANTOMS:
        for noise in NOISES:
            found = {m: metric(results.cell(phantom, noise, m), "l2") for m in METHODS}
            ours = found.pop("NeRIF")
            if ours is None:
                continue
            errors.append(ours)
            honest.append(metric(results.cell(phantom, noise, "NeRIF"), "l2_variation"))
            others = [v for v in found.values() if v is not None]
            if len(others) == len(found):
                compared += 1
                best += ours < min(others)
    if not errors:
        return []
    known = [v for v in honest if v is not None]
    text = f"NeRIF's L2 runs from {share(min(errors))} to {share(max(errors))}"
    text += f", its error of the variation from {share(min(known))} to {share(max(known))}" if known else ""
    if compared:
        text += (
            f"; it has the lowest L2 of the {len(METHODS)} methods in {best} of {compared} cases of phantom and noise"
        )
    return [f"{text}."]


def _table(results: Results, columns: Sequence[Column], name: str) -> str:
    head = ["Phantom", *(f"{method} {noise:g}" for method, noise in columns)]
    rows = [[p, *(_cell(results, p, noise, method, name) for method, noise in columns)] for p in PHANTOMS]
    return markdown_table(head, rows)


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
    """Median and lowest score of the slices of all phantoms, by method and noise."""
    rows = []
    for method, noise in (*FIRST, *SECOND):
        records = [r for r in (results.cell(p, noise, method) for p in PHANTOMS) if r is not None]
        row = [f"{method} {noise:g}"]
        for name in ("cc", "ssim"):
            values = [
                v for r in records for s in r["metrics"].get("slices") or [] if (v := finite(s.get(name))) is not None
            ]
            below = f"{sum(v < 0.9 for v in values) / len(values):.0%}" if values else NOTHING
            row += [cc(median(values) if values else None), cc(min(values, default=None)), below]
        rows.append(row)
    head = ["Method and noise", "CC, median", "lowest", "below 0.9", "SSIM, median", "lowest", "below 0.9"]
    text = "Ten slices across z of each of the seven phantoms; the share below 0.9 is of all slices that are there."
    return [text, markdown_table(head, rows)]


def convergence(results: Results) -> list[str]:
    """When NeRIF comes to the paper's error on Phantom 2."""
    rows = []
    for noise in NOISES:
        record, level = results.cell("2", noise, "NeRIF"), paper_value(L2, "2", "NeRIF", noise)
        point = to_paper_error(record) if record is not None else None
        never = "not reached" if record is not None and record.get("curve") else NOTHING
        epochs = finite(point.get("epoch")) if point else None
        rows.append([
            f"{noise:g}", share(level),
            never if point is None else count(epochs),
            never if point is None else duration(point["seconds"]),
            share(metric(record, "l2")), count(finite(record.get("epochs")) if record else None),
            duration(record["seconds"]) if record else NOTHING,
        ])  # fmt: skip
    head = ["Noise", "Paper's L2", "epochs to it", "time to it", "L2 at the end", "epochs in all", "time in all"]
    text = (
        "The error is looked at twelve times in a run, so the epochs and times at which it is reached are upper bounds."
    )
    return [text, markdown_table(head, rows)]


def costs(results: Results) -> list[str]:
    """Time and memory of each method, here and in the paper."""
    rows = []
    for method in METHODS:
        records = [r for r in (results.cell(p, 0.0, method) for p in PHANTOMS) if r is not None]
        times, sizes = (list(_known(records, name)) for name in ("seconds", "peak_memory_bytes"))
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
        "those here integrate along the rays anew in every iteration and store none. Memory is that of the whole "
        "process on a CPU, and of tensors on a GPU."
    )
    return [text, markdown_table(head, rows)]


def count(value: float | None) -> str:
    """Return a number of epochs."""
    return NOTHING if value is None else f"{value:.3g}"


def _known(records: Sequence[Record], name: str) -> Iterator[float]:
    return (v for v in (finite(r.get(name)) for r in records) if v is not None)
