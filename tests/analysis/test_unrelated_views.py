"""Views that have nothing to do with one another are the worst of findings, and its cause is named; noise is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerif.analysis.consistency import (
    Change,
    Correction,
    check_consistency,
    compare,
    of_one_view,
    orders,
    predicted_by_others,
    repeatable,
    unrelated,
    unrelated_finding,
)
from nerif.analysis.residuals import CAUSES
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Camera, Ring
from nerif.simulation.simulate import simulate

BOX = Box.cube(50.0)
RIGS = sorted(Path(__file__).parents[3].glob("shared/data/rigs/*.nc"))
VOXELS = 12


def measure(cameras=None, phantom: str = "gaussians", noise: float = 0.05, views: int = 4, **ring) -> Measurement:
    given = {"image_size": (24, 24), "pixel_pitch": 0.18, "arc": (0.0, 180.0 - 180.0 / views), **ring}
    cameras = cameras or Ring(views=views, **given).cameras()
    return simulate(make_phantom(phantom, BOX, 1), cameras, BOX, 1.00027, noise, 0, steps=20)


@pytest.fixture(scope="module")
def right() -> Measurement:
    return measure()


def in_metres(camera: Camera) -> Camera:
    return replace(camera, translation=camera.translation / 1000)


def agreements(m: Measurement) -> list[float]:
    return [compare(predicted_by_others(m, [i], VOXELS)[i], m, i)[0] for i in range(len(m.names))]


def test_a_rig_in_metres_is_unrelated_and_the_cause_is_named(right):
    wrong = replace(right, cameras=tuple(in_metres(c) for c in right.cameras))
    reached = agreements(wrong)
    assert unrelated(reached, wrong)
    finding = unrelated_finding(wrong, reached, 8, range(4))
    assert (finding.code, finding.views) == ("unrelated", wrong.names)
    assert "likely translation in metres, where mm are expected: without that the agreement is 0." in finding.sentence


RIGHT = {
    "four views": measure,
    "three views": lambda: measure(views=3),
    "flame": lambda: measure(phantom="flame"),
    "octahedron": lambda: measure(phantom="octahedron", views=3),
    "telecentric": lambda: measure(projection="telecentric"),
    "noise": lambda: measure(noise=1.0),
    "much noise": lambda: measure(noise=3.0),
}


@pytest.mark.parametrize("name", RIGHT)
def test_right_rigs_are_not_unrelated(name):
    measurement = RIGHT[name]()
    assert not unrelated(agreements(measurement), measurement)


def test_noise_alone_is_told_from_a_wrong_rig(right):
    noise = torch.randn(right.displacement.shape, generator=torch.Generator().manual_seed(0))
    assert abs(repeatable(replace(right, displacement=noise))) < 0.1
    assert repeatable(right) > 0.7
    cameras = tuple(c.view(12, 0, 1, 24) for c in right.cameras)
    lines = replace(right, cameras=cameras, displacement=noise[:, 12:13], sigma=None)
    assert abs(repeatable(lines)) < 0.3


@pytest.mark.slow
def test_the_worst_finding_comes_first(right):
    found = check_consistency(replace(right, cameras=tuple(in_metres(c) for c in right.cameras)), voxels=VOXELS)
    assert [finding.code for finding in found.findings] == ["unrelated", "inside"]
    assert all(view.verdict == "not predicted by the others" for view in found.views)
    assert not found.corrections


@pytest.mark.slow
def test_images_sorted_by_letters_are_named():
    """Cameras all around, so that no other order looks alike."""
    generator = torch.Generator().manual_seed(5)
    cameras = []
    for i, camera in enumerate(Ring(views=5, arc=(0.0, 150.0), image_size=(24, 24), pixel_pitch=0.18).cameras()):
        turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
        turn = turn * torch.linalg.det(turn)  # about the middle of the box
        plane = replace(camera.plane, normal=turn.T @ camera.plane.normal)
        cameras.append(replace(camera, rotation=camera.rotation @ turn, background=plane, name=f"cam{8 + i}"))
    straight = measure(cameras)
    assert check_consistency(straight, voxels=VOXELS).findings == ()
    order = [2, 3, 4, 0, 1]  # 10, 11, 12, 8, 9
    (found,) = check_consistency(replace(straight, displacement=straight.displacement[order]), voxels=VOXELS).findings
    assert found.code in ("reordered", "unrelated")
    assert "sorted differently" in found.sentence


def test_every_order_undoes_its_own(right):
    cameras = [replace(c, name=f"cam{8 + i}") for i, c in enumerate(right.cameras)]
    d = right.displacement
    wrong = [2, 3, 0, 1]  # by letters: 10, 11, 8, 9
    assert any(torch.equal(c.undo(d[wrong], cameras), d) for c in orders(cameras))
    assert any(torch.equal(c.undo(d.flip(0), cameras), d) for c in orders(cameras))
    other = [replace(cameras[0], image_size=(20, 24)), *cameras[1:]]
    assert not orders(other)


@pytest.mark.slow
@pytest.mark.skipif(not RIGS, reason="no rigs beside the repository")
def test_rigs_of_files_are_not_unrelated():
    for path in RIGS:
        if "truth" not in path.name:
            codes = [finding.code for finding in check_consistency(Measurement.read(path), voxels=20).findings]
            assert "unrelated" not in codes, path


def test_a_view_that_looks_past_the_box_does_not_end_the_check(right, tmp_path, capsys):
    camera = right.cameras[3]
    away = camera.rotation.new_tensor([1.0, -1.0, -1.0])
    past = replace(camera, rotation=away[:, None] * camera.rotation, translation=away * camera.translation)
    wrong = replace(right, cameras=(*right.cameras[:3], past))
    path = tmp_path / "m.nc"
    wrong.write(path)
    assert main(["check", str(path), "--voxels", "12", "--strict"]) == 1
    said = capsys.readouterr().out
    assert f"FOUND: view {camera.name}: the camera looks past the box; likely axes of OpenGL" in said
    assert "nothing odd" not in said


def code_of(m: Measurement, view: int, change) -> str:
    """What fits a view best of all that may have happened to it, as another view is predicted by the straight ones."""
    d = m.displacement.clone()
    d[view] = change(d[view])
    predicted = predicted_by_others(m, [view], VOXELS)[view]
    ways = of_one_view(view, m.observations[0], m.cameras)
    best = max(ways, key=lambda c: compare(predicted, m, view, c.undo(d, m.cameras)[view])[0])
    return best.code


VIEWS = {
    "upside_down": lambda d: d.flip(0) * torch.tensor([1.0, -1.0]),
    "mirrored": lambda d: d.flip(1) * torch.tensor([-1.0, 1.0]),
    "turned": lambda d: -d.flip(0, 1),
    "transposed": lambda d: d.transpose(0, 1).flip(-1),
    "reversed_axes": lambda d: d.transpose(0, 1).clone(),
    "quarter_turn": lambda d: d.rot90(1, (0, 1)).flip(-1) * torch.tensor([1.0, -1.0]),
}


@pytest.mark.parametrize("code", VIEWS)
def test_what_happened_to_a_image_fits_best(right, code):
    assert code_of(right, 1, VIEWS[code]) == code


@pytest.mark.slow
@pytest.mark.parametrize("code", ["upside_down", "mirrored", "transposed", "quarter_turn"])
def test_what_happened_to_a_image_is_named(code):
    measurement = measure(views=6, image_size=(30, 30), pixel_pitch=0.15)
    d = measurement.displacement.clone()
    d[3] = VIEWS[code](d[3])
    (found,) = check_consistency(replace(measurement, displacement=d), voxels=16).findings
    assert (found.code, found.views) == (code, (measurement.names[3],))


def test_images_that_are_not_square_cannot_be_transposed(right):
    cameras = tuple(replace(c, image_size=(24, 20)) for c in right.cameras)
    codes = {c.code for c in of_one_view(0, right.observations[0], cameras)}
    assert "mirrored" in codes
    assert not codes & {"transposed", "quarter_turn", "reversed_axes"}


def test_undoing_a_change_reads_no_pixel_that_is_already_changed(right):
    change = Change("reversed_axes", "", lambda d: d.transpose(0, 1))
    d = right.displacement
    undone = Correction((1,), change.code, change.words, change.undo).undo(d, right.cameras)
    assert torch.equal(undone[1], d[1].transpose(0, 1))


def test_a_view_seen_from_elsewhere_is_sent_to_the_check_first():
    words = CAUSES["calibration"]
    assert words.index("nerif check") < words.index("--refine cameras")
