"""A whole sequence: chunks of time handed to the workers, deaths counted, progress told, and a table at the end."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nerif.common.conventions import with_unit
from nerif.reconstruction.device import keep_freed_memory
from nerif.workflow.sequence.frames import ATTEMPTS, reconstruct_frames
from nerif.workflow.sequence.plan import SequencePlan
from nerif.workflow.sequence.store import DONE, FAILED, MISSING, SequenceStore

if TYPE_CHECKING:
    from distributed import Client, Future

__all__ = ["Progress", "chunks_of", "outcome_table", "run_sequence"]


@dataclass
class Progress:
    """How far a run is.

    Parameters
    ----------
    total : frames to be done in this run
    done, failed : of them, so far
    seconds : since the run began
    """

    total: int
    done: int = 0
    failed: int = 0
    begun: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        """Since the run began."""
        return time.monotonic() - self.begun

    @property
    def settled(self) -> int:
        """Frames done or failed."""
        return self.done + self.failed

    @property
    def frames_per_minute(self) -> float:
        """Frames settled a minute, in the mean."""
        return 60 * self.settled / max(self.seconds, 1e-9)

    @property
    def seconds_left(self) -> float:
        """What is missing at that rate."""
        rate = self.frames_per_minute / 60
        return (self.total - self.settled) / rate if rate else float("nan")


def chunks_of(missing: Sequence[int], length: int, frames: int) -> list[tuple[int, int]]:
    """Return first and last + 1 of the chunks of time that have a missing frame.

    Chunks begin at multiples of `length`, however many workers there are: a frame always starts from the same one.
    """
    return [(a, min(a + length, frames)) for a in sorted({i // length * length for i in missing})]


def run_sequence(
    client: Client, plan: SequencePlan, on_progress: Callable[[Progress], None] = lambda progress: None
) -> Progress:
    """Reconstruct every missing frame of a store; whatever happens to workers, the rest goes on.

    Parameters
    ----------
    client : of a Dask cluster
    on_progress : told as frames are settled
    """
    from distributed import KilledWorker, as_completed

    store, length = SequenceStore(plan.out), plan.settings.chunk
    status = store.status
    missing = np.flatnonzero(status == MISSING).tolist()
    progress, topic = Progress(len(missing)), f"nerif-{uuid.uuid4()}"
    begun: dict[int, int] = {}  # how often a frame was begun
    deaths: dict[int, int] = {}

    def hear(event: tuple[float, dict[str, Any]]) -> None:
        told = event[1]
        if told["what"] == "begun":
            begun[told["frame"]] = begun.get(told["frame"], 0) + 1
            return
        progress.done += told["what"] == "done"
        progress.failed += told["what"] == "failed"
        on_progress(progress)

    def fail(frames: list[int], reason: str, attempts: int) -> None:
        for i in frames:
            store.fail(i, reason, attempts)
        progress.failed += len(frames)
        on_progress(progress)

    def submit(first: int, last: int) -> Future:
        key = f"frames-{first}-{last}-{uuid.uuid4()}"
        future = client.submit(_in_worker, plan, first, last, topic, key=key, pure=False, priority=-first)
        chunk[key] = (first, last)
        return future

    chunk: dict[str, tuple[int, int]] = {}
    client.subscribe_topic(topic, hear)
    on_progress(progress)
    try:
        queue = as_completed([submit(*c) for c in chunks_of(missing, length, len(status))])
        for future in queue:
            first, last = chunk.pop(str(future.key))
            if future.status != "error":
                future.result()  # raises where the cluster was lost, not the work
                continue
            left, error = [i for i in range(first, last) if store.status[i] == MISSING], future.exception()
            if not isinstance(error, KilledWorker):
                fail(left, f"{type(error).__name__}: {error}", 1)
                continue
            if left and begun.get(left[0], 0) > deaths.get(left[0], 0):
                deaths[left[0]] = deaths.get(left[0], 0) + 1
                if deaths[left[0]] >= ATTEMPTS:
                    reason = f"its worker died {ATTEMPTS} times; out of memory? see the worker's log"
                    fail([left.pop(0)], reason, ATTEMPTS)
            if left:
                queue.add(submit(first, last))
    finally:
        client.unsubscribe_topic(topic)
    return progress


def _in_worker(plan: SequencePlan, first: int, last: int, topic: str) -> None:
    from dask.system import CPU_COUNT  # what a job or container leaves of the machine
    from distributed import get_worker

    worker = get_worker()
    torch.set_num_threads(plan.threads or max(1, CPU_COUNT // worker.state.nthreads))
    keep_freed_memory()
    reconstruct_frames(plan, first, last, lambda told: worker.log_event(topic, told))


def outcome_table(store: SequenceStore) -> str:
    """Return what was done, what failed and why, as lines of text."""
    status, reasons = store.status, store.reasons
    seconds = np.asarray(store.array("seconds")[:])
    done = status == DONE
    lines = [f"{int(done.sum())} of {len(status)} frames done"]
    if done.any():
        sizes = []
        for of in (scores := store.view_scores):
            rms = np.asarray(of.rms[:])[done]
            size = f"{float(rms[np.isfinite(rms)].mean()):.4g}" if np.isfinite(rms).any() else "unknown"
            sizes.append(f"{of.technique.measured} " * (len(scores) > 1) + with_unit(size, of.technique.unit))
        lines[0] += f", {float(np.median(seconds[done])):.1f} s a frame (median), "
        lines[0] += f"rms difference to the measured {' and '.join(sizes)}"
    if (status == FAILED).any():
        lines.append(f"{int((status == FAILED).sum())} failed:")
        lines += [f"  frame {i}: {reasons[i]}" for i in np.flatnonzero(status == FAILED)]
    if (status == MISSING).any():
        lines.append(f"{int((status == MISSING).sum())} missing; the same command again does them")
    return "\n".join(lines)
