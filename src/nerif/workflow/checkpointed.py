"""A reconstruction beside the main one, in a directory of its own: not repeated if complete, resumed if interrupted."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

from nerif.common.conventions import InputError
from nerif.common.files import atomic
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.reconstruction.field_files import CHECKPOINT, FIELD, checkpoints, digest_of_field, fingerprint, write_state
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.reconstructor import OnStep, Outcome, Reconstruction, Reconstructor, State, Step, compose
from nerif.results.directory import ResultDirectory

__all__ = ["CheckpointedRun"]

INPUTS = "inputs.json"


@dataclass(frozen=True)
class CheckpointedRun:
    """A reconstruction and its directory; content of other settings or data is replaced."""

    directory: ResultDirectory  #: of its own
    reconstructor: Reconstructor  #: settings
    data: Measurement  #: to reconstruct from
    start: Field | None = None  #: initial field, or None
    checkpoint_every: float = 60.0  #: s
    monitor: Monitor = QUIET  #: of the progress
    restart: bool = False  #: whether to ignore the content of the directory
    limits: tuple[str, ...] = ()  #: names of settings that may differ when a run is resumed, beside the time limit

    @property
    def resumable(self) -> bool:
        """Whether the directory has a field or a checkpoint of the same inputs."""
        path = self.directory / INPUTS
        if self.restart or not path.is_file() or path.read_text(encoding="utf-8") != self._inputs:
            return False
        return self.directory.has(FIELD) or self.directory.has(CHECKPOINT)

    def __call__(self, title: str, *callbacks: OnStep) -> Reconstruction:
        """Read the result, or reconstruct; `title` is that of the progress, `callbacks` are called after each step."""
        state: State | None = None
        if self.resumable:
            try:
                if self.directory.has(FIELD):
                    return self.read()
                state = self.directory.state()
            except InputError as error:
                self.monitor.say(f"{error}; {title} is repeated")
        with self.monitor.training(title) as progress:
            checkpoint = checkpoints(self.directory.path, self.checkpoint_every)
            begin = [self._begin] if state is None else []
            on_step = compose(*callbacks, *begin, progress, checkpoint)
            result = self.reconstructor(self.data, on_step, state, self.start if state is None else None)
        if result.outcome.reason == "interrupted":
            if result.state is not None:
                write_state(self.directory.path, result.state)
        elif not result.outcome.failed:
            self.directory.write_field(dataclasses.replace(result, state=None))
            self.directory.files.remove([CHECKPOINT])
        return result

    def read(self) -> Reconstruction:
        """Return the result that the directory holds."""
        settings = dataclasses.asdict(self.reconstructor)  # type: ignore[call-overload]
        outcome = Outcome("converged", "read from disk")
        field, box, n_ambient = self.directory.field()
        quantity, bodies = self.directory.quantity(), self.data.bodies
        return Reconstruction(
            field, box, n_ambient, [], outcome, settings, quantity=quantity, rig=self.directory.rig(), bodies=bodies
        )

    def _begin(self, step: Step) -> None:
        """Clear the directory at the first step of a new run, and write its inputs."""
        if not self.directory.begun:
            self.directory.files.remove()
            self.directory.path.mkdir(parents=True, exist_ok=True)
            with self.directory.writing(INPUTS) as path, atomic(path) as part:
                part.write_text(self._inputs, encoding="utf-8")
            self.directory.begun = True

    @property
    def _inputs(self) -> str:
        """Settings, data and initial field as text."""
        settings = dataclasses.asdict(self.reconstructor)  # type: ignore[call-overload]
        settings = {name: value for name, value in settings.items() if name not in (*self.limits, "time_limit")}
        start = None if self.start is None else digest_of_field(self.start)
        inputs = {"data": fingerprint(self.data, refine=settings.get("refine", ())), "start": start, **settings}
        return json.dumps(inputs, indent=1, default=str) + "\n"
