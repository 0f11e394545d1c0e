"""Errors of the frames of a sequence against their true fields."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nerif.analysis.evaluation import check_inside
from nerif.analysis.metrics import volume_errors
from nerif.common.conventions import InputError
from nerif.common.files import write_json
from nerif.common.times import same_instants
from nerif.data.quantity_names import INDEX
from nerif.data.volume_sequence import VolumeSequence
from nerif.forward.registry import ASSUMED, technique
from nerif.geometry.body import contained
from nerif.workflow.sequence.store import DONE, SequenceStore

__all__ = ["evaluate_sequence"]


def evaluate_sequence(
    result: str | os.PathLike[str],
    truth: str | os.PathLike[str],
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Compare every frame of a sequence with its true field; write the metrics to RESULT.metrics.json and return them.

    Parameters
    ----------
    result : store of nerif sequence
    truth : store of the true fields at the same instants, index excess over any ambient
    on_frame : called with the numbers of frames compared and to compare
    """
    store, true = SequenceStore(Path(result)), VolumeSequence(truth)
    if not same_instants(store.times, true.times):
        raise InputError(f"expected the instants of {result}, {len(store)} frames, got others", field=truth)
    check_inside(Path(truth), true.grid.box, store.grid.box)
    quantity = technique(store.attributes.get("techniques", [ASSUMED.name])[0]).quantity
    reference = store.n_ambient if quantity == INDEX else 1.0
    frames: list[dict[str, Any]] = []
    complete = [i for i, status in enumerate(store.status) if status == DONE]
    for i in complete:
        expected = true.volume(i, quantity)
        if quantity == INDEX:
            expected = expected.relative_to(store.n_ambient)
        if bodies := store.bodies(i):
            expected = expected.masked(contained(bodies, true.grid.points()), "within a body")
        errors = volume_errors(expected.values.numpy(), store.field(i).sample(true.grid).numpy(), reference)
        frames.append({"frame": i, "time_s": store.times[i], **errors})
        on_frame(len(frames), len(complete))
    if not frames:
        raise InputError("no frame is complete yet; run nerif sequence again", field=result)
    mean = {name: sum(f[name] for f in frames) / len(frames) for name in ("l2", "l2_variation", "cc")}
    metrics = {"truth": str(Path(truth).resolve()), "frames": frames, "mean": mean}
    write_json(Path(result).with_suffix(".metrics.json"), metrics)
    return metrics
