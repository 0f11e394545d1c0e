"""A run is resumed with the same data, and with no other."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.data.measurement import Measurement
from nerif.fields.network_shape import NetworkShape
from nerif.forward.registry import technique
from nerif.geometry import Box
from nerif.reconstruction.field_files import check_fingerprint, fingerprint
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Reconstructor, State
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.simulation.simulate import simulate
from refusals import refused

NETWORK = NeRIF(
    network=NetworkShape(depth=1, width=8, octaves=1), points_per_batch=256, max_steps=2, device="cpu",
    precision="float32",
)  # fmt: skip
VOXELS = Tikhonov(voxels=12, device="cpu", regularisation=1e-3, iterations=1)


def without_a_pixel(m: Measurement) -> torch.Tensor:
    valid = torch.ones(m.displacement.shape[:3], dtype=torch.bool)
    valid[1, 3] = False
    return valid


def with_another_pose(m: Measurement) -> Measurement:
    first = replace(m.cameras[0], translation=m.cameras[0].translation + 0.01)
    return replace(m, cameras=(first, *m.cameras[1:]))


CHANGES = {
    "views": lambda m: m.select(m.names[:-1]),
    "cameras": with_another_pose,
    "displacement": lambda m: replace(m, displacement=m.displacement * 1.001),
    "sigma": lambda m: replace(m, sigma=m.sigma * 2),
    "valid pixels": lambda m: replace(m, valid=without_a_pixel(m)),
    "flow_mask": lambda m: replace(m, flow_mask=without_a_pixel(m)),
    "box": lambda m: replace(m, box=Box(m.box.lower, (m.box.upper[0] + 1, *m.box.upper[1:]))),
    "n_ambient": lambda m: replace(m, n_ambient=1.0003),
    "ambient_faces": lambda m: replace(m, ambient_faces=("x-",)),
}


@pytest.fixture(scope="module")
def states(measurement: Measurement) -> dict[Reconstructor, State]:
    """The final state of a run of each kind of method."""
    return {method: method(measurement).state for method in (NETWORK, VOXELS)}


@pytest.mark.parametrize("part", CHANGES)
def test_other_data_are_refused(measurement, states, part):
    for method, state in states.items():
        with refused("resume") as error:
            method(CHANGES[part](measurement), resume=state)
        assert part in str(error.value)


def test_other_open_faces_and_checkpoints_without_a_fingerprint_are_refused(measurement, states):
    for method, state in states.items():
        with refused("resume"):
            replace(method, open_faces=("z+",))(measurement, resume=state)
        scalars = {name: value for name, value in state.scalars.items() if name != "fingerprint"}
        with refused("resume"):
            method(measurement, resume=State(state.tensors, scalars))


@pytest.mark.parametrize("method", [NETWORK, VOXELS])
def test_the_uncertainty_of_poses_is_data_where_they_are_refined(measurement, method):
    uncertain = replace(
        measurement, cameras=tuple(replace(c, pose_sigma=torch.full((6,), 1e-3)) for c in measurement.cameras)
    )
    method(uncertain, resume=method(measurement).state)
    refined = replace(method, refine=("cameras",))
    parts = [fingerprint(m, refine=refined.refine) for m in (measurement, uncertain)]
    assert [name for name in parts[0] if parts[0][name] != parts[1][name]] == ["pose_sigma"]
    with refused("resume") as error:
        refined(uncertain, resume=State({}, {"fingerprint": parts[0]}))
    assert "pose_sigma" in str(error.value)


def test_parts_that_the_data_no_longer_have_are_named():
    with refused("resume") as error:
        check_fingerprint({"box": "a", "ambient_region": "b"}, {"box": "a"})
    assert "ambient_region" in str(error.value)


def test_constants_of_the_forward_model_are_data(ball, cameras, box):
    kind = technique("interferometry")
    m = simulate(ball, cameras, box, 1.0, steps=10, wavelength_nm=532.0, techniques=[kind])
    state = VOXELS(m).state
    with refused("resume"):
        VOXELS(replace(m, wavelength_nm=633.0), resume=state)


def test_the_same_data_read_from_a_file_are_accepted_whatever_invalid_pixels_hold(measurement, states, tmp_path):
    measurement.write(tmp_path / "m.nc")
    again = Measurement.read(tmp_path / "m.nc")
    assert fingerprint(again) == fingerprint(measurement)
    assert replace(NETWORK, max_steps=3)(again, resume=states[NETWORK]).history[-1]["step"] == 3
    masked, other = replace(measurement, valid=without_a_pixel(measurement)), measurement.displacement.clone()
    other[1, 3] = 9.0
    assert fingerprint(masked) == fingerprint(replace(masked, displacement=other))
