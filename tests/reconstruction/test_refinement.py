"""A rig refined with the field: what a step sees, what it finds, what is held, and what a run keeps of it."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch

from nerif.analysis.alignment import MovedField, aligned
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.forward.absorption import Absorption
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Box, Grid, Lens, Ring
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.imaging.calibration.cameras_file import read_cameras
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.rig.numbers import NAMES, displaced
from nerif.reconstruction.rig.refined import moved_lines, with_corrections
from nerif.reconstruction.rig.refinement import Refinement
from nerif.reconstruction.target import Target
from nerif.simulation.simulate import simulate
from refusals import refused

BOX = Box((-20.0,) * 3, (20.0,) * 3)
RING = Ring(views=5, arc=(0.0, 144.0), image_size=(24, 26), pixel_pitch=0.15)
BALLS = make_phantom("gaussians", BOX, 2)


@pytest.fixture(scope="module")
def measured() -> Measurement:
    return simulate(BALLS, RING.cameras(), BOX, 1.00027, 0.02, 1, 40)


def predict(part, rays):
    return project(PathIntegral(part.model.integral, 60), BALLS, rays)


def in_sigmas(measurement):
    """All pixels, residuals in units of sigma."""
    target = Target.of(measurement)
    unit = math.sqrt(target.chi_square)
    return [replace(part, inverse_scale=part.inverse_scale * unit) for part in target.parts]


def spoiled(measurement, seed=0):
    """The measurement with cameras that stand elsewhere than it says, and images that are shifted; by how much."""
    sizes = torch.tensor([5e-4] * 3 + [0.5] * 3 + [0.0, 0.0] + [0.03] * 2 + [0.0] * 4, dtype=torch.float64)
    count = len(measurement.cameras)
    true = torch.randn(count, len(NAMES), generator=torch.Generator().manual_seed(seed)).double() * sizes
    calibrated = Corrections(measurement.cameras, -true[:, : len(GEOMETRY)]).corrected  # to first order
    shift = true[:, None, None, 8:10].float()
    return replace(measurement, cameras=calibrated, displacement=measurement.displacement + shift), true


@pytest.mark.parametrize("lens", [None, pytest.param(Lens(5.0), marks=pytest.mark.slow)])
def test_what_a_number_changes_is_what_other_cameras_see(measured, lens):
    """Each derivative against finite differences of the cameras themselves, traced anew."""
    cameras = tuple(replace(camera, lens=lens) for camera in measured.cameras)
    measured = replace(measured, cameras=cameras)
    refinement = Refinement.asked(measured, ["cameras", "focal,background", "shift"], 0.2, 0.02, 0.05)
    assert len(refinement.columns) == len(NAMES)
    drawn = torch.randn(refinement.sigma.shape, generator=torch.Generator().manual_seed(0))
    refinement.values = 0.3 * refinement.sigma * drawn
    (part,) = in_sigmas(measured)
    part = part[torch.arange(0, len(part), 7)]
    inverse = part.inverse_scale
    steps = refinement._steps()

    def seen(values):
        corrected = Corrections(measured.cameras, values[:, : len(GEOMETRY)]).corrected
        pixels = [part.rays.pixel[part.rays.view == i].double() for i in range(len(corrected))]
        traced = [c.rays(p, True, i).clip(BOX) for i, (c, p) in enumerate(zip(corrected, pixels, strict=True))]
        moved = [rays.to(dtype=torch.float32) for rays in traced]
        found = torch.cat([predict(part, rays) for rays in moved])
        size = torch.tensor(RING.image_size[::-1]).float()
        place = (part.rays.pixel - (size - 1) / 2) / (size.max() / 2)
        return (found + displaced(values[:, 8:].float()[part.rays.view.long()], place) - part.measured) * inverse

    normal, right = refinement.normal_equations([part], predict, known=False)
    whole, pull = torch.zeros_like(normal), torch.zeros_like(right)
    now, slopes = seen(refinement.values), []
    for i in range(len(NAMES)):
        step = torch.zeros_like(steps)
        step[:, i] = steps[:, i]
        there = seen(refinement.values + step)
        assert torch.allclose(refinement.residual(part, refinement.values + step, predict)[0], there, atol=0.02)
        slopes.append((there - now) / steps[:, i].float()[part.rays.view.long()][:, None])
    jacobian = torch.stack(slopes, -1).double()
    for v in range(len(cameras)):
        own = part.rays.view == v
        j, r = jacobian[own].flatten(0, 1), now[own].double().flatten()
        each = 1 / (float(r.square().mean()) * 21)
        whole[v], pull[v] = each * j.T @ j, -each * j.T @ r
    size = whole.diagonal(dim1=1, dim2=2).sqrt()
    clear = [i for i, name in enumerate(NAMES) if name != "background"]  # which moves a pixel by a thousandth of itself
    wrong = ((normal - whole) / size[:, :, None] / size[:, None])[:, clear][:, :, clear]
    assert float(wrong.abs().max()) < 0.02
    assert float(((right - pull) / size)[:, clear].abs().max()) < 0.02 * float((pull / size).abs().max())


@pytest.mark.slow
def test_cameras_and_shifts_are_found_where_the_field_is_known(measured):
    wrong, _ = spoiled(measured)
    refinement = Refinement.asked(wrong, ["cameras,shift"], 0.5, 0.03, 0.03, gauged=False)
    parts = in_sigmas(wrong)
    before, _ = refinement.residual(parts[0], refinement.values, predict)
    for _ in range(8):
        refinement.step(parts, predict, momentum=0.0)
    after, _ = refinement.residual(parts[0], refinement.values, predict)
    assert float(before.square().mean()) > 5
    assert float(after.square().mean()) < 1.1
    centre = torch.zeros(1, 3, dtype=torch.float64)
    for found, right, start in zip(refinement.corrected, measured.cameras, wrong.cameras, strict=True):
        left = float((found.project(centre) - right.project(centre)).norm())
        assert left < max(0.1 * float((start.project(centre) - right.project(centre)).norm()), 0.03)
    table = refinement.table()
    mended = with_corrections(wrong, table)
    assert torch.allclose(mended.cameras[1].rotation, refinement.corrected[1].rotation)
    u = torch.tensor([row["values"]["u"] for row in table])
    assert torch.allclose(wrong.displacement[:, 12, 12, 0] - mended.displacement[:, 12, 12, 0], u.float(), atol=0.02)


def test_what_is_not_told_stays_at_the_prior(measured):
    """A field of nothing tells nothing; of noise alone no camera moves by more than a share of its sigma."""
    drawn = torch.randn(measured.displacement.shape, generator=torch.Generator().manual_seed(1))
    wrong = replace(measured, displacement=1e-3 * drawn)
    refinement = Refinement.asked(wrong, ["cameras"], 0.5, 0.03, 0.03)
    for _ in range(5):
        refinement.step(in_sigmas(wrong), lambda part, rays: torch.zeros(len(rays), 2))
    assert float(refinement.values.abs().max()) == 0


@pytest.mark.slow
def test_nothing_is_moved_before_the_data_show_that_the_rig_is_off(measured):
    right = Refinement.asked(measured, ["cameras"])
    wrong = Refinement.asked(spoiled(measured)[0], ["cameras", "shift"], 0.5, 0.03, 0.03)
    for _ in range(4):
        right.step(in_sigmas(measured), predict, ask=1.0)
    assert not right.off
    assert float(right.values.abs().max()) == 0
    for _ in range(2):
        assert float(wrong.values.abs().max()) == 0
        wrong.step(in_sigmas(spoiled(measured)[0]), predict, ask=1.0)
    assert wrong.off
    assert float(wrong.values.abs().max()) > 0
    again = Refinement.asked(measured, ["cameras", "shift"])
    again.restore(wrong.kept())
    assert again.off
    table = right.table()
    assert moved_lines(table) == ["refined 5 views: the data show no sign that one is off, so none was moved"]


def test_the_rigid_motion_of_all_cameras_is_taken_out(measured):
    refinement = Refinement.asked(measured, ["cameras"], 0.5, 0.03, 0.03)
    turn, shift = torch.tensor([1e-3, -2e-3, 1e-3]).double(), torch.tensor([0.3, 0.1, -0.2]).double()
    moved = []
    for camera in measured.cameras:
        centre = camera.centre + torch.linalg.cross(turn, camera.centre) + shift
        turns = -camera.rotation @ turn
        moved.append(torch.cat([turns, camera.rotation @ (centre - camera.centre), torch.zeros(8).double()]))
    assert float(refinement._centred(torch.stack(moved))[:, :6].abs().max()) < 1e-6
    one = torch.zeros(len(moved), len(NAMES), dtype=torch.float64)
    one[2, 4] = 1.0
    assert float(refinement._centred(one)[2, 4]) > 0.5


def test_a_stretch_of_all_images_alike_is_taken_out_and_that_of_one_is_not(measured):
    refinement = Refinement.asked(measured, ["shift"])
    alike = torch.zeros(len(measured.cameras), len(NAMES), dtype=torch.float64)
    for name in ("u_x", "v_y"):
        alike[:, NAMES.index(name)] = 0.01
    assert float(refinement._centred(alike).abs().max()) < 1e-12
    for name in ("u", "v", "u_y", "v_x"):  # no field does that in every view
        other = torch.zeros_like(alike)
        other[:, NAMES.index(name)] = 0.01
        assert torch.equal(refinement._centred(other), other)
    one = torch.zeros_like(alike)
    one[2, NAMES.index("u_x")] = 0.01
    assert float(refinement._centred(one)[2, NAMES.index("u_x")]) == pytest.approx(0.008)


def test_a_shift_of_images_is_not_overshot(measured):
    """Two steps against the field as it is find it; a third stays there."""
    shift = torch.tensor([0.4, -0.3])
    wrong = replace(measured, displacement=measured.displacement + shift)
    refinement = Refinement.asked(wrong, ["shift"], px=0.5)
    for _ in range(3):
        refinement.step(in_sigmas(wrong), predict)
        found = refinement.values[:, [NAMES.index("u"), NAMES.index("v")]]
        assert float((found - shift).abs().max()) < 0.03


def test_views_that_are_fewer_are_moved_as_themselves(measured):
    refinement = Refinement.asked(measured, ["cameras"], 0.5, 0.03, 0.03)
    refinement.restore({**refinement.kept(), "values": torch.randn(5, 14).double() * refinement.sigma})
    (part,) = in_sigmas(measured)
    own = part[part.rays.view == 3]
    alone = replace(own, rays=replace(own.rays, view=torch.zeros_like(own.rays.view)))
    expected, found = refinement.of(own).rays, refinement.of(alone, [3]).rays
    assert torch.equal(expected.origin, found.origin)
    assert torch.equal(found.view, alone.rays.view)


def test_a_run_refines_and_resumes_as_if_undisturbed(measured):
    wrong, _ = spoiled(measured)
    settings = NeRIF(max_steps=8, points_per_batch=1024, refine=("cameras", "shift"), pose_sigma_mm=0.5, device="cpu")
    whole = settings(wrong)
    parted = settings(wrong, on_step=lambda step: step.step == 4)
    assert parted.outcome.reason == "interrupted"
    again = settings(wrong, resume=parted.state)
    for name, value in whole.field.network.state_dict().items():
        assert torch.equal(value, again.field.network.state_dict()[name]), name
    assert [row["name"] for row in whole.rig] == list(wrong.names)
    for a, b in zip(whole.rig, again.rig, strict=True):
        assert list(a["values"].values()) == pytest.approx(list(b["values"].values()), rel=1e-6, abs=1e-12)
    assert max(row["moved"] for row in whole.rig) > 0
    assert NeRIF(max_steps=5, points_per_batch=2048, device="cpu")(wrong).rig == []


def test_a_checkpoint_without_a_refined_rig_is_not_gone_on_with_and_the_other_way_round(measured):
    plain = NeRIF(max_steps=2, points_per_batch=512, device="cpu")
    moved = replace(plain, refine=("cameras",))
    for before, after in ((plain, moved), (moved, plain)):
        state = before(measured).state
        with refused("refine"):
            after(measured, resume=state)


def test_every_technique_tells_whether_a_view_is_off(measured):
    """One that shows nothing does not hide what another shows."""
    wrong = replace(measured, displacement=measured.displacement + 0.5)
    (part,) = in_sigmas(wrong)
    blind = replace(part, measured=torch.zeros_like(part.measured), inverse_scale=1e-3 * part.inverse_scale)
    alone, both = (Refinement.asked(wrong, ["shift"], px=0.5) for _ in range(2))
    alone.normal_equations([part], predict)
    both.normal_equations([part, blind], predict)
    torch.testing.assert_close(both.explained, alone.explained, rtol=0.05, atol=0.05)
    assert float(alone.explained.min()) > 0.9


def test_without_a_limit_the_rays_withheld_are_seen_by_the_refined_rig(measured):
    wrong, _ = spoiled(measured)
    data = TrainingData(NeRIF(refine=("cameras",), device="cpu"), wrong, judged=True)
    held = data.withheld.parts[0]
    data.refinement.restore({**data.refinement.kept(), "values": torch.ones(5, 14).double() * data.refinement.sigma})
    moved = data.refined(held, withheld=True)
    assert float((moved.rays.origin - held.rays.origin).norm(dim=1).min()) > 0.05


@pytest.mark.parametrize(
    ("options", "words"),
    [({"refine": ("lens",)}, "refine: expected some of cameras, focal, background, shift, got 'lens'"),
     ({"refine": ("cameras",), "pose_sigma_mm": 0.0}, "pose_sigma_mm: expected a standard deviation above 0"),
     ({"refine": ("cameras",), "shift_sigma_px": math.nan}, "shift_sigma_px: expected a standard deviation")],
)  # fmt: skip
def test_what_cannot_be_refined_is_refused(options, words):
    with pytest.raises(InputError, match=words):
        NeRIF(**options)


def test_a_pose_sigma_that_refines_nothing_is_refused(measured):
    cameras = tuple(replace(camera, pose_sigma=torch.zeros(6)) for camera in measured.cameras)
    with refused("pose_sigma"):
        Refinement.asked(replace(measured, cameras=cameras), ["cameras"])
    with refused("pose_sigma of view '0deg'"):
        replace(cameras[0], pose_sigma=-torch.ones(6))


def test_what_is_given_goes_before_what_cameras_know_and_that_before_the_default(measured):
    cameras = (replace(measured.cameras[0], pose_sigma=torch.arange(6) / 10), *measured.cameras[1:])
    known = replace(measured, cameras=cameras)
    sigma = Refinement.asked(known, ["cameras"]).sigma[:, :6]
    assert sigma[0].tolist() == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert sigma[1].tolist() == pytest.approx([math.radians(0.02)] * 3 + [0.2] * 3)
    assert Refinement.asked(known, ["cameras"], mm=1.0).sigma[0, :6].tolist() == pytest.approx([0, 0.1, 0.2, 1, 1, 1])


def test_a_shift_is_of_displacements_alone(measured):
    flat = simulate(make_phantom("gaussians", BOX, 0), RING.cameras(), BOX, 1.0, techniques=[Absorption])
    with refused("refine"):
        Refinement.asked(flat, ["shift"], 0.2, 0.02, 0.05)
    with refused("refine"):
        Refinement.asked(flat, ["background"], 0.2, 0.02, 0.05)


def test_a_view_that_moved_far_is_named():
    near = {"name": "a", "moved": 0.5, "values": {"shift_x": 0.1}, "sigma": {"shift_x": 0.2}}
    far = {"name": "b", "moved": 5.0, "values": {"shift_x": 1.0}, "sigma": {"shift_x": 0.2}}
    first, *named = moved_lines([near, far, near, near])
    assert "furthest is b, by 5.0 of its sigmas" in first
    (line,) = named
    assert line.startswith("view b is not where its calibration says: shift_x 1 mm, 5.0 sigma; it looks")


@pytest.mark.slow
def test_the_command_line_refines_writes_and_evaluates(measured, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("nerif.reconstruction.rig.posterior.VOXELS", 6)
    wrong, _ = spoiled(measured)
    grid = Grid.of_resolution(BOX, 24)
    truth = Volume.of(BALLS.sample(grid), grid, "index_excess", 1.00027)
    from nerif.data.volume_file import write_netcdf

    write_netcdf(tmp_path / "truth.nc", [truth])
    wrong.write(tmp_path / "m.nc")
    quick = ["--max-steps", "12", "--points-per-batch", "1024", "--voxels", "16", "--no-report", "--device", "cpu"]
    out = tmp_path / "r"
    words = ["reconstruct", str(tmp_path / "m.nc"), "-o", str(out), "--refine", "cameras,shift", *quick]
    assert main(words) == 0
    assert "refined 5 views; furthest is" in capsys.readouterr().out
    refined = read_cameras(out / "calibration.toml")
    table = json.loads((out / "metrics.json").read_text())["rig"]
    assert [camera.name for camera in refined] == [row["name"] for row in table] == list(wrong.names)
    assert torch.allclose(refined[2].camera().rotation, with_corrections(wrong, table).cameras[2].rotation)
    before = json.loads((out / "metrics.json").read_text())["views"]
    words = ["evaluate", str(out), "--truth", str(tmp_path / "truth.nc"), "--measurement", str(tmp_path / "m.nc")]
    assert main([*words, "--align", "rigid"]) == 0
    assert "L2 aligned" in capsys.readouterr().out
    after = json.loads((out / "metrics.json").read_text())
    assert after["aligned"]["l2"] <= after["l2"]
    assert [v["rms"] for v in after["views"]] == pytest.approx([v["rms"] for v in before], rel=1e-6)
    assert main(["evaluate", str(out), "--measurement", str(tmp_path / "m.nc"), "--align", "rigid"]) == 2
    assert "align: expected together with --truth" in capsys.readouterr().err
    assert main(["reconstruct", str(tmp_path / "m.nc"), "-o", str(tmp_path / "x"), "--refine", "lens", *quick]) == 2


def test_a_field_is_moved_to_where_it_is_closest():
    grid = Grid.of_resolution(BOX, 32)
    turn, shift = torch.tensor([0.01, -0.02, 0.03]).double(), torch.tensor([0.4, -0.3, 0.2]).double()
    truth = Volume.of(MovedField(BALLS, turn, shift).sample(grid), grid, "index_excess", 1.00027)
    found = aligned(BALLS, truth)
    assert torch.allclose(found.turn, turn, atol=2e-4)
    assert torch.allclose(found.shift, shift, atol=2e-3)
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) * 20 - 10
    _, slope = found.value_and_gradient(points)
    step = 1e-2 * torch.eye(3)
    numeric = torch.stack([(found(points + h) - found(points - h)) / 2e-2 for h in step], dim=-1)
    assert torch.allclose(slope, numeric, atol=2e-3 * float(slope.abs().max()))
