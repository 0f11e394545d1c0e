"""Presets of the training settings; benchmarks/ compares them with those of the paper."""

from __future__ import annotations

import dataclasses
from typing import Any

from nerif.common.conventions import InputError
from nerif.common.files import check_known
from nerif.fields.network_shape import NetworkShape
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.training_settings import LossWeights

__all__ = ["PRESETS", "preset"]

PRESETS: dict[str, NeRIF] = {
    # for a CPU: a small network, exact gradient only
    "fast": NeRIF(),
    # for a GPU: the network of the paper, exact gradient only
    "best": NeRIF(
        network=NetworkShape(depth=7, width=256, octaves=5, skip=4, head_width=64),
        samples=(24, 64),
        points_per_batch=1 << 17,
        learning_rate=6e-3,
    ),
    # the paper (docs/method.md): three loss terms, l2 norm, constant learning rate, its stopping rule
    "paper": NeRIF(
        network=NetworkShape(depth=7, width=256, octaves=5, directions=3, skip=4, head_width=64, gradient_head=True),
        wave_pixels=0,
        weights=LossWeights(consistency=1, numerical=1, head=1, automatic=0),
        norm="l2",
        optimiser="adam",
        samples=(60, 200),
        sample_jitter=10,
        sampling="random",
        points_per_batch=1 << 15,
        learning_rate=1e-3,
        rates_by_shape=False,
        schedule="constant",
        epochs=200,
        stop_ratio=0.005,
        precision="float32",
    ),
}


def preset(name: str, **changes: Any) -> NeRIF:
    """Return the settings of a preset, with changes such as max_steps=500; "auto" is `best` with a GPU, else `fast`."""
    if name == "auto":
        from nerif.reconstruction.device import resolve_device

        name = "fast" if resolve_device("auto").type == "cpu" else "best"
    if name not in PRESETS:
        raise InputError(f"expected auto, {', '.join(PRESETS)}, got '{name}'", field="preset")
    check_known(changes, [f.name for f in dataclasses.fields(NeRIF)], "preset")
    return dataclasses.replace(PRESETS[name], **changes)
