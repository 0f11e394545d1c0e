"""What counts as time of training."""

from __future__ import annotations

import time

from nerif.fields.mlp import NetworkShape
from nerif.reconstruction import training
from nerif.reconstruction.neural import NeRIF


def test_the_time_limit_is_of_training_alone(measurement, monkeypatch):
    """An optimiser that takes long to be there, as with the first import of what it needs, costs no step."""

    class Slow(training.NetworkOptimiser):
        def __init__(self, *arguments, **more):
            time.sleep(1.3)
            super().__init__(*arguments, **more)

    NeRIF(network=NetworkShape(depth=1, width=8), points_per_batch=64, max_steps=1, device="cpu")(measurement)
    monkeypatch.setattr(training, "NetworkOptimiser", Slow)
    settings = NeRIF(
        network=NetworkShape(depth=1, width=8), points_per_batch=64, time_limit=1.0, max_steps=1, device="cpu"
    )
    assert settings(measurement).history
