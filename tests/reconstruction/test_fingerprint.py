"""A run goes on with the data that it began with, and with no other."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.data.measurement import Measurement
from nerif.fields.network import NetworkShape
from nerif.forward.registry import technique
from nerif.geometry import Box
from nerif.reconstruction.base import Reconstructor, State
from nerif.reconstruction.files import fingerprint
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.simulation.simulate import simulate
from refusals import refused

NETWORK = NeRIF(
    network=NetworkShape(depth=1, width=8, octaves=1), points_per_batch=256, max_steps=2, device="cpu",
    precision="float32",
)  # fmt: skip
VOXELS = Tikhonov(voxels=12, device="cpu", regularisation=1e-3, iterations=1)


def changed(measurement: Measurement, part: str) -> Measurement:
    """The measurement with another one of its parts."""
    if part == "views":
        return measurement.select(measurement.names[:-1])
    if part == "cameras":
        first = measurement.cameras[0]
        moved = replace(first, translation=first.translation + 0.01)
        return replace(measurement, cameras=(moved, *measurement.cameras[1:]))
    if part == "box":
        box = measurement.box
        return replace(measurement, box=Box(box.lower, (box.upper[0] + 1, *box.upper[1:])))
    valid = torch.ones(measurement.displacement.shape[:3], dtype=torch.bool)
    valid[1, 3] = False
    changes = {
        "displacement": {"displacement": measurement.displacement * 1.001},
        "sigma": {"sigma": measurement.sigma * 2},
        "valid pixels": {"valid": valid},
        "flow_mask": {"flow_mask": valid},
        "n_ambient": {"n_ambient": 1.0003},
        "ambient_faces": {"ambient_faces": ("x-",)},
    }
    return replace(measurement, **changes[part])


@pytest.fixture(scope="module")
def states(measurement: Measurement) -> dict[Reconstructor, State]:
    """Where a run by each kind of method stopped."""
    return {method: method(measurement).state for method in (NETWORK, VOXELS)}


@pytest.mark.parametrize("method", [NETWORK, VOXELS], ids=["network", "voxels"])
@pytest.mark.parametrize("part", [
    "views", "cameras", "displacement", "sigma", "valid pixels", "flow_mask", "box", "n_ambient", "ambient_faces",
])  # fmt: skip
def test_resuming_refuses_other_data_and_says_which(measurement, states, method, part):
    with refused("resume"):
        method(changed(measurement, part), resume=states[method])


@pytest.mark.parametrize("method", [NETWORK, VOXELS], ids=["network", "voxels"])
def test_resuming_refuses_other_open_faces(measurement, states, method):
    with refused("resume"):
        replace(method, open_faces=("z+",))(measurement, resume=states[method])


def test_what_the_forward_model_depends_on_is_data(ball, cameras, box):
    kind = technique("interferometry")
    m = simulate(ball, cameras, box, 1.0, steps=10, wavelength_nm=532.0, techniques=[kind])
    state = VOXELS(m).state
    with refused("resume"):
        VOXELS(replace(m, wavelength_nm=633.0), resume=state)


def test_resuming_takes_the_same_data_read_again(measurement, states, tmp_path):
    measurement.write(tmp_path / "m.nc")
    again = Measurement.read(tmp_path / "m.nc")
    assert fingerprint(again) == fingerprint(measurement)
    assert replace(NETWORK, max_steps=3)(again, resume=states[NETWORK]).history[-1]["step"] == 3


def test_a_checkpoint_that_does_not_tell_its_data_is_refused(measurement, states):
    for method, state in states.items():
        scalars = {name: value for name, value in state.scalars.items() if name != "fingerprint"}
        with refused("resume"):
            method(measurement, resume=State(state.tensors, scalars))


def test_what_is_not_used_of_a_pixel_does_not_matter(measurement):
    valid = torch.ones(measurement.displacement.shape[:3], dtype=torch.bool)
    valid[1, 3] = False
    spoilt = measurement.displacement.clone()
    spoilt[1, 3] = 9.0
    masked = replace(measurement, valid=valid)
    assert fingerprint(masked) == fingerprint(replace(masked, displacement=spoilt))
