"""A sequence on a cluster: chunks of time for the workers, repeated after the death of a worker."""

from __future__ import annotations

import time
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nerif.common.conventions import with_unit
from nerif.common.files import DISK_FULL
from nerif.reconstruction.device import keep_freed_memory
from nerif.workflow.sequence.chunk import ATTEMPTS, reconstruct_frames
from nerif.workflow.sequence.plan import SequencePlan
from nerif.workflow.sequence.store import DONE, FAILED, MISSING, SequenceStore

if TYPE_CHECKING:
    from distributed import Client, Future

__all__ = ["SequenceProgress", "chunks_of", "outcome_table", "run_sequence"]

LOOK_EVERY, WITHOUT_WORKERS = 5.0, 60.0  # s, between looks for workers, and before a run without any ends
MOST_UNBEGUN = 10  # deaths before a chunk has begun a frame; it may be that of another chunk of the same worker


@dataclass
class SequenceProgress:
    """Progress of a run."""

    total: int  #: frames to reconstruct in this run
    done: int = 0  #: complete ones
    failed: int = 0
    deaths: int = 0  #: of workers
    workerless: bool = False  #: whether it ended because no worker was left
    begin: float = field(default_factory=time.monotonic)  #: monotonic clock, s

    @property
    def seconds(self) -> float:
        """Duration of the run so far."""
        return time.monotonic() - self.begin

    @property
    def settled(self) -> int:
        """Number of frames complete or failed."""
        return self.done + self.failed

    @property
    def frames_per_minute(self) -> float:
        """Mean rate."""
        return 60 * self.settled / max(self.seconds, 1e-9)

    @property
    def seconds_left(self) -> float:
        """Remaining time at that rate; NaN if unknown."""
        rate = self.frames_per_minute / 60
        return (self.total - self.settled) / rate if rate else float("nan")

    @property
    def loss(self) -> str:
        """A sentence about workers that died; empty if none did."""
        if not self.deaths and not self.workerless:
            return ""
        end = "; ended, since no worker is left" if self.workerless else ""
        return f"workers died {self.deaths} times{end}; out of memory? See the log of the workers"


def chunks_of(missing: Sequence[int], length: int, frames: int) -> list[tuple[int, int]]:
    """Return first and last + 1 of the chunks of time with a missing frame.

    Chunks begin at multiples of `length`: the start of a frame does not depend on the workers.
    """
    return [(a, min(a + length, frames)) for a in sorted({i // length * length for i in missing})]


def run_sequence(
    client: Client, plan: SequencePlan, on_progress: Callable[[SequenceProgress], None] = lambda progress: None
) -> SequenceProgress:
    """Reconstruct every missing frame of a store, also if workers die or chunks fail.

    Frames remain missing if no worker is left, or if the workers of their chunk die before they begin.
    """
    from distributed import KilledWorker, wait

    store, status = SequenceStore(plan.out), SequenceStore(plan.out).status
    missing = np.flatnonzero(status == MISSING).tolist()
    progress, topic = SequenceProgress(len(missing)), f"nerif-{uuid.uuid4()}"
    starts, deaths, unbegun = Counter[int](), Counter[int](), Counter[int]()  # by frame
    chunks: dict[str, tuple[int, int]] = {}  # by the key of their task

    def on_event(event: tuple[float, dict[str, Any]]) -> None:
        entries = event[1]
        if entries["what"] == "begun":
            starts[entries["frame"]] += 1
            return
        progress.done += entries["what"] == "done"
        progress.failed += entries["what"] == "failed"
        on_progress(progress)

    def fail(frames: list[int], reason: str, attempts: int) -> None:
        for i in frames:
            store.fail(i, reason, attempts)
        progress.failed += len(frames)
        on_progress(progress)

    def submit(first: int, last: int) -> Future:
        key = f"frames-{first}-{last}-{uuid.uuid4()}"
        chunks[key] = (first, last)
        return client.submit(_in_worker, plan, first, last, topic, key=key, pure=False, priority=-first)

    client.subscribe_topic(topic, on_event)
    on_progress(progress)
    try:
        pending, since = {submit(*chunk) for chunk in chunks_of(missing, plan.settings.chunk, len(status))}, None
        while pending:
            try:
                ended, pending = wait(pending, timeout=LOOK_EVERY, return_when="FIRST_COMPLETED")
            except TimeoutError:
                since = None if has_workers(client) else since or time.monotonic()
                if since is not None and time.monotonic() - since > WITHOUT_WORKERS:
                    progress.workerless = True
                    break
                continue
            for future in ended:
                first, last = chunks.pop(str(future.key))
                if future.status != "error":
                    future.result()  # raises if the cluster was lost
                    continue
                error = future.exception()
                rest = (first + np.flatnonzero(store.read("status", slice(first, last)) == MISSING)).tolist()
                if isinstance(error, OSError) and error.errno in DISK_FULL:
                    raise error
                if not isinstance(error, KilledWorker):
                    fail(rest, f"{type(error).__name__}: {error}", 1)
                    continue
                progress.deaths += 1
                on_progress(progress)
                if rest and starts[rest[0]] > deaths[rest[0]]:
                    deaths[rest[0]] += 1
                    if deaths[rest[0]] >= ATTEMPTS:
                        reason = f"its worker died {ATTEMPTS} times; out of memory? See the log of the worker"
                        fail([rest.pop(0)], reason, ATTEMPTS)
                elif rest:
                    unbegun[rest[0]] += 1
                if rest and unbegun[rest[0]] < MOST_UNBEGUN:
                    pending.add(submit(first, last))
    finally:
        client.unsubscribe_topic(topic)
    return progress


def has_workers(client: Client) -> bool:
    """Return whether a cluster has workers, or processes or jobs that may become some."""
    return bool(client.scheduler_info()["workers"] or getattr(client.cluster, "workers", None))


def _in_worker(plan: SequencePlan, first: int, last: int, topic: str) -> None:
    from dask.system import CPU_COUNT  # available to the job or container
    from distributed import get_worker

    worker = get_worker()
    torch.set_num_threads(plan.threads or max(1, CPU_COUNT // worker.state.nthreads))
    keep_freed_memory()
    reconstruct_frames(plan, first, last, lambda entries: worker.log_event(topic, entries))


def outcome_table(store: SequenceStore) -> str:
    """Return a table of complete, failed and missing frames as lines of text."""
    status, reasons = store.status, store.reasons
    seconds = np.asarray(store.array("seconds")[:])
    complete, failed, missing = status == DONE, status == FAILED, status == MISSING
    lines = [f"{int(complete.sum())} of {len(status)} frames done"]
    if complete.any():
        sizes = []
        for scores in (views := store.view_scores):
            rms = np.asarray(scores.rms[:])[complete]
            size = f"{float(rms[np.isfinite(rms)].mean()):.4g}" if np.isfinite(rms).any() else "unknown"
            name = f"{scores.technique.measured} " * (len(views) > 1)
            sizes.append(name + with_unit(size, scores.technique.unit))
        lines[0] += f", {float(np.median(seconds[complete])):.1f} s per frame (median), "
        lines[0] += f"rms residual {' and '.join(sizes)}"
    if failed.any():
        lines.append(f"{int(failed.sum())} failed:")
        lines += [f"  frame {i}: {reasons[i]}" for i in np.flatnonzero(failed)]
    if missing.any():
        lines.append(f"{int(missing.sum())} missing; run the same command again to continue")
    return "\n".join(lines)
