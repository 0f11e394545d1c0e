"""Queue of runs of `nerif ...` on disk, which survives a restart of the server.

Each run has a folder in FOLDER/.nerif/jobs with job.json (the request), log.txt, and started.json and ended.json of its
process (runner.py). A server starts the runs that were queued with it. Those of an earlier server, or of a folder from
another user, are held: listed with their command line until they are started by hand.

    held ─▶ queued ─▶ running ─▶ done | failed | stopped
                         │
                         └─▶ paused ─▶ queued ...      stopped, then continued: nerif reconstruct by --resume, nerif
                                                      sequence by the same command, which adds the missing frames
"""

from __future__ import annotations

import json
import secrets
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from nerif.app.project.folder import OWN
from nerif.app.project.runner import ENDED, JOB, LOG, STARTED, began
from nerif.common.conventions import InputError
from nerif.common.files import read_json, write_json
from nerif.common.installation import command_line
from nerif.common.interruption import interrupt
from nerif.results.directory import RUN

__all__ = ["OPEN", "CommandRun", "Jobs"]

LIMIT = 64  # simultaneous runs
RESUMABLE = ("reconstruct", "sequence")
OPEN = ("running", "queued", "held", "paused")


@dataclass(frozen=True)
class CommandRun:
    """One run."""

    id: str  #: name of its folder; sorts by time
    title: str  #: title for display
    arguments: tuple[str, ...]  #: arguments of nerif, the verb first
    attempt: tuple[str, ...]  #: arguments of the present start; after a pause these differ, e.g. by --resume
    out: str = ""  #: result directory relative to the folder; empty if the run writes none
    request: str = ""  #: "", "stop" or "pause"
    place: float = 0.0  #: sort key in the queue
    state: str = "queued"  #: held, queued, running, paused, done, failed or stopped
    pid: int = 0  #: process id while it runs
    code: int | None = None  #: exit code after the end
    started: float = 0.0  #: seconds since 1970, 0 before
    ended: float = 0.0  #: seconds since 1970, 0 before

    @property
    def line(self) -> str:
        """The command line of the present start."""
        return command_line(self.attempt)

    @property
    def file(self) -> str:
        """The output file in its arguments; empty if there is none."""
        return next((b for a, b in pairwise(self.arguments) if a in ("-o", "--out")), "")

    @property
    def resumable(self) -> bool:
        """Whether it can be paused: stopped and continued later."""
        return self.arguments[0] in RESUMABLE and bool(self.out)


ENTRIES: dict[str, Any] = {
    "id": str, "title": str, "arguments": list, "attempt": list, "out": str, "request": str, "place": int | float,
}  # fmt: skip


class Jobs:
    """The runs of a project.

    Parameters
    ----------
    folder : folder of the project
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.directory = folder, folder / OWN / "jobs"
        self._own: dict[str, subprocess.Popen[bytes] | None] = {}  # runs queued here, by their process once started

    # -- state ---------------------------------------------------------------------------------------------------

    def all(self) -> list[CommandRun]:
        """Return all runs: open ones in the order of the queue, then ended ones, latest first."""
        jobs = [job for job in map(self._read, self._names()) if job is not None]
        open_ = sorted((j for j in jobs if j.state in OPEN), key=lambda j: (OPEN.index(j.state), j.place))
        return open_ + sorted((j for j in jobs if j.state not in OPEN), key=lambda j: j.ended, reverse=True)

    def get(self, id: str) -> CommandRun:
        """Return one run; InputError if there is none with this id."""
        job = self._read(id) if id in self._names() else None
        if job is None:
            raise InputError(f"expected one of {', '.join(self._names()) or 'none'}, got '{id}'", field="job")
        return job

    def log(self, id: str, lines: int = 200) -> list[str]:
        """Return the last lines of the log of a run."""
        path = self._of(self.get(id)) / LOG
        if not path.is_file():
            return []
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - 200 * lines))
            return file.read().decode("utf-8", "replace").splitlines()[-lines:]

    def _names(self) -> list[str]:
        if not self.directory.is_dir():
            return []
        return sorted(p.name for p in self.directory.iterdir() if (p / JOB).is_file())

    def _of(self, job: CommandRun) -> Path:
        return self.directory / job.id

    def _read(self, name: str) -> CommandRun | None:
        """Return a run and its state; None if its folder is damaged or being removed."""
        where = self.directory / name
        entries = {k: v for k, v in _json(where / JOB).items() if k in ENTRIES}
        if not _is_job(entries) or entries["id"] != name:
            return None
        job = CommandRun(**{**entries, "arguments": tuple(entries["arguments"]), "attempt": tuple(entries["attempt"])})
        started, ended = _json(where / STARTED), _json(where / ENDED)
        if ended:
            job = replace(job, code=int(ended["code"]), started=started.get("time", 0.0), ended=ended["time"])
            over = {"pause": "paused", "stop": "stopped"}.get(job.request, "done")
            if job.code and job.arguments[0] != "sequence":  # nerif sequence always ends with a code after Ctrl-C
                over = "stopped"
            return replace(job, state=over if job.request or not job.code else "failed")
        if started:
            job, process = replace(job, started=started["time"], pid=int(started["pid"])), self._own.get(name)
            if began(job.pid) == str(started["began"]) or (process is not None and process.poll() is None):
                return replace(job, state="running")
            return replace(job, state="stopped" if job.request else "failed", ended=(where / STARTED).stat().st_mtime)
        if job.request:
            return replace(job, state="stopped")
        if name not in self._own:
            return replace(job, state="held")
        return replace(job, state="queued" if self._own[name] is None else "running")

    # -- requests ------------------------------------------------------------------------------------------------

    def add(self, arguments: Sequence[str], title: str, out: str = "") -> CommandRun:
        """Put a run at the end of the queue.

        Parameters
        ----------
        arguments : arguments of nerif, the verb first; paths relative to the folder of the project
        title : title for display
        out : result directory, relative to the folder
        """
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
        words = tuple(str(word) for word in arguments)
        job = CommandRun(name, title, words, words, str(out), place=time.time())
        self._of(job).mkdir(parents=True)
        self._own[name] = None
        self._write(job)
        return job

    def stop(self, id: str) -> None:
        """Stop a run and keep its present result; a second call aborts it, and a queued run never starts."""
        self._request(id, "stop")

    def pause(self, id: str) -> None:
        """Stop a run that can be continued later; InputError for others."""
        if not self.get(id).resumable:
            raise InputError(
                f"only nerif {' and '.join(RESUMABLE)} can be paused; stop it and start it again", field=f"job {id}"
            )
        self._request(id, "pause")

    def start(self, id: str) -> None:
        """Queue a held run with this server."""
        if self.get(id).state == "held":
            self._own[id] = None

    def resume(self, id: str) -> None:
        """Queue an ended run again, from its checkpoint if there is one."""
        job = self.get(id)
        if job.state in ("queued", "running"):
            return
        attempt = job.arguments
        if job.arguments[0] == "sequence":
            attempt = tuple(word for word in attempt if word != "--force")
        elif job.resumable and (self.folder / job.out / RUN).is_file():
            attempt = (job.arguments[0], "--resume", "--out", job.out, *(("--live",) if "--live" in attempt else ()))
        self._write(replace(job, attempt=attempt, request="", place=time.time()))
        self._own[id] = None
        for name in (STARTED, ENDED):  # the run is queued once both are removed
            (self._of(job) / name).unlink(missing_ok=True)

    def move(self, id: str, by: int) -> None:
        """Move a queued run by some places, at most to an end of the queue."""
        queue = [job for job in self.all() if job.state == "queued"]
        at = next((i for i, job in enumerate(queue) if job.id == id), None)
        if at is None:
            return
        places = [job.place for job in queue]
        queue.insert(max(at + by, 0), queue.pop(at))
        for job, place in zip(queue, places, strict=True):
            if job.place != place:
                self._write(replace(job, place=place))

    def remove(self, id: str) -> None:
        """Remove a run from the list, not its output; InputError while it runs."""
        job = self.get(id)
        if job.state == "running":
            raise InputError("the run is in progress; stop it first", field=f"job {id}")
        shutil.rmtree(self._of(job))

    @property
    def at_once(self) -> int:
        """Number of simultaneous runs."""
        count = _json(self.directory / "settings.json").get("at_once")
        return count if isinstance(count, int) and 1 <= count <= LIMIT else 1

    @at_once.setter
    def at_once(self, count: int) -> None:
        if not 1 <= count <= LIMIT:
            raise InputError(f"expected 1 to {LIMIT} runs at the same time, got {count}", field="at_once")
        self.directory.mkdir(parents=True, exist_ok=True)
        write_json(self.directory / "settings.json", {"at_once": int(count)})

    def _request(self, id: str, request: str) -> None:
        job = self.get(id)
        if job.state not in OPEN:
            return
        self._write(replace(job, request=request))
        now = self._read(id)  # it may have started meanwhile; one that starts later reads the request
        if job.state == "running" and now is not None and now.state == "running" and now.pid:
            interrupt(now.pid)

    def _write(self, job: CommandRun) -> None:
        write_json(self._of(job) / JOB, {name: value for name, value in asdict(job).items() if name in ENTRIES})

    # -- the queue -----------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Start queued runs up to the number of simultaneous runs."""
        jobs = self.all()
        free = self.at_once - sum(job.state == "running" for job in jobs)
        for job in [job for job in jobs if job.state == "queued"][: max(free, 0)]:
            self._launch(job)

    def _launch(self, job: CommandRun) -> None:
        where = self._of(job)
        with (where / LOG).open("ab") as log:  # the runner prints why it could not start the run
            runner = self._own[job.id] = subprocess.Popen(
                [sys.executable, "-P", "-m", "nerif.app.project.runner", str(where), *job.attempt],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True,
            )  # fmt: skip

        def wait() -> None:
            code = runner.wait()
            if code and not (where / STARTED).exists():
                write_json(where / ENDED, {"code": code, "time": time.time()})

        threading.Thread(target=wait, daemon=True).start()


def _is_job(entries: Mapping[str, Any]) -> bool:
    """Return whether the entries of a job.json are complete and of the right types."""
    if set(entries) != set(ENTRIES) or not all(isinstance(entries[name], kind) for name, kind in ENTRIES.items()):
        return False
    return all(words and all(isinstance(w, str) for w in words) for words in (entries["arguments"], entries["attempt"]))


def _json(path: Path) -> dict[str, Any]:
    """Return the entries of a JSON file; none if it is missing, damaged or incomplete."""
    try:
        content = read_json(path)
        json.dumps(content, ensure_ascii=False).encode()  # half a surrogate pair cannot be displayed
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
