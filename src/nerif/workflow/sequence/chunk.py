"""The frames of one chunk of time, each started from the previous one, in a worker.

    frame 0: no initial field  ->  frame 1: from the weights of 0, in fewer steps  ->  frame 2: from those of 1  ->  ...

A failed frame is repeated without an initial field, then with half the learning rate, then recorded as failed; the next
one starts from the last complete one. Weights are read from the store, so that a chunk continued by another worker
gives the same result.
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
from nerif.fields.field import Field
from nerif.fields.network import NeuralField
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.registry import forward_model
from nerif.geometry import Grid
from nerif.physics.medium import derive
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import OnStep, Step, sampled
from nerif.workflow.sequence.plan import Event, SequencePlan
from nerif.workflow.sequence.store import DONE, MISSING, Frame, SequenceStore

__all__ = ["ATTEMPTS", "FAILURES", "FrameError", "end_without", "finished_frame", "reconstruct_frames"]

ATTEMPTS = 3
SCORE_PIXELS, SCORE_SAMPLES = 256, 60  # pixels per view, and samples per ray, of the scores of a frame
LENS_PIXELS = 64  # of them where a pixel is the mean over several rays

FAILURES = (InputError, ArithmeticError, RuntimeError, MemoryError, OSError)
"""Errors of a frame that justify another attempt; any other fails the chunk (run.py)."""


class FrameError(Exception):
    """All attempts at a frame failed."""


def end_without(parent: int) -> OnStep:
    """Return a callback that ends this process if its parent process has ended: the command may be run again."""

    def watch(_: Step) -> None:
        if os.getppid() != parent:
            os._exit(1)

    return watch


def reconstruct_frames(plan: SequencePlan, first: int, last: int, event: Event = lambda entries: None) -> None:
    """Reconstruct the frames first to last - 1 that the store lacks."""
    sequence, store = MeasurementSequence.read(plan.measurement), SequenceStore(plan.out)
    watch = end_without(os.getppid())
    previous: NeuralField | None = None
    for index in range(first, last):
        status = int(store.read("status", index))
        if status == MISSING:
            event({"frame": index, "what": "begun"})
            try:
                frame = _attempts(plan, sequence, index, previous, watch)
            except FrameError as error:
                store.fail(index, str(error), ATTEMPTS)
                event({"frame": index, "what": "failed", "reason": str(error)})
                continue
            store.write_frame(index, frame)
            event({"frame": index, "what": "done", "seconds": frame.seconds})
            status = DONE
        if status == DONE:
            previous = store.field(index)


def _attempts(
    plan: SequencePlan, sequence: MeasurementSequence, index: int, previous: NeuralField | None, watch: OnStep
) -> Frame:
    first = plan.cold
    cautious = replace(first, learning_rate=first.learning_rate / 2)
    attempts = [(first, None) if previous is None else (plan.warm, previous), (first, None), (cautious, None)]
    reason = ""
    for number, (settings, start) in enumerate(attempts, start=1):
        try:
            return replace(_frame(plan, settings, sequence.frame(index), start, watch), attempts=number)
        except FAILURES as error:
            reason = str(error) or type(error).__name__
    raise FrameError(reason)


def _frame(
    plan: SequencePlan, settings: NeRIF, measurement: Measurement, start: NeuralField | None, watch: OnStep
) -> Frame:
    begin = time.perf_counter()
    training = measurement.select([name for name in measurement.names if name not in plan.settings.withhold])
    result = settings(training, watch, None, start)
    if result.outcome.failed:
        raise ArithmeticError(result.outcome.message)
    assert isinstance(result.field, NeuralField)
    frame = finished_frame(plan, result.field, measurement, result.device)
    steps = int(result.history[-1]["step"]) if result.history else 0
    return replace(frame, seconds=time.perf_counter() - begin, steps=steps)


def finished_frame(plan: SequencePlan, field: NeuralField, measurement: Measurement, device: str) -> Frame:
    """Return the volumes of a field, and its scores in the views."""
    grid = Grid.of_resolution(measurement.box, plan.settings.voxels)
    volume = sampled(field, grid, measurement.quantity, measurement.n_ambient, measurement.bodies, device)
    volumes = [derive(volume, quantity, plan.settings.substance) for quantity in plan.settings.quantities]
    scores = _scores(plan.cold.model, field, apply_aperture(measurement, plan.cold.aperture), device)
    return Frame(field, volumes, scores, seconds=0.0, steps=0)


def _scores(model: str, field: Field, measurement: Measurement, device: str) -> list[dict[str, Any]]:
    """Return correlation and rms difference on some pixels of every view, withheld ones included, by technique."""
    scores = []
    for observation in measurement.observations:
        kind = observation.technique
        projector = PathIntegral(forward_model(kind, measurement, model), SCORE_SAMPLES)
        rays, values, _ = measurement.rays(observation)
        pixels = SCORE_PIXELS if rays.lens is None else LENS_PIXELS
        for i, name in enumerate(measurement.names):
            index = (rays.view == i).nonzero()[:, 0]
            if not len(index):
                continue
            index = index[:: max(1, len(index) // pixels)]
            predicted = project(projector, field, rays[index], device).numpy()
            view = values[index].numpy()
            rms = float(np.sqrt(np.mean((view - predicted) ** 2)))
            scores.append({"name": name, "measured": kind.measured, "cc": correlation(view, predicted), "rms": rms})
    return scores
