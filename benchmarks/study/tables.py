"""Text of each section: tables with the paper's values, and one or two sentences computed from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from statistics import median

from benchmarks.runner import cells, table
from benchmarks.study.claims import DIGITS, MARGIN, resolution_of, worse_than_paper
from benchmarks.study.paper import CORRELATION, L2, MEMORY_GB, MINUTES, NETWORK_LOSS, RESOLUTION, paper_value
from benchmarks.study.plan import METHODS, NOISES, PHANTOMS
from benchmarks.study.results import Results, Row, first_at, listed, scores, slice_scores

WORSE, NOTHING = "▲", "–"
"""Marks of a value less accurate than the paper's, and of a missing one."""

FIRST = (*(("NeRIF", noise) for noise in NOISES), *((m, 0.0) for m in METHODS[1:]))
SECOND = tuple((m, noise) for m in METHODS[1:] for noise in NOISES[1:])
"""Methods and noises of the columns."""

SCORES = {
    "Error of the variation": "{l2_variation:.3%}", "L2": "{l2:.3%}", "CC": "{cc:z.4f}", "SSIM": "{ssim:z.4f}",
}  # fmt: skip
RUN = {"Epochs": "{epochs:.3g}", "Time [s]": "{time:.3g}"}
BOUND = (
    "L2 has the ambient in its denominator, so fields that fill more or less of their box cannot be compared by it; "
    "the paper's flames are not ours. By the correlation they can: whatever scale and offset are given to the "
    "reconstruction, the rms error is √(1 − CC²) of the standard deviation of the truth or more. The paper's are "
    "computed from the four digits of its table."
)


def _table(columns: dict[str, str], rows: Sequence[Row]) -> str:
    return table(list(columns), [cells(columns, row) for row in rows], left=1)


def _accuracy(results: Results) -> list[str]:
    bound = {p: tuple(math.sqrt(1 - cc**2) for cc in row) for p, row in CORRELATION.items()}
    blocks = [
        f"Each cell is *here (paper)*; {WORSE} and bold: less accurate here, at the digits of the paper. The number "
        "after a method is the noise, as a fraction of the rms displacement; the paper has its voxel methods without."
    ]
    for title, name, paper, form in (
        ("Correlation coefficient", "cc", CORRELATION, "z.4f"),
        ("L2 error, |n_gt − n_rec| / |n_gt − 1|", "l2", L2, ".3%"),
        ("Error of the variation, |n_gt − n_rec| / |n_gt − n_ambient|", "l2_variation", {}, ".3%"),
        ("Lower bound of the error from the correlation, √(1 − CC²)", "bound", bound, ".2%"),
    ):
        blocks += [f"### {title}", *([BOUND] if name == "bound" else [])]
        for columns in (FIRST, SECOND):
            head = ["Phantom", *(f"{method} {noise:g}" for method, noise in columns)]
            rows = [
                [p, *(_cell(results.cell(p, n, m), name, paper_value(paper, p, m, n), form) for m, n in columns)]
                for p in PHANTOMS
            ]
            blocks.append(table(head, rows, left=1))
    return blocks


def _cell(row: Row, name: str, paper: float | None, form: str) -> str:
    value = row.get(name)
    if name == "bound" and row.get("cc") is not None:
        value = math.sqrt(1 - row["cc"] ** 2)
    text = "failed" if "failed" in row else NOTHING if value is None else format(value, form)
    if value is not None and paper is not None and name in DIGITS and worse_than_paper(name, value, paper):
        text = f"{WORSE} **{text}**"
    return text if paper is None else f"{text} ({paper:{form}})"


def _slices(results: Results) -> list[str]:
    columns = {"Method and noise": "{label}"}
    for name in ("CC", "SSIM"):
        columns |= {f"{name}, median": f"{{{name}[1]:z.4f}}", f"lowest {name}": f"{{{name}[0]:z.4f}}"}
        columns |= {f"{name} below 0.9": f"{{{name}[2]:.0%}}"}
    rows = []
    for method, noise in (*FIRST, *SECOND):
        row: Row = {"label": f"{method} {noise:g}"}
        for name in ("CC", "SSIM"):
            values = slice_scores(results.cells([method], [noise]).values(), name.lower())
            if values:
                row[name] = min(values), median(values), sum(v < 0.9 for v in values) / len(values)
        rows.append(row)
    text = "Ten slices across z of each of the seven phantoms; the fraction below 0.9 is of all slices that are there."
    return [text, _table(columns, rows)]


def _curves(results: Results) -> list[str]:
    rows = []
    for noise in NOISES:
        row, level = results.cell("2", noise, "NeRIF"), paper_value(L2, "2", "NeRIF", noise)
        point = first_at(row, "l2", level) or {}
        first = {"first_epoch": point.get("epochs"), "first_time": point.get("seconds")}
        rows.append(row | first | {"noise": noise, "paper": level})
    columns = {"Noise": "{noise:g}", "Paper's L2": "{paper:.3%}", "Epochs to it": "{first_epoch:.3g}"}
    columns |= {"Time to it [s]": "{first_time:.3g}", "L2 at the end": SCORES["L2"], **RUN}
    text = (
        "The error is computed twelve times in a run, so the epochs and times at which it is reached are upper bounds; "
        f"{NOTHING}: not reached."
    )
    return [text, _table(columns, rows)]


def _cost(results: Results) -> list[str]:
    rows = []
    for method in METHODS:
        records = list(results.cells([method], [0.0]).values())
        times, sizes = scores(records, "time"), scores(records, "memory")
        minutes, gigabytes = MINUTES.get(method), MEMORY_GB.get(method)
        row: Row = {"label": method, "processor": listed({str(r["processor"]) for r in records if "processor" in r})}
        row["paper"] = NOTHING if not minutes else f"{minutes} min" if minutes < 120 else f"over {minutes / 60:g} h"
        row["paper_memory"] = f"{gigabytes} GB" if gigabytes else NOTHING
        if times and sizes:
            row |= {"time": median(times), "longest": max(times), "memory": median(sizes), "highest": max(sizes)}
        rows.append(row)
    columns = {"Method": "{label}", "Device": "{processor}"}
    columns |= {"Time, median [s]": "{time:.3g}", "longest [s]": "{longest:.3g}", "paper": "{paper}"}
    columns |= {"Memory, median [GB]": "{memory:.3g}", "highest [GB]": "{highest:.3g}", "the paper's": "{paper_memory}"}
    text = (
        "Medians over the seven phantoms without noise. NeRIF's time is the limit that the study sets, not what it "
        "needs: see the error against time. The paper's voxel methods store the matrix of a Monte Carlo integration; "
        "those here integrate along the rays again in every iteration and store none. Memory is that of the whole "
        "process on a CPU, and of tensors on a GPU."
    )
    return [text, _table(columns, rows)]


def _settings(results: Results, section: str) -> list[str]:
    """A row per setting of NeRIF, and the lowest error."""
    rows = list(results.section(section).values())
    blocks = [REMARKS[section], _table({"Setting": "{label}", **SCORES, "Loss": "{loss:.3g}", **RUN}, rows)]
    errors = {row["label"]: row["l2_variation"] for row in rows if row.get("l2_variation") is not None}
    if len(errors) < 2:
        return blocks
    best, *close = (label for label in sorted(errors, key=lambda label: errors[label]))
    worst = close[-1]
    close = [label for label in close if errors[label] <= errors[best] / (1 - MARGIN)]
    text = f"Lowest error: {best}, {errors[best]:.3%}"
    text += f", and within {MARGIN:.0%} of it {listed(close)}" if close else ""
    ratio = errors[worst] / errors[best]
    return [f"{text}; highest: {worst}, {errors[worst]:.3%}, {ratio:.2f} times as much.", *blocks]


def _model(results: Results) -> list[str]:
    forward = results.section("model")["lever_arm"].get("forward") or {}
    columns = {"Model, on the true field": "{label}", "rms difference from curved rays [px]": "{rms_px:.3g}"}
    columns |= {"of the rms displacement": "{relative:.3%}"}
    rows = [{"label": model, **differences} for model, differences in forward.items()]
    text = "Differences of the forward models alone from the curved rays:"
    return [*_settings(results, "model"), text, _table(columns, rows)]


def _resolution(results: Results) -> list[str]:
    columns = {"Method": "{label}", "Resolution, MTF at 10% [lp/unit]": "{value:.2f}", "per mm": "{per_mm:.3g}"}
    columns |= {"Nyquist limit of the pixels [lp/unit]": "{limit:.2f}", "over that limit": "{over:.2f}"}
    rows = []
    for row in results.section("resolution").values():
        if row.get("resolution"):
            value, limit = resolution_of(row), row["pixels_per_unit"] / 2
            row |= {"value": value, "per_mm": value / row["resolution"]["unit_mm"], "limit": limit}
            row["over"] = value / limit
        rows.append(row)
    text = (
        f"The paper has {RESOLUTION} lp/unit, a unit being a quarter of the edge of the box. The pixels sample no line "
        "pair narrower than two of them; a figure beyond that limit (over 1 in the last column) rests on the faces "
        "being plane and many, not on details in the images."
    )
    return [text, _table(columns, rows)]


def _views(results: Results) -> list[str]:
    rows = list(results.section("views").values())
    errors = [(row["label"], row["l2_variation"]) for row in rows if row.get("l2_variation") is not None]
    text = "Phantom 2 at noise 0.1, cameras evenly over 180°; the paper has nine."
    if len(errors) > 1 and errors[0][1] > errors[-1][1]:
        (few, first), (many, last) = errors[0], errors[-1]
        text += f" From {few} to {many} views the error falls by a factor of {first / last:.2g}."
    return [text, _table({"Views": "{label}", **SCORES, **RUN}, rows)]


def _speed(results: Results) -> list[str]:
    rivals = {m: results.cell("2", 0.0, m) for m in METHODS[1:]}
    levels: list[tuple[str, str, float | None]] = [("the paper's L2", "l2", L2["2"][0])]
    levels += [(f"the error of {m}", "l2_variation", row.get("l2_variation")) for m, row in rivals.items()]
    columns = {"NeRIF": "{label}"} | {name: SCORES[name] for name in ("Error of the variation", "L2")}
    for i, (name, _, level) in enumerate(levels):
        columns[f"to {name}{'' if level is None else f' ({level:.3%})'} [s]"] = f"{{to_{i}:.3g}}"
    rows = []
    for row in results.section("speed").values():
        points = [first_at(row, name, level) for _, name, level in levels]
        rows.append(row | {f"to_{i}": point["seconds"] for i, point in enumerate(points) if point})
    times = listed(f"{m} {row['time']:.3g} s" for m, row in rivals.items() if row.get("time") is not None)
    text = (
        "Phantom 2 without noise. Upper bounds: the error is computed twelve times in a run. The learning rate falls "
        f"with the time that a run has, so that a shorter run ends below the curve of this one. {NOTHING}: not reached."
    )
    return [text + (f" The classical methods took: {times}." if times else ""), _table(columns | RUN, rows)]


SETTING = "Phantom 2 at noise 0.1; each run changes only this, and has the same limits of time and steps."
REMARKS = {
    "network": f"{SETTING} The paper has mean losses of {NETWORK_LOSS['multi-head']} (multi-head) and "
    f"{NETWORK_LOSS['plain']} (plain). Losses of different terms cannot be compared; the error decides here.",
    "encoding": f"{SETTING} N is the number of octaves; the paper has this as a figure only.",
    "sampling": f"{SETTING} Random: one draw in every interval (the paper's); shifted: one draw a ray; regular: none.",
    "differentiation": SETTING,
    "model": "Phantom 2 without noise; it was simulated along curved rays.",
}
TEXTS: dict[str, Callable[[Results], list[str]]] = {
    **{section: partial(_settings, section=section) for section in REMARKS},
    "tables": _accuracy,
    "slices": _slices,
    "curves": _curves,
    "cost": _cost,
    "model": _model,
    "resolution": _resolution,
    "views": _views,
    "speed": _speed,
}
"""Blocks of each section without its heading and figures."""
