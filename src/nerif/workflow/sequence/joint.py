"""One network over space and time for all frames of a chunk, so that frames share what they know. Runs in a worker.

min  mean over rays of all frames |d(x, t) - d|^2 / sigma^2  +  mean |N|^2 over the ambient region of each frame
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.written_files import OwnFiles
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.fields.space_time import SpaceTimeField
from nerif.reconstruction.base import OnStep, Reconstruction, State, Step, compose
from nerif.reconstruction.files import CHECKPOINT, checkpoints, read_state
from nerif.reconstruction.neural.training import Training
from nerif.reconstruction.neural.training_data import FrameData
from nerif.workflow.sequence.chunk_data import ChunkData
from nerif.workflow.sequence.frames import ATTEMPTS, FAILURES, FrameError, end_without, finished_frame
from nerif.workflow.sequence.plan import Event, SequencePlan
from nerif.workflow.sequence.store import DONE, MISSING, SequenceStore, chunk_tau

__all__ = ["reconstruct_jointly"]

CHECKPOINT_EVERY = 60.0  # seconds
TELL_EVERY = 50  # steps


def reconstruct_jointly(plan: SequencePlan, first: int, last: int, event: Event = lambda told: None) -> None:
    """Reconstruct the frames first to last - 1 by one network, if the store lacks any of them."""
    sequence, store = MeasurementSequence.read(plan.measurement), SequenceStore(plan.out)
    missing = [i for i in range(first, last) if store.status[i] == MISSING]
    if not missing:
        return
    event({"frame": missing[0], "what": "begun"})

    def fail(index: int, error: Exception, attempts: int) -> None:
        if store.status[index] == MISSING:
            reason = str(error) or type(error).__name__
            store.fail(index, reason, attempts)
            event({"frame": index, "what": "failed", "reason": reason})

    def tell(step: Step) -> None:
        if step.step % TELL_EVERY == 0:
            event({"frame": first, "what": "share", "share": step.progress * len(missing)})

    begun = time.perf_counter()
    frames: dict[int, FrameData] = {}
    for i in range(first, last):
        try:
            frames[i] = _read(plan, sequence, i)
        except FAILURES as error:
            fail(i, error, 1)
    techniques = max((frame.measurement.techniques for frame in frames.values()), key=len, default=())
    for i in [i for i, frame in frames.items() if frame.measurement.techniques != techniques]:
        names = " and ".join(kind.measured for kind in techniques)
        fail(i, InputError(f"joint: expected {names} in every frame, got a frame that lacks one of them"), 1)
        del frames[i]
    if not frames:
        return
    tau = torch.tensor([chunk_tau(sequence.times, i, first, last) for i in frames], dtype=torch.float32)
    kept = store.checkpoints / str(first)
    try:
        data, trained = _trained(plan, list(frames.values()), tau, kept, compose(end_without(os.getppid()), tell))
    except FrameError as error:
        for i in frames:
            fail(i, error, ATTEMPTS)
        return
    seconds = (time.perf_counter() - begun) / len(frames)
    assert isinstance(trained.field, SpaceTimeField)
    for place, i in enumerate(frames):
        if store.status[i] == DONE:
            continue
        begun = time.perf_counter()
        try:
            field = data.field(trained.field, place)
            found = finished_frame(plan, field, sequence.frame(i), trained.device)
            found = replace(found, seconds=seconds + time.perf_counter() - begun, steps=plan.settings.joint_steps)
            store.write_frame(i, found)
        except FAILURES as error:
            fail(i, error, 1)
            continue
        event({"frame": i, "what": "done", "seconds": found.seconds})
    OwnFiles(kept).remove()
    with suppress(OSError):  # of other chunks there are some
        store.checkpoints.rmdir()


def _read(plan: SequencePlan, sequence: MeasurementSequence, index: int) -> FrameData:
    """A frame without the views held out."""
    frame = sequence.frame(index)
    training = frame.select([name for name in frame.names if name not in plan.settings.hold_out])
    return FrameData(replace(plan.cold, device="cpu"), training, coarsest=1)


def _trained(
    plan: SequencePlan, frames: list[FrameData], tau: Tensor, kept: Path, on_step: OnStep
) -> tuple[ChunkData, Reconstruction]:
    """The network, from the last checkpoint if there is one; after a failure anew, with half the learning rate."""
    reason = ""
    for attempt in range(ATTEMPTS):
        rate, steps = plan.cold.learning_rate / 2**attempt, plan.settings.joint_steps * len(frames)
        settings = replace(plan.cold, learning_rate=rate, max_steps=steps)
        try:
            data = ChunkData(settings, frames, tau, plan.settings.time_octaves)
            training = Training(settings, data, _resumable(kept, data))
            result = training.run(compose(on_step, checkpoints(kept, CHECKPOINT_EVERY)))
            if result.outcome.failed:
                raise ArithmeticError(result.outcome.message)
            return data, result
        except FAILURES as error:
            reason = str(error) or type(error).__name__
            OwnFiles(kept).remove()
    raise FrameError(reason)


def _resumable(kept: Path, data: ChunkData) -> State | None:
    """The checkpoint of an earlier run of the same data and settings; that of another run is removed."""
    if not (kept / CHECKPOINT).is_file():
        return None
    state = read_state(kept)
    if state.scalars.get("fingerprint") == data.fingerprint:
        return state
    OwnFiles(kept).remove()
    return None
