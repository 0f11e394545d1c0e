"""Reconstruct: settings of a run, the queue, and the run as it goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from html import escape
from pathlib import Path, PurePosixPath
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import CommandLine, FileChoice, card, html, refusals, select, text_html
from nerif.app.forms.form import Form
from nerif.app.forms.form_view import FormView
from nerif.app.pages.page import Hint, Page
from nerif.app.project.workspace import Workspace
from nerif.app.views.live_view import LiveView
from nerif.cli.commands.reconstruct import Reconstruct, command_of
from nerif.cli.commands.sequence import Sequence
from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.installation import word_of
from nerif.common.settings import MISSING
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.reconstruction.methods import METHODS
from nerif.reconstruction.neural.presets import PRESETS, preset
from nerif.reconstruction.progress import Monitor
from nerif.results.directory import VOLUME, ResultDirectory
from nerif.workflow.reconstruction_run import ReconstructionRun

__all__ = ["PAGE"]

WITHOUT = ("config", "measurement", "out", "method", "preset", "force", "resume", "live", "known")
MAIN = ("time_limit", "withhold", "uncertainty", "voxels")
FILM = ".zarr"
EVERY = 1.0  # seconds
NO_MEASUREMENT = "No measurement in this folder yet: nerif displacement or nerif simulate makes one."
VALUES = {False: "values", True: "film_values"}  # key of the settings in the draft: of one instant, of a film
FILM_WITHOUT = ("config", "measurement", "out", "preset", "force", "time_limit", "refine", "known")
FILM_MAIN = ("cluster", "workers", "chunk", "withhold", "voxels")


def titles() -> dict[str, str]:
    """Return the titles of the methods by name."""
    return {name: kind.title[:1].upper() + kind.title[1:] for name, kind in METHODS.items()}


def form_of(method: str, preset_name: str) -> Form[Reconstruct]:
    """Return the form of a method; the defaults of NeRIF are those of its preset."""
    record = command_of(method)(measurement=MISSING, out=MISSING, method=method)
    if method == "nerif":
        record = replace(record, reconstructor=preset(preset_name), preset=preset_name)  # type: ignore[call-arg]
    return Form(record, without=WITHOUT)


def form_of_film(preset_name: str) -> Form[Sequence]:
    """Return the form of a film: where its frames are reconstructed, and how."""
    record = Sequence(MISSING, MISSING, preset=preset_name, reconstructor=preset(preset_name))
    return Form(record, without=FILM_WITHOUT)


def prepare(path: Path, out: Path, settings: Reconstruct, say: Callable[[str], None]) -> None:
    """Check the input of a run, which writes nothing, and say what the run would say at its start."""
    directory, voxels = ResultDirectory(out), getattr(settings, "voxels", None)
    ReconstructionRun.plan(directory, path, settings.reconstructor, settings.run, voxels, monitor=Monitor(say))


class ReconstructPage:
    """The page in one tab."""

    def __init__(self, work: Workspace, measurements: Iterable[str]) -> None:
        self.work, draft = work, work.draft(PAGE.name)
        self.values: dict[str, dict[str, Any]] = {name: dict(draft.get(name, {})) for name in VALUES.values()}
        with ui.element("div").classes("columns"):
            with card("A run"), ui.element("div").classes("form"):
                note = text_html(NO_MEASUREMENT, classes="note")
                name = draft.get("measurement")
                self.measurement = FileChoice(
                    "Measurement", tuple(measurements), name, lambda: _measurements(work), self._on_choice
                )
                note.bind_visibility_from(self.measurement.select, "options", lambda names: not names)
                self.method = self._select("Method", titles(), draft.get("method", "nerif"))
                self.about = html().classes("help")
                self.preset = self._select("Preset", ["auto", *PRESETS], draft.get("preset", "auto"))
                self.out = ui.input("Result directory", value=self._free_name())
                self.out.on_value_change(self._show)
                self.place = ui.element("div").classes("form")
                self.notes = html().props('role=status aria-live="polite"')
                self.start = ui.button("Start", icon="play_arrow", on_click=self._start).props("unelevated")
            with ui.element("div").classes("stack"):
                with card("The same on the command line"):
                    self.command = CommandLine()
                self.live = LiveView(work)
        self._build_form()
        self._noted: list[str] = []  # arguments of the notes that are shown
        ui.timer(EVERY, self._note)

    async def _note(self) -> None:
        """Show what the run would say of its settings before it starts, such as that its time limit is too short."""
        arguments = self.arguments()
        if arguments == self._noted or self.film or not (self.start.enabled and self.measurement.name):
            return
        self._noted = arguments
        lines: list[str] = []
        with refusals(lines.append):
            path, out = (self.work.project.path(name) for name in (self.measurement.name, self.out.value))
            await self.work.in_thread(prepare, path, out, self.view.record(), lines.append)
        if arguments == self.arguments():
            self.notes.set_content("".join(f"<p class=note>{escape(line)}</p>" for line in lines))

    def _select(self, label: str, options: Any, value: Any) -> ui.select:
        return select(label, options, value).on_value_change(self._on_choice)

    def _on_choice(self) -> None:
        if hasattr(self, "live"):
            self.out.set_value(self._free_name())
            self._build_form()

    @property
    def film(self) -> bool:
        """Whether the selected measurement is a film."""
        return ending(self.measurement.name) == FILM

    def _free_name(self) -> str:
        stem = PurePosixPath(self.measurement.name or "run").stem
        name = f"results/{stem}{FILM if self.film else f'-{self.method.value}'}"
        return self.work.project.free_name(name, [job.out for job in self.work.jobs.all()])

    def _build_form(self) -> None:
        method, preset = self.method.value, self.preset.value
        form: Form[Any] = form_of_film(preset) if self.film else form_of(method, preset)
        self.method.set_visibility(not self.film)
        self.about.set_visibility(not self.film)
        self.about.set_content(f"<p>{escape(METHODS[method].about())}</p>")
        self.preset.set_visibility(self.film or method == "nerif")
        self.out.props["label"] = "Result (.zarr)" if self.film else "Result directory"
        self.place.clear()
        names = {f.name for f in form.fields}
        main = [name for name in (FILM_MAIN if self.film else MAIN) if name in names]
        with self.place:
            self.view = FormView(form, self._show, self.values[VALUES[self.film]], main)
        self._show()

    def arguments(self) -> list[str]:
        """Return the arguments of nerif that the page is set to."""
        verb = "sequence" if self.film else "reconstruct"
        words = [verb, self.measurement.name or "MEASUREMENT.nc", "--out", word_of(self.out.value or "OUT")]
        if not self.film and self.method.value != "nerif":
            words += ["--method", self.method.value]
        elif self.preset.value != "auto":
            words += ["--preset", self.preset.value]
        return [*words, *self.view.arguments, *([] if self.film else ["--live"])]

    def _show(self) -> None:
        self.values[VALUES[self.film]] = dict(self.view.values)
        draft = {"measurement": self.measurement.name, "method": self.method.value, "preset": self.preset.value}
        self.work.keep(PAGE.name, {**draft, **self.values})
        self.command.show(self.arguments())
        self.start.set_enabled(bool(self.measurement.name and self.out.value) and self.view.valid)

    def _start(self) -> None:
        with refusals():
            self.view.record()
            self.work.project.path(self.measurement.name)
            out = self.work.project.relative(self.out.value)
            job = self.work.jobs.add(self.arguments(), f"{self.measurement.name} → {out}", out)
            (self.work.project.folder / out).parent.mkdir(parents=True, exist_ok=True)
            self.out.set_value(self._free_name())
            self.live.follow(job.id)


async def build(work: Workspace) -> None:
    """Build the page."""
    ReconstructPage(work, await _measurements(work))


async def _measurements(work: Workspace) -> tuple[str, ...]:
    """What can be reconstructed: measurements, and films of them."""
    result = await work.contents()
    films = [name for name in result.films if await work.in_thread(_has_measurements, work, name)]
    return (*result.measurements, *films)


def _has_measurements(work: Workspace, name: str) -> bool:
    try:
        read = work.project.from_cache
        return read(f"{name}/zarr.json", "measured", lambda path: len(MeasurementSequence.read(path.parent)) > 0)
    except (FileNotFoundError, InputError):  # just being made, or none of ours
        return False


ABOUT = "The field that explains a measurement, shown while the run improves it."
HINT = Hint(
    "Fits a field of refractive index to all views at once.",
    "Fill in the values: few steps, and no withheld view, to save time. Press Start. It takes about a minute.",
    "The loss falls, the predicted view approaches the measured one, and the isosurface becomes a flame.",
    before="displacement",
    values={
        "reconstruct": {
            "method": "nerif",
            "preset": "fast",
            "values": {"max_steps": 250, "withhold": ["none"], "voxels": 40},
        }
    },
    done=lambda work: any((work.project.folder / name / VOLUME).is_file() for name in work.project.contents().results),
)
PAGE = Page("reconstruct", "Reconstruct", ABOUT, build, HINT)
