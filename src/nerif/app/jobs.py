"""Runs of `nerif ...`, one after the other: a queue on disk, which a server that is started again finds as it was.

Each run has a folder of its own in FOLDER/.nerif/jobs with job.json (the request), log.txt, and what its process
writes down: started.json and ended.json (runner.py). State is nowhere else. The name of an empty file says whose the
run is: `waiting`, and once a server has started a process for it, runner-PID-TIME of that process. Renaming it is the
claim, which one server alone can make. Where that process has gone before the run began, the run waits again.

A folder, with runs in it, may come from another person. job.json is signed with a secret of the user (private.py);
what is not, or was changed, or was signed for another folder, is refused: it is shown, and never started.

    queued ─▶ running ─▶ done | failed | stopped
                 │
                 └─▶ paused ─▶ queued ...          stopped, and gone on with: nerif reconstruct by --resume, nerif
                                                  sequence by the same line, which does what is missing
"""

from __future__ import annotations

import hmac
import json
import os
import secrets
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from nerif.app.private import secret
from nerif.app.project import OWN
from nerif.app.runner import ENDED, JOB, LOG, STARTED
from nerif.common.conventions import InputError
from nerif.common.files import write_json
from nerif.results.directory import RUN

__all__ = ["REFUSED", "Job", "Jobs", "command_line"]

WAITING, OWNER = "waiting", "runner-"
CLOCK = 1.5  # seconds by which two readings of when a process was started may differ
MOST = 64  # runs at the same time
RESUMABLE = ("reconstruct", "sequence")
OVER = ("done", "failed", "stopped", "refused")
REFUSED = (
    "You did not put it into the queue of this folder, or it was changed, or the folder was moved. It is not started; "
    "start the run again from its page."
)
"""What is said of a run without a valid signature."""


def command_line(arguments: Sequence[str]) -> str:
    """Return the line that does the same in a shell, in the folder of the project."""
    return shlex.join(["nerif", *arguments])


@dataclass(frozen=True)
class Job:
    """One run.

    Parameters
    ----------
    id : name of its folder; sorts by time
    title : what it is, for people
    arguments : of nerif, the verb first
    attempt : those of the present start: of a run that is gone on with, other ones
    out : what it writes, relative to the folder; empty if that is no result directory
    request : "", "stop" or "pause"
    place : in the queue
    state : queued, running, paused, done, failed, stopped or refused
    pid : of its process while it runs
    code : exit code once it has ended
    started, ended : seconds since the epoch, 0 if not yet
    """

    id: str
    title: str
    arguments: tuple[str, ...]
    attempt: tuple[str, ...]
    out: str = ""
    request: str = ""
    place: float = 0.0
    state: str = "queued"
    pid: int = 0
    code: int | None = None
    started: float = 0.0
    ended: float = 0.0

    @property
    def line(self) -> str:
        """The command line of its present start."""
        return command_line(self.attempt)

    @property
    def file(self) -> str:
        """The file that its line says it writes; empty if it names none."""
        return next((b for a, b in pairwise(self.arguments) if a in ("-o", "--out")), "")

    @property
    def resumable(self) -> bool:
        """Whether it can be paused: stopped, and gone on with later."""
        return self.arguments[0] in RESUMABLE and bool(self.out) and self.state != "refused"


KEPT: dict[str, type | tuple[type, ...]] = {
    "id": str, "title": str, "arguments": list, "attempt": list, "out": str, "request": str, "place": (int, float),
}  # fmt: skip
SIGNATURE = "signature"


class Jobs:
    """The runs of a project.

    Parameters
    ----------
    folder : of the project

    Raises
    ------
    InputError
        If there is no secret to sign with (private.py).
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.directory = folder, folder / OWN / "jobs"
        self._secret = secret()

    # -- what there is -------------------------------------------------------------------------------------------

    def all(self) -> list[Job]:
        """Return all runs: what waits and runs in the order of the queue, then what has ended, the last one first."""
        outcome = [job for job in map(self._read, self._names()) if job is not None]
        open_, over = ("running", "queued", "paused"), [j for j in outcome if j.state in OVER]
        return sorted((j for j in outcome if j.state in open_), key=lambda j: (open_.index(j.state), j.place)) + sorted(
            over, key=lambda j: j.ended, reverse=True
        )

    def get(self, id: str) -> Job:
        """Return one run.

        Raises
        ------
        InputError
            If there is none of that name.
        """
        job = self._read(id) if id in self._names() else None
        if job is None:
            raise InputError(f"expected one of {', '.join(self._names()) or 'none'}, got '{id}'", field="job")
        return job

    def log(self, id: str, lines: int = 200) -> list[str]:
        """Return the last lines that a run has printed."""
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

    def _of(self, job: Job) -> Path:
        return self.directory / job.id

    def _read(self, name: str) -> Job | None:
        """A run and its state; None where its folder is damaged or just being removed."""
        where = self.directory / name
        outcome = _json(where / JOB)
        memory, signature = {k: v for k, v in outcome.items() if k in KEPT}, outcome.get(SIGNATURE)
        if not _is_job(memory):
            return None
        job = Job(**{**memory, "arguments": tuple(memory["arguments"]), "attempt": tuple(memory["attempt"])})
        if job.id != name or not hmac.compare_digest(str(signature).encode(), self._signature(memory).encode()):
            return replace(job, id=name, state="refused", ended=(where / JOB).stat().st_mtime)
        owned = _owned(_owner(where))  # before the others are read: how a run ended is written just before its end
        started, ended = _json(where / STARTED), _json(where / ENDED)
        if ended:
            job = replace(job, code=int(ended["code"]), started=started.get("time", 0.0), ended=ended["time"])
            over = {"pause": "paused", "stop": "stopped"}.get(job.request, "done")
            if job.code and job.arguments[0] != "sequence":  # which ends by Ctrl-C in no other way
                over = "stopped"
            return replace(job, state=over if job.request or not job.code else "failed")
        if started:
            job = replace(job, started=started["time"], pid=int(started["pid"]))
            if owned or _alive(job.pid, started["began"]):
                return replace(job, state="running")
            return replace(job, state="stopped" if job.request else "failed", ended=(where / STARTED).stat().st_mtime)
        if job.request:
            return replace(job, state="stopped")
        return replace(job, state="running" if owned else "queued")

    # -- requests -------------------------------------------------------------------------------------------

    def add(self, arguments: Sequence[str], title: str, out: str = "") -> Job:
        """Put a run at the end of the queue.

        Parameters
        ----------
        arguments : of nerif, the verb first; paths relative to the folder of the project
        title : for people
        out : result directory that it writes, relative to the folder
        """
        if not arguments:
            raise InputError("expected a verb of nerif, got nothing", field="arguments")
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
        words = tuple(str(word) for word in arguments)
        job = Job(name, title, words, words, str(out), place=time.time())
        self._of(job).mkdir(parents=True)
        (self._of(job) / WAITING).touch()
        self._keep(job)
        return job

    def stop(self, id: str) -> None:
        """Request a run to end with its present result; a second request aborts it. A waiting run does not begin."""
        self._ask(id, "stop")

    def pause(self, id: str) -> None:
        """Ask a run to end, to be gone on with later.

        Raises
        ------
        InputError
            If it cannot be gone on with.
        """
        if not self.get(id).resumable:
            raise InputError(
                f"only nerif {' and '.join(RESUMABLE)} can be paused; stop it and start it again", field=f"job {id}"
            )
        self._ask(id, "pause")

    def resume(self, id: str) -> None:
        """Put a run that has been paused, stopped or broken off back into the queue: from its checkpoint, if it can.

        Raises
        ------
        InputError
            If it is refused.
        """
        job = self.get(id)
        if job.state in ("queued", "running"):
            return
        attempt = job.arguments
        if job.arguments[0] == "sequence":
            attempt = tuple(word for word in attempt if word != "--force")
        elif job.resumable and (self.folder / job.out / RUN).is_file():
            attempt = (job.arguments[0], "--resume", "--out", job.out, *(("--live",) if "--live" in attempt else ()))
        self._keep(replace(job, attempt=attempt, request="", place=time.time()))
        for name in (STARTED, ENDED):  # it waits once the last of them is gone
            (self._of(job) / name).unlink(missing_ok=True)

    def first(self, id: str) -> None:
        """Let a waiting run be the next."""
        job = self.get(id)
        self._keep(replace(job, place=min((j.place for j in self.all()), default=0.0) - 1))

    def earlier(self, id: str) -> None:
        """Let a waiting run change places with the one before it."""
        self._swap(id, -1)

    def later(self, id: str) -> None:
        """Let a waiting run change places with the one after it."""
        self._swap(id, 1)

    def _swap(self, id: str, by: int) -> None:
        waiting = [job for job in self.all() if job.state == "queued"]
        at = next((i for i, job in enumerate(waiting) if job.id == id), None)
        if at is None or not 0 <= at + by < len(waiting):
            return
        job, other = waiting[at], waiting[at + by]
        self._keep(replace(job, place=other.place))
        self._keep(replace(other, place=job.place))

    def remove(self, id: str) -> None:
        """Forget a run that has ended or waits; what it wrote stays.

        Raises
        ------
        InputError
            If it runs.
        """
        job = self.get(id)
        if job.state == "running":
            raise InputError("it runs; stop it first", field=f"job {id}")
        shutil.rmtree(self._of(job))

    @property
    def at_once(self) -> int:
        """How many run at the same time."""
        count = _json(self.directory / "settings.json").get("at_once")
        return count if isinstance(count, int) and 1 <= count <= MOST else 1

    @at_once.setter
    def at_once(self, count: int) -> None:
        if not 1 <= count <= MOST:
            raise InputError(f"expected 1 to {MOST} runs at the same time, got {count}", field="at_once")
        self.directory.mkdir(parents=True, exist_ok=True)
        write_json(self.directory / "settings.json", {"at_once": int(count)})

    def _ask(self, id: str, what: str) -> None:
        job = self.get(id)
        if job.state not in ("queued", "running", "paused"):
            return
        self._keep(replace(job, request=what))
        now = self._read(id)  # it may have begun meanwhile; one that begins later reads the request
        if job.state == "running" and now is not None and now.state == "running" and now.pid:
            os.kill(now.pid, signal.SIGINT)

    def _keep(self, job: Job) -> None:
        if job.state == "refused":
            raise InputError(str(REFUSED), field=f"job {job.id}")
        memory = {name: value for name, value in asdict(job).items() if name in KEPT}
        write_json(self._of(job) / JOB, {**memory, SIGNATURE: self._signature(memory)})

    def _signature(self, memory: Mapping[str, Any]) -> str:
        """What only this user can write of a run in this folder."""
        words = json.dumps([str(self.folder), memory], sort_keys=True)
        return hmac.new(self._secret, words.encode(), "sha256").hexdigest()

    # -- the queue -----------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Start as many of the waiting runs as may run at the same time."""
        jobs = self.all()
        free = self.at_once - sum(job.state == "running" for job in jobs)
        for job in [job for job in jobs if job.state == "queued"][: max(free, 0)]:
            self._launch(job)

    def _launch(self, job: Job) -> None:
        where = self._of(job)
        with (where / LOG).open("ab") as log:  # what the runner prints is why it could not start the run
            runner = subprocess.Popen(
                [sys.executable, "-P", "-m", "nerif.app.runner", str(where)], stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL, stderr=log, start_new_session=True,
            )  # fmt: skip
        assert runner.stdin is not None
        claimed = claim(where, runner.pid)
        with suppress(BrokenPipeError), runner.stdin as order:  # a runner that has ended already is waited for below
            if claimed:
                order.write(json.dumps(job.attempt).encode())

        def wait() -> None:
            code = runner.wait()  # only now may its number be given again
            if claimed and code and not (where / STARTED).exists():
                write_json(where / ENDED, {"code": code, "time": time.time()})

        threading.Thread(target=wait, daemon=True).start()


def _is_job(memory: Mapping[str, Any]) -> bool:
    """Whether the entries of a job.json are there, and of the right kind."""
    if set(memory) != set(KEPT) or not all(isinstance(memory[name], kind) for name, kind in KEPT.items()):
        return False
    return all(words and all(isinstance(w, str) for w in words) for words in (memory["arguments"], memory["attempt"]))


def _owner(where: Path) -> Path:
    """The file that says whose a run is."""
    return next(where.glob(f"{OWNER}*"), where / WAITING)


def _owned(owner: Path) -> bool:
    """Whether the process that a run belongs to is there."""
    _, _, process = owner.name.partition(OWNER)
    pid, _, began = process.partition("-")
    return bool(began) and _alive(int(pid), float(began))


def claim(where: Path, pid: int) -> bool:
    """Let a run belong to a process; False where it belongs to another one already, or is gone."""
    import psutil

    owner = _owner(where)
    if _owned(owner):
        return False
    try:
        owner.rename(where / f"{OWNER}{pid}-{psutil.Process(pid).create_time():.2f}")
    except FileNotFoundError:  # another server was faster
        return False
    return True


def _json(path: Path) -> dict[str, Any]:
    """The entries of a JSON file; none where it is missing, damaged or just being written."""
    try:
        outcome = json.loads(path.read_text())
        json.dumps(outcome, ensure_ascii=False).encode()  # half of a surrogate pair is no text that a page can show
    except (OSError, ValueError, RecursionError):
        return {}
    return outcome if isinstance(outcome, dict) else {}


def _alive(pid: int, began: float) -> bool:
    """Whether the process that was started then is there: numbers are given again."""
    import psutil

    try:
        process = psutil.Process(pid)
        return abs(process.create_time() - began) < CLOCK and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
