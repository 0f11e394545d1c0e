"""The study: its cases, one of them run, and the page of synthetic records; verdicts follow the records."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from dataclasses import field as dataclass_field

import pytest
import torch

from benchmarks import runner, study
from benchmarks.study.claims import CLAIMS, VERDICTS, worse_than_paper
from benchmarks.study.paper import CORRELATION, L2, paper_value
from benchmarks.study.plan import FULL, METHODS, NOISES, PHANTOMS, QUICK, SECTIONS, Case, study_cases
from benchmarks.study.results import Results
from benchmarks.study.running import run_case
from nerif.common.conventions import InputError
from nerif.fields.field import Field
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Outcome, Reconstruction
from nerif.reconstruction.voxels.tikhonov import Tikhonov

ERRORS = {"NeRIF": 0.003, "TV": 0.008, "Landweber": 0.02, "Tikhonov": 0.025}
ALL = study_cases(QUICK)
FACES = [[[10 * x, 4 * y, 4 * z], [4 * x, 10 * y, 4 * z], [4 * x, 4 * y, 10 * z]] for x, y, z in (
    (a, b, c) for a in (1, -1) for b in (1, -1) for c in (1, -1))]  # fmt: skip


def resolution(lp_per_unit):
    return {
        "unit_mm": 12.5, "lp_per_unit": lp_per_unit, "local_lp_per_unit": [lp_per_unit] * 8, "patches_mm": FACES,
        "distance_mm": [-5.0, -0.1, 0.1, 5.0], "edge_spread": [-1.0, -0.7, -0.3, 0.0],
        "frequency_lp_per_unit": [0.0, 50.0, 128.0], "mtf": [1.0, 0.4, 0.1],
    }  # fmt: skip


def record(case: Case, **changes):
    """NeRIF as accurate as in the paper."""
    l2 = ERRORS[case.method] * (1 + 0.5 * case.noise)
    cc = 0.9 + 8 * (0.01 - l2) if case.method != "NeRIF" else 1.0 - 1e-4 * case.noise
    values = {
        "l2": l2, "l2_variation": 2.5 * l2, "cc": cc, "ssim": cc - 0.02, "views": case.ring.views, "outcome": "time",
        "time": 6.0 if case.method == "NeRIF" else 2.0, "memory": 0.9, "processor": "cpu", "epochs": 60.0, "loss": 0.02,
    } | changes  # fmt: skip
    if case.snapshots and values["l2"]:
        values["curve"] = [
            {"epochs": 60 * s, "seconds": 6 * s, "l2": values["l2"] / s, "l2_variation": 2.5 * values["l2"] / s}
            for s in (0.1, 0.5, 0.75, 1.0)
        ]
    if case.phantom == "octahedron":
        values = {"resolution": resolution(20.0), "pixels_per_unit": 50.0} | values
    scores = {name: values[name] for name in ("cc", "ssim")}
    return {"slices": [{"z_mm": z, **scores} for z in range(10)]} | values


def records(change=lambda case: {}):
    """Records of all cases; `change` returns differences of the metrics, "failed", or None for no record."""
    result = []
    for case, settings in zip(ALL, study.cases(quick=True), strict=True):
        changes = change(case)
        if changes is not None:
            outcome = changes if "failed" in changes else {"metrics": record(case, **changes)}
            result.append({"settings": settings, "commit": "abc", **outcome})
    return result


def page(folder, change=lambda case: {}):
    return runner.write_page("study", folder / "study-quick.md", records(change)).read_text()


def verdict(start, change):
    """Verdict and numbers of the claim whose text starts so."""
    results = Results(runner.rows_of(records(change)), QUICK)
    return next((verdict, here) for verdict, text, _, here in (c.judged(results) for c in CLAIMS) if start in text)


def only(key, **changes):
    return lambda case: changes if case.key == key else {}


def of(*methods, **changes):
    return lambda case: changes if case.method in methods else {}


def as_the_paper(case):
    if case.method != "NeRIF" or "tables" not in case.labels:
        return {}
    return {name: paper_value(t, case.phantom, "NeRIF", case.noise) for name, t in (("l2", L2), ("cc", CORRELATION))}


CLASSICAL = ("Tikhonov", "Landweber")
FLIPS = [
    ("CC of NeRIF exceeds", of("NeRIF", cc=0.995), only("5-0.15-nerif", cc=0.989)),
    ("L2 of NeRIF is predominantly", only("1-0-nerif", l2=0.02), of("NeRIF", l2=0.02)),
    ("NeRIF beats Tikhonov", of("NeRIF", l2=0.015), only("3-0-nerif", l2=0.03)),
    ("NeRIF beats Tikhonov", of("NeRIF"), only("3-0-nerif", cc=0.5)),
    ("Robust", of("NeRIF"), only("6-0.15-nerif", l2=0.021)),
    ("voxel methods: SSIM", of(*CLASSICAL, ssim=0.8), of(*CLASSICAL, ssim=0.95)),
    ("voxel methods: CC", of(*CLASSICAL, cc=0.88), of(*CLASSICAL, cc=0.99)),
    ("Slices of NeRIF", of("NeRIF", ssim=0.97), of("NeRIF", ssim=0.9)),
    ("NeRIF converges", of("NeRIF", l2=0.002), of("NeRIF", l2=0.02)),
    ("NeRIF needs just over", of("NeRIF", l2=0.002), of("NeRIF", l2=0.02, time=2000.0)),
    ("The voxel methods need over", of(*CLASSICAL, time=36000.0), of(*CLASSICAL, time=3.0)),
    ("NeRIF runs in about", of("NeRIF", memory=10.0), only("4-0-nerif", memory=30.0)),
    ("The voxel methods need 184", of(*CLASSICAL, memory=184.0), only("4-0-tikhonov", memory=1.0)),
    ("The multi-head", only("gradient-head", l2_variation=0.003), only("gradient-head", l2_variation=0.02)),
    ("Positional", only("octaves-0", l2_variation=0.05), only("octaves-0", l2_variation=0.001)),
    ("Too many octaves overfit, f", only("octaves-7", l2_variation=0.05), only("octaves-7", l2_variation=1e-6)),
    ("Too many octaves overfit, s", only("octaves-7", l2_variation=0.05), only("octaves-7", l2_variation=9, loss=9)),
    ("Random sampling", only("sampling-random", l2_variation=0.004), only("sampling-random", l2_variation=0.04)),
    ("The spatial", only("octahedron-nerif", resolution=resolution(62.0)), of("NeRIF")),
    ("The spatial", only("octahedron-nerif", resolution=resolution(None)),
     only("octahedron-nerif", resolution=resolution(0.0))),
    ("Goal of nerif", as_the_paper, only("2-0.1-nerif", l2=0.0043)),
    ("Not in the paper: NeRIF beats total", of("NeRIF"), only("1-0-tv", l2=0.001)),
    ("Not in the paper: NeRIF beats Tikhonov", of("NeRIF"), only("1-0.1-tv", l2=0.001)),
]  # fmt: skip


@pytest.mark.parametrize(("start", "good", "bad"), FLIPS, ids=[f"{i}-{flip[0]}" for i, flip in enumerate(FLIPS)])
def test_verdicts_flip_when_values_flip(start, good, bad):
    assert verdict(start, good)[0] == VERDICTS[True], verdict(start, good)
    assert verdict(start, bad)[0] == VERDICTS[False], verdict(start, bad)


@pytest.mark.parametrize(
    ("start", "change", "reason"),
    [
        ("CC of", only("3-0.1-nerif", failed="RuntimeError: no memory"), "3-0.1-nerif failed: RuntimeError: no memory"),
        ("CC of", lambda case: None if case.phantom == "7" else {}, "7-0-nerif is not done"),
        ("CC of", only("3-0.1-nerif", cc=None), "cc of 3-0.1-nerif is not a number (the run ended with: time)"),
        ("NeRIF converges", of("NeRIF", l2=0.02, epochs=20.0), "is too short: L2 still 2.000% after 20 epochs"),
    ],
)
def test_what_is_not_tested_has_a_reason(start, change, reason):
    untested, here = verdict(start, change)
    assert untested == VERDICTS[None]
    assert here.endswith(reason)


def test_comparison_is_at_the_digits_of_the_paper():
    assert [worse_than_paper("cc", value, 0.9997) for value in (0.99966, 0.99964)] == [False, True]
    assert [worse_than_paper("l2", value, 0.00585) for value in (0.005854, 0.005856)] == [False, True]


def test_the_page_has_every_section_with_its_labels_and_figures(tmp_path):
    forward = {"lever_arm": {"rms_px": 0.00123, "relative": 0.001}}
    text = page(tmp_path, only("2-0-nerif", forward=forward, l2=0.0050, cc=0.9999))
    for name, heading in SECTIONS.items():
        body = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
        assert "](figures/" in body
        assert all(case.labels[name] in body for case in ALL if name in case.labels and name != "curves")
    assert f"{len(ALL)} of {len(ALL)} reconstructions" in text
    assert "| 2 | ▲ **0.500%** (0.423%) |" in text
    assert "| 2 | 0.9999 (0.9944) |" in text
    assert "| lever_arm | 0.00123 | 0.100% |" in text
    assert not re.search(r"\b(nan|None)\b", text)
    images = re.findall(r"\]\((figures/.*?)\)", text)
    assert sorted(images) == sorted(f"figures/{path.name}" for path in (tmp_path / "figures").iterdir())
    assert len(images) == 14
    assert all("<path" in (tmp_path / image).read_text() for image in images)


def test_failures_and_missing_values_are_on_the_page(tmp_path):
    def change(case):
        if case.phantom == "3":
            return None
        return {"failed": "ValueError: <a> | b"} if case.key == "2-0-nerif" else {}

    text = page(tmp_path, change)
    assert "| 2-0-nerif | ValueError: <a> \\| b |" in text
    assert "| 2 | failed (0.9944) |" in text
    assert "| 3 | – (0.9981) |" in text
    diverged = page(tmp_path, lambda case: dict.fromkeys(("l2", "l2_variation", "cc", "ssim", "loss", "epochs")))
    assert not re.search(r"\b(nan|None)\b|figures/", diverged)
    part = [record for record in records() if "sampling" in record["settings"]["sections"].split()]
    assert f"## {SECTIONS['sampling']}" in (text := "".join(map(str, study.blocks(runner.rows_of(part[:1])))))
    assert f"## {SECTIONS['views']}" not in text


def test_the_study_holds_all_that_the_paper_shows():
    for scale in (FULL, QUICK):
        todo = study_cases(scale)
        assert len({case.key for case in todo}) == len(todo)
        tables = {(case.phantom, case.noise, case.method) for case in todo if "tables" in case.labels}
        assert tables == {(p, n, m) for p in PHANTOMS for n in NOISES for m in METHODS}
        labels = {s: {case.labels[s] for case in todo if s in case.labels} for s in SECTIONS}
        assert labels["model"] == {"lever_arm", "paraxial", "curved"}
        assert {"random", "regular"} < labels["sampling"]
        assert {"3", "9", "18"} <= labels["views"]
        assert (len(labels["differentiation"]), len(labels["network"])) == (2, 3)
    (settings, *_) = runner.select(study, True, changes={"pixels": 12, "device": "cpu"})
    assert study_cases(study.scale_of(settings))[0].ring.image_size == (12, 12)
    assert len({case.data_name for case in study_cases(FULL)}) == len({(c.phantom, c.ring) for c in study_cases(FULL)})


def small(key, reconstructor, **more):
    values = {"phantom": "1", "noise": 0.1, "method": "Tikhonov", "truth_voxels": 12, "labels": {"tables": key}} | more
    ring = Ring(views=4, image_size=(16, 16), pixel_pitch=0.25)
    return Case(key=key, reconstructor=reconstructor, ring=ring, **values)


@pytest.mark.slow
def test_records_describe_the_run(tmp_path):
    shape = NetworkShape(depth=2, width=24, octaves=2)
    nerif = NeRIF(network=shape, samples=(12, 16), sample_jitter=2, points_per_batch=600, max_steps=99, device="cpu")
    run = run_case(small("nerif", nerif, snapshots=True), tmp_path)
    assert (run["outcome"], run["steps"], len(run["slices"])) == ("steps", 99, 10)
    assert run["curve"][-1]["l2"] == pytest.approx(run["l2"])
    assert run["curve"][-1]["l2"] < 0.95 * run["curve"][0]["l2"]
    assert [point["step"] for point in run["curve"]] == sorted({point["step"] for point in run["curve"]})
    tikhonov = Tikhonov(voxels=8, basis="linear", iterations=3, device="cpu")
    run = run_case(small("o", tikhonov, phantom="octahedron", noise=0.0, labels={"model": "lever_arm"}), tmp_path)
    assert run["pixels_per_unit"] == pytest.approx(12.5 / 0.25 * 50 / 700, rel=0.05)
    assert run["resolution"]["lp_per_unit"] >= 0
    errors = [run["forward"][model]["relative"] for model in ("curved", "lever_arm", "paraxial")]
    assert errors == sorted(errors)
    assert errors[-1] < 0.05


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
        outcome, steps = Outcome("steps", "too soon"), [{}] * self.steps
        return Reconstruction(self.field, measurement.box, measurement.n_ambient, steps, outcome, {}, device="meta")


def test_the_device_of_the_field_and_a_run_without_a_step(tmp_path):
    method = OnMeta(voxels=8)
    record = run_case(small("o", method, phantom="octahedron", noise=0.0), tmp_path)
    assert method.field.devices == {"meta"}
    assert not math.isfinite(record["cc"]) or record["cc"] == 0
    with pytest.raises(InputError, match="not a single step was made: too soon"):
        run_case(small("none", OnMeta(voxels=8, steps=0)), tmp_path)
