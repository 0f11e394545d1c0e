"""A reconstruction beside the main one, in a directory of its own: done once, gone on with where it was broken off."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from nerif.common.conventions import InputError
from nerif.common.files import atomic
from nerif.data.measurement import Measurement
from nerif.fields.base import Field
from nerif.reconstruction.base import OnStep, Outcome, Reconstruction, Reconstructor, State, Step, compose
from nerif.reconstruction.files import CHECKPOINT, FIELD, checkpoints, fingerprint, write_state
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.results.directory import ResultDirectory

__all__ = ["KeptRun"]

ASKED = "asked.json"


@dataclass(frozen=True)
class KeptRun:
    """One reconstruction and its directory; whatever is in there of other settings or data is done again.

    Parameters
    ----------
    directory : of its own, in which only what this program wrote is replaced
    reconstructor : settings
    data : what is reconstructed
    start : field to begin from, or None
    made_of : what else it depends on
    checkpoint_every : seconds
    monitor : told how the work goes
    afresh : whatever is there
    free : names of settings that it may be gone on with others of
    """

    directory: ResultDirectory
    reconstructor: Reconstructor
    data: Measurement
    start: Field | None = None
    made_of: Mapping[str, str] = field(default_factory=dict)
    checkpoint_every: float = 60.0
    monitor: Monitor = QUIET
    afresh: bool = False
    free: tuple[str, ...] = ()

    @property
    def begun(self) -> bool:
        """Whether there is something of it to read or to go on with."""
        asked = self.directory / ASKED
        if self.afresh or not asked.is_file():
            return False
        return asked.read_text() == self._asked and (self._has(FIELD) or self._has(CHECKPOINT))

    def __call__(self, title: str, *callbacks: OnStep) -> Reconstruction:
        """Read it if it is there, else reconstruct; what an interruption leaves is gone on with the next time.

        Parameters
        ----------
        title : of the work, for the monitor
        callbacks : told every step
        """
        state: State | None = None
        if self.begun:
            try:
                if self._has(FIELD):
                    return self._read()
                state = self.directory.state()
            except InputError as error:
                self.monitor.say(f"{error}; {title} is done again")
        with self.monitor.training(title) as told:
            keep = checkpoints(self.directory.path, self.checkpoint_every)
            steps = compose(*callbacks, self._noted(state is not None), told, keep)
            result = self.reconstructor(self.data, steps, state, self.start if state is None else None)
        if result.outcome.reason == "interrupted":
            if result.state is not None:
                write_state(self.directory.path, result.state)
        elif not result.outcome.failed:
            self.directory.write_field(dataclasses.replace(result, state=None))
            self.directory.files.remove([CHECKPOINT])
        return result

    def _has(self, name: str) -> bool:
        return self.directory.has(name)

    def _read(self) -> Reconstruction:
        settings = dataclasses.asdict(self.reconstructor)  # type: ignore[call-overload]
        kept = Outcome("converged", "read from disc")
        return Reconstruction(*self.directory.field(), [], kept, settings, quantity=self.directory.quantity())

    def _noted(self, resumed: bool) -> OnStep:
        """Note at the first step what is asked for, in a directory without anything of an earlier run."""
        done: list[bool] = [resumed]

        def note(step: Step) -> None:
            if not done[0]:
                self.directory.files.remove()
                self.directory.path.mkdir(parents=True, exist_ok=True)
                with self.directory.writing(ASKED) as path, atomic(path) as part:
                    part.write_text(self._asked)
                done[0] = True

        return note

    @property
    def _asked(self) -> str:
        """What it is made by and from, as text: another one of either gives another text."""
        settings = dataclasses.asdict(self.reconstructor)  # type: ignore[call-overload]
        settings = {name: value for name, value in settings.items() if name not in self.free}
        asked = {"data": fingerprint(self.data), **self.made_of, **settings}
        return json.dumps(asked, indent=1, default=str) + "\n"
