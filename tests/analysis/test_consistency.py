"""`nerif check`: mistakes in a measurement are detected, named and corrected; a correct one has no findings."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scipy.ndimage import gaussian_filter

from nerif.analysis import image_edges
from nerif.analysis.consistency import (
    Change,
    Correction,
    binned,
    check_consistency,
    compare,
    fit,
    image_remarks,
    independent_samples,
    of_one_view,
    open_faces,
    orders,
    predicted_by_others,
    repeatability,
    unrelated,
    without_spikes,
)
from nerif.analysis.image_edges import cut_edges
from nerif.analysis.remedies import CAUSES, advice
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Camera, Ring, paper_rig
from nerif.simulation.simulate import simulate

BOX = Box.cube(50.0)
COARSE = 12  # voxels


def measure(phantom: str, seed: int, noise: float = 0.05, box: Box = BOX, height: int = 30) -> Measurement:
    ring = Ring(views=6, arc=(0.0, 150.0), image_size=(height, 36), pixel_pitch=0.12)
    field = make_phantom(phantom, box, seed)
    return replace(simulate(field, ring.cameras(), box, 1.00027, noise, seed, steps=30), box=BOX)


@pytest.fixture(scope="module")
def clean() -> Measurement:
    """Balls without symmetry in six views."""
    return measure("gaussians", 1)


def spoilt(clean: Measurement, mistake) -> Measurement:
    return replace(clean, displacement=mistake(clean.displacement.clone()))


def in_view(i, change):
    def mistake(d):
        d[i] = change(d[i])
        return d

    return mistake


def exchanged(i, j):
    def mistake(d):
        d[[i, j]] = d[[j, i]]
        return d

    return mistake


U, V = torch.tensor([-1.0, 1.0]), torch.tensor([1.0, -1.0])  # flipped signs of u and v
MISTAKES = {
    "swapped": (in_view(2, lambda d: d.flip(-1)), "view 60deg: u and v are swapped"),
    "sign": (in_view(1, lambda d: -d), "view 30deg: the sign of the displacement is flipped"),
    "sign of v": (in_view(4, lambda d: d * V), "view 120deg: the sign of v is flipped"),
    "mirrored": (in_view(3, lambda d: d.flip(1) * U), "view 90deg: the image is mirrored left to right"),
    "upside down": (in_view(3, lambda d: d.flip(0) * V), "view 90deg: the image is upside down"),
    "exchanged": (exchanged(1, 4), "views 30deg and 120deg: these two views are exchanged"),
    "swapped everywhere": (lambda d: d.flip(-1), "all views: u and v are swapped"),
    "sign of v everywhere": (lambda d: d * V, "all views: the sign of one component"),
    "too large": (in_view(2, lambda d: 2.5 * d), "view 60deg: displacement 2."),
    "all signs flipped": (lambda d: -d, ""),  # a denser flow
}


@pytest.mark.slow  # the quick one is test_the_command_names_the_view
@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named(clean, name):
    mistake, sentence = MISTAKES[name]
    outcome = check_consistency(spoilt(clean, mistake), voxels=20)
    assert len(outcome.findings) == bool(sentence)
    assert all(finding.sentence.startswith(sentence) for finding in outcome.findings)
    assert any("denser" in remark for remark in outcome.remarks) == (not sentence)
    assert len(outcome.views) == 6


@pytest.mark.slow
def test_exchanged_neighbours_of_nine_are_detected():
    ring = Ring(views=9, arc=(0.0, 170.0), image_size=(40, 48), pixel_pitch=0.09)
    correct = simulate(make_phantom("flame", BOX, 0), ring.cameras(), BOX, 1.00027, 0.05, 0, steps=30)
    assert check_consistency(correct).findings == ()
    check = check_consistency(spoilt(correct, exchanged(3, 4)))
    assert [(f.code, f.views) for f in check.findings] == [("exchanged", ("63.75deg", "85deg"))]


@pytest.mark.slow
@pytest.mark.parametrize("other", ["flow", "noise"])
def test_a_view_of_another_flow_or_of_noise_is_named(clean, other):
    noise = 0.04 * torch.randn(clean.displacement.shape[1:], generator=torch.Generator().manual_seed(0))
    values = noise if other == "noise" else measure("gaussians", 3).displacement[2]
    check = check_consistency(spoilt(clean, in_view(2, lambda d: values)), voxels=20)
    assert "60deg" in [v.name for v in check.views if v.verdict]
    assert other == "flow" or ("unlike", ("60deg",)) in [(f.code, f.views) for f in check.findings]


@pytest.mark.parametrize(
    ("phantom", "seed", "noise", "few"),
    [("flame", 0, 0.05, True), pytest.param("flame", 0, 0.05, False, marks=pytest.mark.slow),
     pytest.param("gaussians", 2, 0.15, False, marks=pytest.mark.slow),
     pytest.param("gaussians", 0, 0.05, False, marks=pytest.mark.slow)],
)  # fmt: skip
def test_no_false_alarm(phantom, seed, noise, few):
    measurement = square(phantom=phantom, views=3) if few else measure(phantom, seed, noise=noise)
    check = check_consistency(measurement, voxels=8 if few else 20)
    assert check.findings == ()
    assert all(v.verdict == "" for v in check.views)
    assert any("lighter" in r for r in check.remarks)


# -- open faces ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blur", [0.0, 1.0])  # of windows, over the edges at the ends
def test_a_flame_that_ends_at_the_box_has_no_open_face(blur):
    cameras, box = paper_rig(32)
    m = simulate(make_phantom("flame", box, 0), cameras[::2], box, 1.00027, steps=30)
    m = replace(m, displacement=torch.from_numpy(gaussian_filter(m.displacement.numpy(), (0, blur, blur, 0))))
    assert open_faces(fit(m, 24, 3e-3)[0], m) == []


def test_a_plume_that_ends_at_the_box_has_no_open_face():
    m = square(phantom="plume", views=6, image_size=(30, 30), pixel_pitch=0.13, noise=0.02)
    assert open_faces(fit(m, 20)[0], m, 20) == []


@pytest.fixture(scope="module")
def tall() -> Measurement:
    """A flame twice as tall as the box it is reconstructed in."""
    return measure("flame", 0, box=Box((-25.0, -25.0, -50.0), (25.0, 25.0, 50.0)), height=44)


def test_open_faces_show_in_the_rays_through_them(tall):
    below, above = open_faces(fit(tall, 20, 3e-3)[0], tall)
    assert below.code == above.code == "open_face"
    assert below.sentence.startswith("face z-")
    assert "--open-faces z+" in above.sentence


# -- images of a part of the flow ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("phantom", "views"), [("flame", 1), ("plume", 3), ("gaussian-jet", 3), ("fire", 2)])
@pytest.mark.parametrize(("pitch", "sides"), [(0.04, {"left", "right"}), (0.2, set())])
def test_edges_that_cut_the_flow(phantom, views, pitch, sides):
    m = square(phantom=phantom, views=views, image_size=(20, 20), pixel_pitch=pitch, noise=0.02)
    edges = cut_edges(m, m.observations[0])
    assert {edge.side for edge in edges} == sides
    assert {edge.view for edge in edges} == (set(range(views)) if sides else set())


@pytest.mark.parametrize(("pitch", "sides"), [(0.02, {"left", "right"}), (0.1, set())])
def test_edges_of_large_images_are_those_of_their_bins(pitch, sides, monkeypatch):
    monkeypatch.setattr(image_edges, "PIXELS", 20)
    m = square(phantom="flame", views=1, image_size=(41, 40), pixel_pitch=pitch, noise=0.02)
    valid = torch.ones(m.shape, dtype=torch.bool)
    valid[:, 20, 20] = False  # its bin has three pixels
    assert {edge.side for edge in cut_edges(replace(m, valid=valid), m.observations[0])} == sides


def test_a_shaken_camera_or_noise_cuts_nothing(small):
    noise = torch.randn(small.displacement.shape, generator=torch.Generator().manual_seed(0))
    for values in (small.displacement + torch.tensor([1.5, -0.7]), noise, torch.zeros_like(noise)):
        m = replace(small, displacement=values)
        assert cut_edges(m, m.observations[0]) == []


def test_views_of_a_part_of_the_flow_accuse_nothing():
    m = square(phantom="flame", views=3, image_size=(20, 20), pixel_pitch=0.04, noise=0.02)
    outcome = check_consistency(m, voxels=8)
    assert (outcome.findings, outcome.corrections) == ((), {})
    start = "the images show only 6% of the box, and the displacement does not fall to zero"
    assert outcome.remarks[0].startswith(start)


# -- the maps by themselves ---------------------------------------------------------------------------------------


def test_two_views_or_views_of_nothing_are_no_error(clean):
    for measurement, remark in (
        (clean.select(clean.names[:2]), "fewer than three views"),
        (spoilt(clean.select(clean.names[:3]), torch.zeros_like), "every displacement of rays through the box is 0"),
    ):
        check = check_consistency(measurement, voxels=8)
        assert check.views == check.findings == ()
        assert check.remarks[-1].startswith(remark)


@pytest.mark.slow
def test_camera_shake_and_missing_pixels_are_remarks(clean):
    shaken = spoilt(clean, in_view(2, lambda d: d + torch.tensor([1.5, 0.0])))
    valid = torch.ones(shaken.displacement.shape[:3], dtype=torch.bool)
    valid[0, :20] = False
    outcome = check_consistency(replace(shaken, valid=valid), voxels=20)
    assert any("view 60deg: displacement at the border (1." in r for r in outcome.remarks)
    assert any("view 0deg: only 33% valid pixels" in r for r in outcome.remarks)


def test_bins_need_not_be_square():
    """Beside a camera of two rows, bins have two rows and six columns."""
    ring = Ring(views=2, arc=(0.0, 90.0), image_size=(60, 240), pixel_pitch=0.02)
    line, sheet = ring.cameras()
    displacement = torch.full((2, 60, 240, 2), torch.nan)
    displacement[0, :2], displacement[1] = 0.0, torch.tensor([0.3, 0.6])
    whole = Measurement((replace(line, image_size=(2, 240)), sheet), displacement, BOX, 1.00027)
    small = binned(whole, 40)
    assert [camera.image_size for camera in small.cameras] == [(1, 40), (30, 40)]
    (remark,) = image_remarks(whole, small, [1.0, 1.0])
    assert "at the border (0.30, 0.60) px" in remark


def test_a_small_flow_among_zeros_is_no_spike(clean):
    d = torch.zeros_like(clean.displacement)
    d[:, 14:17, 14:22] = clean.displacement[:, 14:17, 14:22]  # 2 % of the pixels
    d[0, 0, 0] = 1e4
    values = without_spikes(spoilt(clean, lambda _: d)).displacement
    assert values[0, 0, 0].isnan().all()
    d[0, 0, 0] = torch.nan
    assert torch.equal(values.isnan(), d.isnan())


@pytest.mark.parametrize("step", [2, 4, 8])
def test_binning_keeps_sparse_vectors(clean, step):
    sparse = torch.full_like(clean.displacement, torch.nan)
    sparse[:, ::step, ::step] = clean.displacement[:, ::step, ::step]
    sparse[2] = clean.displacement[2]
    sparse[2, :2, :4] = torch.nan
    sparse[2, 0, 0] = 1.0
    small = binned(spoilt(clean, lambda _: sparse), 18)
    assert int(small.usable[0].sum()) == -(-30 // step) * -(-36 // step)
    assert small.usable[2, 0, :2].tolist() == [False, False]  # of a dense view, squares without half of their pixels
    torch.testing.assert_close(small.displacement[0, 0, 0], sparse[0, 0, 0] / 2)


def test_binning_keeps_rays_and_displacements():
    rings = [
        Ring(views=3, arc=(0.0, 90.0), image_size=s, pixel_pitch=p) for s, p in (((60, 72), 0.06), ((30, 36), 0.12))
    ]
    fine, coarse = (simulate(make_phantom("gaussians", BOX, 1), r.cameras(), BOX, 1.00027, steps=30) for r in rings)
    small = binned(fine, 36)
    assert small.displacement.shape == (3, 30, 36, 2)
    for a, b in zip(small.cameras, coarse.cameras, strict=True):
        assert torch.allclose(a.intrinsics, b.intrinsics)
    error = (small.displacement - coarse.displacement).square().mean().sqrt()
    assert float(error) < 0.05 * float(coarse.displacement.square().mean().sqrt())


# -- chance -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("width", [0.0, 1.0, 2.0])
def test_independent_samples_of_noise(channels, width):
    """Of noise blurred by a Gaussian, an area of 2 pi width^2 has one."""
    counts = []
    for seed in range(4):
        noise = torch.randn(60, 70, channels, generator=torch.Generator().manual_seed(seed)).numpy()
        counts.append(independent_samples(torch.from_numpy(gaussian_filter(noise, (width, width, 0)))))
    assert sum(counts) / 4 == pytest.approx(60 * 70 / max(1.0, 2 * torch.pi * width**2), rel=0.25)


def test_no_correction_is_a_matter_of_chance(small):
    """Of images of noise, the best of all hypotheses gains, but not more than chance gives."""
    m = small.select(small.names[:3])
    noise = torch.randn(m.displacement.shape, generator=torch.Generator().manual_seed(0)).numpy()
    noise = torch.from_numpy(gaussian_filter(noise, (0, 2, 2, 0)))
    noise[:, [0, 1, 2, -3, -2, -1]], noise[:, :, [0, 1, 2, -3, -2, -1]] = 0.0, 0.0
    assert not check_consistency(replace(m, displacement=noise), voxels=8).corrections


# -- corrections --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mirrored", "exchanged"])
def test_mistakes_are_corrected(clean, tmp_path, capsys, name):
    """In values, sigma and masks; a measurement without mistakes is not written again."""
    mask = torch.rand(clean.usable.shape, generator=torch.Generator().manual_seed(0)) > 0.05
    correct = replace(clean, flow_mask=mask)
    mistake = in_view(3, lambda x: x.flip(1)) if name == "mirrored" else exchanged(1, 4)
    maps = {key: mistake(getattr(correct, key).clone()) for key in ("displacement", "sigma", "flow_mask")}
    if name == "mirrored":
        maps["displacement"][3, ..., 0] *= -1
    path, out = tmp_path / "m.nc", tmp_path / "corrected.nc"
    replace(correct, **maps).write(path)
    assert main(["check", str(path), "-o", str(out)]) == 0
    result = Measurement.read(out)
    torch.testing.assert_close(result.displacement, correct.displacement.float())
    torch.testing.assert_close(result.sigma, correct.sigma.float())
    assert torch.equal(result.flow_mask, mask)
    assert main(["check", str(path), "-o", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["check", str(out), "-o", str(tmp_path / "again.nc")]) == 2
    assert "nothing was found" in capsys.readouterr().err
    assert not (tmp_path / "again.nc").exists()


@pytest.mark.slow
def test_the_command_names_the_view(clean, tmp_path, capsys):
    path = tmp_path / "m.nc"
    spoilt(clean.select(clean.names[::2]), in_view(1, lambda d: -d)).write(path)
    assert main(["check", str(path), "--voxels", str(COARSE), "--strict"]) == 1
    assert "FOUND: view 60deg: the sign of the displacement is flipped" in capsys.readouterr().out
    assert main(["check", str(path), "--voxels", "3"]) == 2
    assert main(["check", str(tmp_path / "none.nc")]) == 2


def square(cameras=None, phantom: str = "gaussians", noise: float = 0.05, views: int = 4, **ring) -> Measurement:
    ring = {"image_size": (24, 24), "pixel_pitch": 0.18, "arc": (0.0, 180.0 - 180.0 / views), **ring}
    cameras = cameras or Ring(views=views, **ring).cameras()
    return simulate(make_phantom(phantom, BOX, 1), cameras, BOX, 1.00027, noise, 0, steps=20)


@pytest.fixture(scope="module")
def small() -> Measurement:
    return square()


TRANSFORMS = {
    "upside_down": lambda d: d.flip(0) * V,
    "mirrored": lambda d: d.flip(1) * U,
    "turned": lambda d: -d.flip(0, 1),
    "transposed": lambda d: d.transpose(0, 1).flip(-1),
    "reversed_axes": lambda d: d.transpose(0, 1).clone(),
    "quarter_turn": lambda d: d.rot90(1, (0, 1)).flip(-1) * V,
}


@pytest.mark.parametrize("code", TRANSFORMS)
def test_the_transform_of_an_image_fits_best(small, code):
    d = in_view(1, TRANSFORMS[code])(small.displacement.clone())
    predicted = predicted_by_others(small, [1], COARSE)[1]
    corrections = of_one_view(1, small.observations[0], small.cameras)
    best = max(corrections, key=lambda c: compare(predicted, small, 1, c.undo(d, small.cameras)[1])[0])
    assert best.code == code


def test_transforms_of_square_images_only(small):
    cameras = tuple(replace(c, image_size=(24, 20)) for c in small.cameras)
    codes = {c.code for c in of_one_view(0, small.observations[0], cameras)}
    assert "mirrored" in codes
    assert not codes & {"transposed", "quarter_turn", "reversed_axes"}


def test_a_correction_reads_unchanged_pixels_only(small):
    change = Change("reversed_axes", "", lambda d: d.transpose(0, 1))
    d = small.displacement
    undone = Correction((1,), change.code, change.words, change.undo).undo(d, small.cameras)
    assert torch.equal(undone[1], d[1].transpose(0, 1))


def test_every_order_is_undone_by_its_correction(small):
    cameras = [replace(c, name=f"cam{8 + i}") for i, c in enumerate(small.cameras)]
    d = small.displacement
    by_letters = [2, 3, 0, 1]  # 10, 11, 8, 9
    assert any(torch.equal(c.undo(d[by_letters], cameras), d) for c in orders(cameras))
    assert any(torch.equal(c.undo(d.flip(0), cameras), d) for c in orders(cameras))
    assert not orders([replace(cameras[0], image_size=(20, 24)), *cameras[1:]])


# -- unrelated views ----------------------------------------------------------------------------------------------


def in_metres(m: Measurement) -> Measurement:
    return replace(m, cameras=tuple(replace(c, translation=c.translation / 1000) for c in m.cameras))


def agreements(m: Measurement) -> list[float]:
    return [compare(predicted_by_others(m, [i], COARSE)[i], m, i)[0] for i in range(len(m.names))]


CORRECT = [
    {}, {"views": 3}, {"phantom": "flame"}, {"phantom": "octahedron", "views": 3}, {"projection": "telecentric"},
    {"noise": 1.0}, {"noise": 3.0},
]  # fmt: skip


@pytest.mark.parametrize("settings", CORRECT, ids=str)
def test_correct_rigs_are_not_unrelated(settings):
    measurement = square(**settings)
    assert not unrelated(agreements(measurement), measurement)


def test_noise_is_not_repeatable(small):
    noise = torch.randn(small.displacement.shape, generator=torch.Generator().manual_seed(0))
    assert abs(repeatability(replace(small, displacement=noise))) < 0.1
    assert repeatability(small) > 0.7
    cameras = tuple(c.view(12, 0, 1, 24) for c in small.cameras)
    lines = replace(small, cameras=cameras, displacement=noise[:, 12:13], sigma=None)
    assert abs(repeatability(lines)) < 0.3


@pytest.mark.slow
def test_unrelated_views_are_the_first_finding(small):
    outcome = check_consistency(in_metres(small), voxels=COARSE)
    assert [finding.code for finding in outcome.findings] == ["unrelated", "inside"]
    assert "likely translation in metres, where mm are expected: without" in outcome.findings[0].sentence
    assert all(view.verdict == "not predicted by the others" for view in outcome.views)
    assert not outcome.corrections


@pytest.mark.slow
def test_images_sorted_by_letters_are_named():
    """With cameras all around, so that no other order is similar."""
    generator = torch.Generator().manual_seed(5)
    cameras: list[Camera] = []
    for i, camera in enumerate(Ring(views=5, arc=(0.0, 150.0), image_size=(24, 24), pixel_pitch=0.18).cameras()):
        turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
        turn = turn * torch.linalg.det(turn)  # about the centre of the box
        plane = replace(camera.plane, normal=turn.T @ camera.plane.normal)
        cameras.append(replace(camera, rotation=camera.rotation @ turn, background=plane, name=f"cam{8 + i}"))
    correct = square(cameras)
    assert check_consistency(correct, voxels=COARSE).findings == ()
    order = [2, 3, 4, 0, 1]  # 10, 11, 12, 8, 9
    (check,) = check_consistency(spoilt(correct, lambda d: d[order]), voxels=COARSE).findings
    assert check.code in ("reordered", "unrelated")
    assert "in alphabetical order (10 before 2)" in check.sentence


@pytest.mark.slow
def test_a_view_that_looks_past_the_box_does_not_end_the_check(small, tmp_path, capsys):
    camera = small.cameras[3]
    away = camera.rotation.new_tensor([1.0, -1.0, -1.0])
    past = replace(camera, rotation=away[:, None] * camera.rotation, translation=away * camera.translation)
    path = tmp_path / "m.nc"
    replace(small, cameras=(*small.cameras[:3], past)).write(path)
    assert main(["check", str(path), "--voxels", "12", "--strict"]) == 1
    assert f"FOUND: view {camera.name}: the camera looks past the box; likely axes of OpenGL" in capsys.readouterr().out


def test_a_wrong_pose_is_checked_before_it_is_refined():
    text = advice(CAUSES["calibration"].remedies, {})
    assert text.index("nerif check") < text.index("--refine cameras")
