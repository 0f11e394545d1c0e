"""Cases of the study, and running one: the record, the inputs that determine it, the device of the field."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from dataclasses import field as dataclass_field

import pytest
import torch

from benchmarks.study.plan import FULL, METHODS, NOISES, PHANTOMS, QUICK, SECTIONS, Case, study_cases
from benchmarks.study.running import run_case
from nerif.common.conventions import InputError
from nerif.fields.field import Field
from nerif.fields.network import NetworkShape
from nerif.geometry import Box, Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Outcome, Reconstruction
from nerif.reconstruction.voxels.tikhonov import Tikhonov

RING = Ring(views=4, image_size=(16, 16), pixel_pitch=0.25)
SMALL = NeRIF(
    network=NetworkShape(depth=2, width=24, octaves=2), samples=(12, 16), sample_jitter=2, points_per_batch=600,
    max_steps=200, device="cpu", precision="float32",
)  # fmt: skip
TIKHONOV = Tikhonov(voxels=8, basis="linear", iterations=3, device="cpu")


def small(key: str, reconstructor=TIKHONOV, **more) -> Case:
    values = {"phantom": "1", "noise": 0.1, "method": "Tikhonov", "ring": RING, "truth_voxels": 12, **more}
    return Case(key=key, labels={"tables": key}, reconstructor=reconstructor, **values)


def test_the_study_holds_all_that_the_paper_shows():
    for scale in (FULL, QUICK):
        todo = study_cases(scale)
        assert len({c.key for c in todo}) == len(todo)
        sections = {section for c in todo for section in c.labels}
        assert sections == set(SECTIONS)
        tables = {(c.phantom, c.noise, c.method) for c in todo if "tables" in c.labels}
        assert tables == {(p, n, m) for p in PHANTOMS for n in NOISES for m in METHODS}
        labels = {s: {c.labels[s] for c in todo if s in c.labels} for s in SECTIONS}
        assert labels["model"] == {"lever_arm", "paraxial", "curved"}
        assert {"random", "regular"} < labels["sampling"]
        assert len(labels["differentiation"]) == 2
        assert len(labels["network"]) == 3
        assert "no encoding" in labels["encoding"]
        assert {"3", "9", "18"} <= labels["views"]
    assert {c.ring.image_size for c in study_cases(FULL)} == {(200, 200)}
    assert sum("views" in c.labels for c in study_cases(QUICK)) == len(QUICK.views)


@pytest.mark.slow
def test_a_record_describes_the_run(tmp_path):
    case = small("nerif", SMALL, method="NeRIF", snapshots=True)
    record = run_case(case, tmp_path)
    assert record["method"] == "NeRIF"
    assert record["steps"] == 200
    assert record["outcome"] == "steps"
    assert record["peak_memory_bytes"] > 1e7
    assert len(record["metrics"]["slices"]) == 10
    curve = record["curve"]
    assert [p["step"] for p in curve] == sorted(p["step"] for p in curve)
    assert curve[-1]["step"] == 200
    assert curve[-1]["l2"] == pytest.approx(record["metrics"]["l2"])
    assert curve[-1]["l2"] < 0.9 * curve[0]["l2"]
    assert curve[0]["seconds"] < curve[-1]["seconds"] <= record["seconds"]


@pytest.mark.parametrize("field", [f.name for f in fields(Ring)])
def test_another_rig_is_another_measurement(field):
    """A simulated measurement on disk is not used for another ring."""
    case = small("a")
    changed = {
        "views": 5, "arc": (5.0, 170.0), "extra_angles": (33.0,), "elevation": 3.0, "focal_length": 40.0,
        "pixel_pitch": 0.3, "image_size": (16, 20), "distance": 600.0, "background_distance": 400.0,
        "projection": "telecentric", "magnification": 0.3, "sensor_tilt": (3.0, 0.0),
    }  # fmt: skip
    also = {"projection": "telecentric"} if field == "magnification" else {}
    other = replace(case, ring=replace(RING, **also, **{field: changed[field]}))
    assert other.data_key != case.data_key
    assert other.digest != case.digest


def test_all_inputs_are_in_the_hashes(monkeypatch):
    case = small("a")
    key, digest = case.data_key, case.digest
    assert replace(case, noise=0.0).data_key == key  # noise is added to what is on disk
    for name, other in (("BOX", Box.cube(40.0)), ("N_AMBIENT", 1.0003), ("NOISE_SEED", 2)):
        with monkeypatch.context() as patch:
            patch.setattr(f"benchmarks.study.plan.{name}", other)
            assert case.digest != digest, name
            assert (case.data_key != key) == (name != "NOISE_SEED"), name
    monkeypatch.setattr("benchmarks.study.plan.__version__", "9.9")
    assert case.data_key != key


@pytest.mark.slow
def test_the_resolution_of_the_octahedron_and_the_errors_of_the_forward_models(tmp_path):
    record = run_case(small("o", phantom="octahedron", noise=0.0), tmp_path)
    assert record["pixels_per_unit"] == pytest.approx(12.5 / 0.25 * 50 / 700, rel=0.05)
    assert "lp_per_unit" in record["resolution"]
    model = replace(small("2-0-nerif", noise=0.0), labels={"model": "lever_arm"})
    forward = run_case(model, tmp_path)["forward"]
    assert forward["curved"]["relative"] < forward["lever_arm"]["relative"] < forward["paraxial"]["relative"] < 0.05


class Recorder(Field):
    """A field that records the devices at which it is evaluated."""

    def __init__(self) -> None:
        self.devices: set[str] = set()

    def value_and_gradient(self, points):
        self.devices.add(points.device.type)
        return torch.zeros(points.shape[:-1]), torch.zeros(points.shape)


@dataclass(frozen=True)
class OnMeta(Tikhonov):
    """A method whose field is on the device "meta"."""

    field: Recorder = dataclass_field(default_factory=Recorder)
    steps: int = 1

    def __call__(self, measurement, *arguments, **more):
        return Reconstruction(
            self.field, measurement.box, measurement.n_ambient, [{}] * self.steps, Outcome("steps", "too soon"), {},
            device="meta",
        )  # fmt: skip


def test_the_field_is_evaluated_on_its_device(tmp_path):
    method = OnMeta(voxels=8)
    run_case(small("o", method, phantom="octahedron", noise=0.0), tmp_path)
    assert method.field.devices == {"meta"}


def test_a_run_without_a_step_is_no_result(tmp_path):
    with pytest.raises(InputError, match="not a single step was made: too soon"):
        run_case(small("none", OnMeta(voxels=8, steps=0)), tmp_path)
