"""Settings by name. Where a preset departs from the paper, the figures behind it are in benchmarks/."""

from __future__ import annotations

from dataclasses import replace

import torch

from nerif.common.conventions import InputError
from nerif.fields.network import NetworkShape
from nerif.reconstruction.neural.losses import LossWeights
from nerif.reconstruction.neural.neural import NeRIF

__all__ = ["PRESETS", "preset"]

PRESETS: dict[str, NeRIF] = {
    # a small network and the exact gradient alone: made for a CPU
    "fast": NeRIF(),
    # the paper's network, trained by the exact gradient: made for a GPU
    "best": NeRIF(
        network=NetworkShape(depth=7, width=256, octaves=5, skip=4, head_width=64),
        samples=(24, 64),
        points_per_batch=1 << 17,
        learning_rate=6e-3,
    ),
    # the paper: three terms, lengths of residuals, constant learning rate, its stopping rule (docs/method.md)
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


def preset(name: str) -> NeRIF:
    """Return the settings of a preset; "auto" is `best` where there is a GPU, else `fast`.

    Raises
    ------
    InputError
        If there is no preset of that name.
    """
    if name == "auto":
        return PRESETS["best" if torch.cuda.is_available() else "fast"]
    if name not in PRESETS:
        raise InputError(f"expected auto, {', '.join(PRESETS)}, got '{name}'", field="preset")
    return replace(PRESETS[name])
