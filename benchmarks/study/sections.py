"""Text of each section of the page: tables, and one or two sentences computed from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.study import tables
from benchmarks.study.claims import MARGIN, resolution_of, to_paper_error
from benchmarks.study.paper import L2, NETWORK_LOSS, RESOLUTION
from benchmarks.study.plan import METHODS, SECTIONS
from benchmarks.study.results import Record, Results, finite, first_at, metric
from benchmarks.study.words import NOTHING, bare, cc, count, duration, factor, listed, numbers_table, share
from nerif.plotting.notebook import number


def section_text(name: str, results: Results) -> list[str]:
    """Return the blocks of a section in Markdown, without its heading and figures."""
    return TEXTS[name](results)


def _of_settings(section: str, remark: str) -> Callable[[Results], list[str]]:
    """Return the text of a section that changes one setting of NeRIF: a row each, and the lowest error."""

    def text(results: Results) -> list[str]:
        rows = [[bare(label), *_scores(record), *_run(record)] for label, _, record in results.rows(section)]
        head = ["Setting", "Error of the variation", "L2", "CC", "SSIM", "Loss", "Epochs", "Time"]
        return [*_best(results, section), remark, numbers_table(head, rows)]

    return text


def _best(results: Results, section: str) -> list[str]:
    values = {label: metric(record, "l2_variation") for label, _, record in results.rows(section)}
    errors = {label: value for label, value in values.items() if value is not None}
    if len(errors) < 2:
        return []
    best, worst = (f(errors, key=lambda label: errors[label]) for f in (min, max))
    close = [label for label, value in errors.items() if value <= errors[best] / (1 - MARGIN) and label != best]
    text = f"Lowest error: {bare(best)}, {share(errors[best])}"
    text += f", and within {MARGIN:.0%} of it {listed(map(bare, close))}" if close else ""
    return [
        f"{text}; highest: {bare(worst)}, {share(errors[worst])}, {errors[worst] / errors[best]:.2f} times as much."
    ]


def _scores(record: Record | None) -> list[str]:
    forms = {"l2_variation": share, "l2": share, "cc": cc, "ssim": cc}
    return [form(metric(record, name)) for name, form in forms.items()]


def _run(record: Record | None) -> list[str]:
    if record is None:
        return [NOTHING] * 3
    return [count(finite(record.get("loss"))), count(finite(record.get("epochs"))), duration(finite(record["seconds"]))]


def _model(results: Results) -> list[str]:
    blocks = _of_settings("model", "Phantom 2 without noise; it was simulated along curved rays.")(results)
    forward: dict[str, Any] = next((r["forward"] for _, _, r in results.rows("model") if r and r.get("forward")), {})
    if not forward:
        return blocks
    head = ["Model, on the true field", "rms difference from curved rays [px]", "of the rms displacement"]
    rows = [[bare(n), number(v.get("rms_px"), 3), share(finite(v.get("relative")))] for n, v in forward.items()]
    return [*blocks, "Differences of the forward models alone from the curved rays:", numbers_table(head, rows)]


def _resolution(results: Results) -> list[str]:
    rows = []
    for label, _, record in results.rows("resolution"):
        pixels = finite(record.get("pixels_per_unit")) if record else None
        value, text = None, NOTHING if record is None else "not measured"
        edge = None
        if record and record.get("resolution"):
            (value, text), edge = resolution_of(record), finite(record["resolution"].get("lp_per_mm"))
        times = f"{2 * value / pixels:.2f}" if value and pixels else NOTHING
        limit = f"{pixels / 2:.2f} lp/unit" if pixels else NOTHING
        rows.append([bare(label), text, f"{edge:.3g} lp/mm" if edge else NOTHING, limit, times])
    head = ["Method", "Resolution (MTF at 10%)", "per mm", "Nyquist limit of the pixels", "over that limit"]
    text = (
        f"The paper has {RESOLUTION} lp/unit, a unit being a quarter of the edge of the box. The pixels sample no line "
        "pair narrower than two of them; a figure beyond that limit (over 1 in the last column) rests on the faces "
        "being plane and many, not on details in the images."
    )
    return [text, numbers_table(head, rows)]


def _views(results: Results) -> list[str]:
    rows = [[bare(label), *_scores(record), *_run(record)[1:]] for label, _, record in results.rows("views")]
    head = ["Views", "Error of the variation", "L2", "CC", "SSIM", "Epochs", "Time"]
    values = [(case.ring.views, metric(record, "l2_variation")) for _, case, record in results.rows("views")]
    errors = [(n, value) for n, value in values if value is not None]
    text = "Phantom 2 at noise 0.1, cameras evenly over 180°; the paper has nine."
    if len(errors) > 1 and errors[0][1] > errors[-1][1]:
        (few, first), (many, last) = errors[0], errors[-1]
        text += f" From {few} to {many} views the error falls by a factor of {factor(first / last)}."
    return [text, numbers_table(head, rows)]


def _speed(results: Results) -> list[str]:
    rivals = {m: metric(results.cell("2", 0.0, m), "l2_variation") for m in METHODS[1:]}
    rows = []
    for label, _, record in results.rows("speed"):
        row = [bare(label), *_scores(record)[:2], _when(record, to_paper_error(record) if record else None)]
        for level in rivals.values():
            point = first_at(record, "l2_variation", level) if record and level is not None else None
            row.append(NOTHING if level is None else _when(record, point))
        rows.append([*row, *_run(record)[1:]])
    head = ["NeRIF", "Error of the variation", "L2", f"to the paper's L2 ({share(L2['2'][0])})"]
    head += [f"to the error of {m} ({share(v)})" for m, v in rivals.items()] + ["Epochs", "Time in all"]
    times = [f"{m} {duration(r['seconds'])}" for m in METHODS[1:] if (r := results.cell("2", 0.0, m)) is not None]
    text = (
        "Phantom 2 without noise. Upper bounds: the error is computed twelve times in a run. The learning rate falls "
        "with the time that a run has, so that a shorter run ends below the curve of this one."
    )
    text += f" The classical methods took: {', '.join(times)}." if times else ""
    return [text, numbers_table(head, rows)]


def _when(record: Record | None, point: dict[str, float] | None) -> str:
    return NOTHING if record is None else "not reached" if point is None else duration(point["seconds"])


SETTING = "Phantom 2 at noise 0.1; each run changes only this, and has the same limits of time and steps."

TEXTS: dict[str, Callable[[Results], list[str]]] = {
    "tables": tables.accuracy,
    "slices": tables.slices,
    "curves": tables.convergence,
    "cost": tables.costs,
    "network": _of_settings(
        "network",
        f"{SETTING} The paper has mean losses of {NETWORK_LOSS['multi-head']} (multi-head) and {NETWORK_LOSS['plain']} "
        "(plain). Losses of different terms cannot be compared; the error against the truth decides here.",
    ),
    "encoding": _of_settings("encoding", f"{SETTING} N is the number of octaves; the paper has this as a figure only."),
    "sampling": _of_settings(
        "sampling",
        f"{SETTING} Random: one draw in every interval (the paper's); shifted: one draw a ray; regular: none.",
    ),
    "differentiation": _of_settings("differentiation", SETTING),
    "model": _model,
    "resolution": _resolution,
    "views": _views,
    "speed": _speed,
}
assert set(TEXTS) == set(SECTIONS)
