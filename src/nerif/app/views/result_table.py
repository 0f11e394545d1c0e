"""Table of the results of a project: verdict, errors, outcome of the run."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from html import escape

from nicegui import ui

from nerif.analysis.evaluation import rms_with_unit
from nerif.analysis.verdict import verdict
from nerif.app.forms.elements import html
from nerif.app.project.folder import Contents, ProjectFolder
from nerif.common.conventions import InputError
from nerif.data.velocity_sequence import VelocitySequence, open_volumes
from nerif.reconstruction.field_files import FIELD
from nerif.reconstruction.reconstructor import END
from nerif.report.summary import accuracy_rows
from nerif.report.volume_movie import finished_frames
from nerif.results.directory import LIVE, METRICS, RUN, VOLUME, Result, ResultDirectory
from nerif.results.metrics_file import Metrics

__all__ = ["Row", "result_table", "rows_of"]

HEAD = ("Name", "Method", "Verdict", "Estimated error", "Views, worst rms", "Why it ended", "Time of the fit", "Ended")
CLASSES = {"use": "good", "use with care": "care", "do not use": "bad"}


@dataclass(frozen=True)
class Row:
    """One result or film."""

    name: str  #: relative to the project
    title: str  #: name for display
    cells: tuple[str, ...]  #: cells of the table after the name
    word: str  #: verdict in short
    sentence: str  #: verdict in full, or the missing data
    figures: tuple[tuple[str, str], ...]  #: names and values of the error estimates
    film: bool = False  #: whether it is a store over time


def rows_of(project: ProjectFolder, contents: Contents) -> list[Row]:
    """Return the rows of the results and then those of the films."""
    rows = [_row_of_result(project, name) for name in contents.results]
    return rows + [row for name in contents.films if (row := _row_of_film(project, name)) is not None]


def _row_of_result(project: ProjectFolder, name: str) -> Row:
    """The row of a result, cached until the newest of its files changes."""
    out = ResultDirectory(project.path(name))
    last = max(filter(out.has, (METRICS, FIELD, RUN, LIVE, VOLUME)), key=lambda n: (out / n).stat().st_mtime_ns)
    return project.from_cache(f"{name}/{last}", "row", lambda _: _of(name, project.title(name), out.read(views=False)))


def _of(name: str, title: str, result: Result) -> Row:
    judgement, metrics = verdict(result), result.metrics
    views = [v for v in metrics.views if math.isfinite(v["rms"])]
    worst = rms_with_unit(max(views, key=lambda v: v["rms"]), 3) if views else ""
    outcome = str(metrics.outcome or result.about.get("outcome") or "not ended")
    seconds = metrics.seconds if metrics.seconds is not None else result.about.get("seconds")
    error = "" if judgement.error is None else f"{judgement.error:.1%} of the variation"
    ended, word, sentence = metrics != Metrics(), judgement.rating, judgement.sentence
    if not ended:
        word, sentence = "", " ".join(gap.sentence for gap in result.missing) or "No data yet."
    time = "" if seconds is None else f"{float(seconds):.0f} s"
    cells = (result.method, word, error, worst, END.get(outcome, outcome), time, str(result.about.get("finished", "")))
    return Row(name, title, cells, word, sentence, tuple(accuracy_rows(result)) if ended else ())


def _row_of_film(project: ProjectFolder, name: str) -> Row | None:
    """The row of a film, None for a store of measurements."""
    try:
        store = open_volumes(project.path(name))
    except InputError:
        return None
    count, done = len(store), len(finished_frames(store))
    span = f"{store.times[0]:.10g} to {store.times[-1]:.10g} s" if count else ""
    outcome = "complete" if done == count else f"{done} of {count} frames"
    grid = " × ".join(str(n) for n in store.grid.shape[::-1])
    figures = (("Frames", f"{done} of {count}"), ("Time", span), ("Voxels", f"{grid} (x, y, z)"))
    kind = "velocity" if isinstance(store, VelocitySequence) else "film"
    cells = (f"{kind}, {count} frames", "", "", "", outcome, span, "")
    return Row(name, project.title(name), cells, "", f"{done} of {count} frames are complete.", figures, film=True)


def result_table(rows: Sequence[Row], selection: str, choose: Callable[[str], Awaitable[None]]) -> None:
    """Build the table, with a button per row that selects it."""
    around = ui.element("div").classes("tabled").props('tabindex=0 role=region aria-label="Results"')
    with around, ui.element("table"):
        html(f"<tr>{''.join(f'<th scope=col>{escape(title)}</th>' for title in HEAD)}</tr>", "thead")
        with ui.element("tbody"):
            for row in rows:
                active = row.name == selection
                with ui.element("tr").classes("chosen" if active else ""):
                    with ui.element("th").props("scope=row"):
                        button = ui.button(row.title, on_click=lambda name=row.name: choose(name))
                        button.props("flat dense align=left").props.update(
                            {"aria-label": f"Show {row.title}", "aria-pressed": "true" if active else "false"}
                        )
                    for title, cell in zip(HEAD[1:], row.cells, strict=True):
                        verdict_class = f"verdict {CLASSES.get(row.word, '')}" if title == "Verdict" and cell else ""
                        html(escape(cell), "td").classes(verdict_class)
