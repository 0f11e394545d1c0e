"""The frames of one chunk of time, one after the other, each from the one before. Runs in a worker.

    frame 0: from nothing  ->  frame 1: from the weights of 0, in fewer steps  ->  frame 2: from those of 1  ->  ...

A frame that fails is tried again from nothing, then with half the learning rate, then recorded; the next one starts
from the last that is done. The weights are read back from the store, so a chunk that goes on elsewhere, after a death,
gives what it would have given undisturbed.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

import numpy as np

from nerif.analysis.metrics import correlation
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume import Volume
from nerif.fields.base import Field
from nerif.fields.network import NeuralField
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.registry import forward_model
from nerif.geometry import Grid
from nerif.physics.quantities import derive
from nerif.reconstruction.aperture import seen_through
from nerif.reconstruction.base import OnStep, Step
from nerif.reconstruction.neural.neural import NeRIF
from nerif.workflow.sequence.plan import Event, SequencePlan
from nerif.workflow.sequence.store import DONE, MISSING, Frame, SequenceStore

__all__ = ["ATTEMPTS", "FAILURES", "FrameError", "end_without", "finished_frame", "reconstruct_frames"]

ATTEMPTS = 3  # at a frame
PIXELS = 256  # of each view, evenly over it, in which a frame is compared with what was measured
SAMPLES = 60  # a ray, for that

FAILURES = (InputError, ArithmeticError, RuntimeError, MemoryError, OSError)
"""What fails a frame, and is worth another attempt; anything else fails the chunk (run.py)."""


class FrameError(Exception):
    """A frame could not be reconstructed in as many attempts as there are."""


def end_without(parent: int) -> OnStep:
    """Return a callback that ends this process when its parent is gone: the command was killed, and may run again."""

    def watch(_: Step) -> None:
        if os.getppid() != parent:
            os._exit(1)

    return watch


def reconstruct_frames(plan: SequencePlan, first: int, last: int, event: Event = lambda told: None) -> None:
    """Reconstruct the frames first to last - 1 that the store lacks."""
    sequence, store = MeasurementSequence.read(plan.measurement), SequenceStore(plan.out)
    watch = end_without(os.getppid())
    before: NeuralField | None = None
    for index in range(first, last):
        status = store.status[index]
        if status == MISSING:
            event({"frame": index, "what": "begun"})
            try:
                frame = _attempts(plan, sequence, index, before, watch)
            except FrameError as error:
                store.fail(index, str(error), ATTEMPTS)
                event({"frame": index, "what": "failed", "reason": str(error)})
                continue
            store.write_frame(index, frame)
            event({"frame": index, "what": "done", "seconds": frame.seconds})
            status = DONE
        if status == DONE:
            before = store.field(index)


def _attempts(
    plan: SequencePlan, sequence: MeasurementSequence, index: int, before: NeuralField | None, watch: OnStep
) -> Frame:
    """One frame: as planned, then from nothing, then more cautiously."""
    first = plan.first
    careful = replace(first, learning_rate=first.learning_rate / 2)
    tries = [(first, None) if before is None else (plan.warm, before), (first, None), (careful, None)]
    reason = ""
    for number, (settings, start) in enumerate(tries, start=1):
        try:
            return replace(_frame(plan, settings, sequence.frame(index), start, watch), attempts=number)
        except FAILURES as error:
            reason = str(error) or type(error).__name__
    raise FrameError(reason)


def _frame(
    plan: SequencePlan, settings: NeRIF, measurement: Measurement, start: NeuralField | None, watch: OnStep
) -> Frame:
    begun = time.perf_counter()
    training = measurement.select([name for name in measurement.names if name not in plan.settings.withhold])
    result = settings(training, watch, None, start)
    if result.outcome.failed:
        raise ArithmeticError(result.outcome.message)
    assert isinstance(result.field, NeuralField)
    frame = finished_frame(plan, result.field, measurement, result.device)
    steps = int(result.history[-1]["step"]) if result.history else 0
    return replace(frame, seconds=time.perf_counter() - begun, steps=steps)


def finished_frame(plan: SequencePlan, field: NeuralField, measurement: Measurement, device: str) -> Frame:
    """Return what is written of a field: its volumes, and how it compares with what was measured."""
    grid = Grid.of_resolution(measurement.box, plan.settings.voxels)
    found = Volume.of(field.sample(grid, device), grid, measurement.quantity, measurement.n_ambient)
    volumes = [derive(found, wanted, plan.settings.gas) for wanted in plan.settings.quantities]
    seen = seen_through(measurement, plan.cold.aperture)
    scores = _against_measured(plan.cold.model, field, seen, device)
    return Frame(field, volumes, scores, seconds=0.0, steps=0)


def _against_measured(model: str, field: Field, measurement: Measurement, device: str) -> list[dict[str, Any]]:
    """Correlation and rms difference in every view, held-out ones included, by every technique, over some pixels."""
    scores = []
    for observation in measurement.observations:
        kind = observation.technique
        projector = PathIntegral(forward_model(kind, measurement, model), SAMPLES)
        rays, measured, _ = measurement.rays(observation)
        for i, name in enumerate(measurement.names):
            own = (rays.view == i).nonzero()[:, 0]
            if not len(own):
                continue
            own = own[:: max(1, len(own) // PIXELS)]
            predicted = project(projector, field, rays[own], device).numpy()
            seen = measured[own].numpy()
            rms = float(np.sqrt(np.mean((seen - predicted) ** 2)))
            found = {"name": name, "measured": kind.measured, "cc": correlation(seen, predicted), "rms": rms}
            scores.append(found)
    return scores
