"""Refinement of a rig: its derivatives, its steps, what stays fixed, and runs with it."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch

from nerif.analysis.alignment import MovedField, aligned
from nerif.cli.cli import main
from nerif.data.cameras_file import read_cameras
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume, write_netcdf
from nerif.fields.phantoms import make_phantom
from nerif.forward.absorption import Absorption
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Box, Grid, Lens, Ring
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.rig_parameters import NAMES, displaced, refinement_lines, with_corrections
from nerif.reconstruction.rig_refinement import Refinement
from nerif.reconstruction.target import Target
from nerif.simulation.simulate import simulate
from refusals import refused

BOX = Box((-20.0,) * 3, (20.0,) * 3)
RING = Ring(views=5, arc=(0.0, 144.0), image_size=(24, 26), pixel_pitch=0.15)
BALLS = make_phantom("gaussians", BOX, 2)


@pytest.fixture(scope="module")
def measured() -> Measurement:
    return simulate(BALLS, RING.cameras(), BOX, 1.00027, 0.02, 1, 40)


def rig(measurement, *groups, mm=0.5, deg=0.03, px=0.03, **options) -> Refinement:
    return Refinement.for_measurement(measurement, groups, mm, deg, px, **options)


def predict(part, rays):
    return project(PathIntegral(part.model, 60), BALLS, rays)


def in_sigmas(measurement):
    """All pixels, residuals in units of sigma."""
    target = Target.of(measurement)
    unit = math.sqrt(target.chi_square)
    return [replace(part, inverse_scale=part.inverse_scale * unit) for part in target.parts]


@pytest.fixture(scope="module")
def wrong(measured) -> Measurement:
    """The measurement with wrong cameras and shifted images."""
    sizes = torch.tensor([5e-4] * 3 + [0.5] * 3 + [0.0, 0.0] + [0.03] * 2 + [0.0] * 4, dtype=torch.float64)
    true = torch.randn(len(measured.cameras), len(NAMES), generator=torch.Generator().manual_seed(0)).double() * sizes
    calibrated = Corrections(measured.cameras, -true[:, : len(GEOMETRY)]).corrected  # to first order
    shift = true[:, None, None, 8:10].float()
    return replace(measured, cameras=calibrated, displacement=measured.displacement + shift)


@pytest.mark.parametrize("lens", [None, pytest.param(Lens(5.0), marks=pytest.mark.slow)])
def test_derivatives_are_finite_differences_of_traced_cameras(measured, lens):
    cameras = tuple(replace(camera, lens=lens) for camera in measured.cameras)
    measured = replace(measured, cameras=cameras)
    refinement = rig(measured, "cameras", "focal,background", "shift", mm=0.2, deg=0.02, px=0.05)
    assert len(refinement.columns) == len(NAMES)
    random = torch.randn(refinement.sigma.shape, generator=torch.Generator().manual_seed(0))
    refinement.values = 0.3 * refinement.sigma * random
    (part,) = in_sigmas(measured)
    part = part[torch.arange(0, len(part), 7)]
    increments = refinement._increments()

    def residual(values):
        corrected = Corrections(measured.cameras, values[:, : len(GEOMETRY)]).corrected
        pixels = [part.rays.pixel[part.rays.view == i].double() for i in range(len(corrected))]
        traced = [c.rays(p, True, i).clip(BOX) for i, (c, p) in enumerate(zip(corrected, pixels, strict=True))]
        integral = torch.cat([predict(part, rays.to(dtype=torch.float32)) for rays in traced])
        size = torch.tensor(RING.image_size[::-1]).float()
        place = (part.rays.pixel - (size - 1) / 2) / (size.max() / 2)
        shift = displaced(values[:, 8:].float()[part.rays.view.long()], place)
        return (integral + shift - part.measured) * part.inverse_scale

    normal, right = refinement.normal_equations([part], predict, sigma_known=False)
    expected, pull = torch.zeros_like(normal), torch.zeros_like(right)
    now, slopes = residual(refinement.values), []
    for i in range(len(NAMES)):
        step = torch.zeros_like(increments)
        step[:, i] = increments[:, i]
        there = residual(refinement.values + step)
        assert torch.allclose(refinement.residual(part, refinement.values + step, predict)[0], there, atol=0.02)
        slopes.append((there - now) / increments[:, i].float()[part.rays.view.long()][:, None])
    jacobian = torch.stack(slopes, -1).double()
    for v in range(len(cameras)):
        pixels = part.rays.view == v
        j, r = jacobian[pixels].flatten(0, 1), now[pixels].double().flatten()
        each = 1 / (float(r.square().mean()) * 21)
        expected[v], pull[v] = each * j.T @ j, -each * j.T @ r
    size = expected.diagonal(dim1=1, dim2=2).sqrt()
    clear = [i for i, name in enumerate(NAMES) if name != "background"]  # whose derivative is below rounding
    error = ((normal - expected) / size[:, :, None] / size[:, None])[:, clear][:, :, clear]
    assert float(error.abs().max()) < 0.02
    assert float(((right - pull) / size)[:, clear].abs().max()) < 0.02 * float((pull / size).abs().max())


@pytest.mark.slow
def test_cameras_and_shifts_are_recovered_with_a_known_field(measured, wrong):
    refinement, parts = rig(wrong, "cameras,shift", gauged=False), in_sigmas(wrong)
    before, _ = refinement.residual(parts[0], refinement.values, predict)
    for _ in range(8):
        refinement.step(parts, predict, momentum=0.0)
    after, _ = refinement.residual(parts[0], refinement.values, predict)
    assert float(before.square().mean()) > 5
    assert float(after.square().mean()) < 1.1
    centre = torch.zeros(1, 3, dtype=torch.float64)
    for camera, true, start in zip(refinement.corrected, measured.cameras, wrong.cameras, strict=True):
        error, error_before = (float((c.project(centre) - true.project(centre)).norm()) for c in (camera, start))
        assert error < max(0.1 * error_before, 0.03)
    table = refinement.table()
    corrected = with_corrections(wrong, table)
    assert torch.allclose(corrected.cameras[1].rotation, refinement.corrected[1].rotation)
    u = torch.tensor([row["values"]["u"] for row in table]).float()
    shift = wrong.displacement[:, 12, 12, 0] - corrected.displacement[:, 12, 12, 0]
    assert torch.allclose(shift, u, atol=0.02)


def test_without_information_nothing_moves(measured):
    """An ambient field, and displacements of noise alone."""
    noise = torch.randn(measured.displacement.shape, generator=torch.Generator().manual_seed(1))
    measured = replace(measured, displacement=1e-3 * noise)
    refinement = rig(measured, "cameras")
    for _ in range(5):
        refinement.step(in_sigmas(measured), lambda part, rays: torch.zeros(len(rays), 2))
    assert float(refinement.values.abs().max()) == 0


@pytest.mark.slow
def test_nothing_moves_before_the_data_show_a_pose_error(measured, wrong):
    right, moved = Refinement.for_measurement(measured, ["cameras"]), rig(wrong, "cameras", "shift")
    for _ in range(4):
        right.step(in_sigmas(measured), predict, sign_factor=1.0)
    assert not right.off
    assert float(right.values.abs().max()) == 0
    for _ in range(2):
        assert float(moved.values.abs().max()) == 0
        moved.step(in_sigmas(wrong), predict, sign_factor=1.0)
    assert moved.off
    assert float(moved.values.abs().max()) > 0
    again = Refinement.for_measurement(measured, ["cameras", "shift"])
    again.load_state_dict(moved.state_dict())
    assert again.off
    (line,) = refinement_lines(right.table())
    assert "cameras unchanged" in line


def test_rigid_motions_of_all_cameras_are_removed(measured):
    refinement = rig(measured, "cameras")
    turn, shift = torch.tensor([1e-3, -2e-3, 1e-3]).double(), torch.tensor([0.3, 0.1, -0.2]).double()
    motion = []
    for camera in measured.cameras:
        shift_of_centre = camera.rotation @ (torch.linalg.cross(turn, camera.centre) + shift)
        motion.append(torch.cat([-camera.rotation @ turn, shift_of_centre, torch.zeros(8).double()]))
    assert float(refinement._centred(torch.stack(motion))[:, :6].abs().max()) < 1e-6
    one = torch.zeros(len(motion), len(NAMES), dtype=torch.float64)
    one[2, 4] = 1.0
    assert float(refinement._centred(one)[2, 4]) > 0.5


@pytest.mark.parametrize("names", [("u_x", "v_y"), ("u",), ("v",), ("u_y",), ("v_x",)])
def test_common_stretches_of_all_images_are_removed_and_others_are_not(measured, names):
    refinement = Refinement.for_measurement(measured, ["shift"])
    common = torch.zeros(len(measured.cameras), len(NAMES), dtype=torch.float64)
    common[:, [NAMES.index(name) for name in names]] = 0.01
    if len(names) == 1:
        assert torch.equal(refinement._centred(common), common)
        return
    assert float(refinement._centred(common).abs().max()) < 1e-12
    one = torch.zeros_like(common)
    one[2, NAMES.index("u_x")] = 0.01
    assert float(refinement._centred(one)[2, NAMES.index("u_x")]) == pytest.approx(0.008)


def test_shifts_of_images_do_not_overshoot(measured):
    """Three steps with a known field."""
    shift = torch.tensor([0.4, -0.3])
    shifted = replace(measured, displacement=measured.displacement + shift)
    refinement = rig(shifted, "shift", px=0.5)
    for _ in range(3):
        refinement.step(in_sigmas(shifted), predict)
        error = refinement.values[:, [NAMES.index("u"), NAMES.index("v")]] - shift
        assert float(error.abs().max()) < 0.03


def test_a_part_of_some_views_has_their_rays(measured):
    refinement = rig(measured, "cameras")
    refinement.values = torch.randn(5, 14).double() * refinement.sigma
    (part,) = in_sigmas(measured)
    part = part[part.rays.view == 3]
    alone = replace(part, rays=replace(part.rays, view=torch.zeros_like(part.rays.view)))
    expected, rays = refinement.of(part).rays, refinement.of(alone, [3]).rays
    assert torch.equal(expected.origin, rays.origin)
    assert torch.equal(rays.view, alone.rays.view)


@pytest.mark.slow
def test_a_resumed_run_equals_a_complete_one(wrong):
    settings = NeRIF(max_steps=8, points_per_batch=1024, refine=("cameras", "shift"), pose_sigma_mm=0.5, device="cpu")
    whole = settings(wrong)
    half = settings(wrong, on_step=lambda step: step.step == 4)
    again = settings(wrong, resume=half.state)
    for name, value in whole.field.network.state_dict().items():
        assert torch.equal(value, again.field.network.state_dict()[name]), name
    assert [row["name"] for row in whole.rig] == list(wrong.names)
    for a, b in zip(whole.rig, again.rig, strict=True):
        assert list(a["values"].values()) == pytest.approx(list(b["values"].values()), rel=1e-6, abs=1e-12)
    assert max(row["correction_over_sigma"] for row in whole.rig) > 0
    plain = replace(settings, refine=(), max_steps=2)
    assert plain(wrong).rig == []
    for settings_, state in ((plain, half.state), (settings, plain(wrong).state)):
        with refused("refine"):
            settings_(wrong, resume=state)


def test_a_technique_without_signal_does_not_hide_a_pose_error(measured):
    shifted = replace(measured, displacement=measured.displacement + 0.5)
    (part,) = in_sigmas(shifted)
    blind = replace(part, measured=torch.zeros_like(part.measured), inverse_scale=1e-3 * part.inverse_scale)
    alone, both = (rig(shifted, "shift", px=0.5) for _ in range(2))
    alone.normal_equations([part], predict)
    both.normal_equations([part, blind], predict)
    torch.testing.assert_close(both.explained, alone.explained, rtol=0.05, atol=0.05)
    assert float(alone.explained.min()) > 0.9


def test_withheld_pixels_have_the_refined_rig(wrong):
    data = TrainingData(NeRIF(refine=("cameras",), device="cpu"), wrong, withhold=True)
    part = data.withheld.parts[0]
    data.refinement.values = torch.ones(5, 14).double() * data.refinement.sigma
    refined = data.with_rig(part, withheld=True)
    assert float((refined.rays.origin - part.rays.origin).norm(dim=1).min()) > 0.05


@pytest.mark.parametrize(
    ("options", "field"),
    [({"refine": ("lens",)}, "refine"), ({"refine": ("cameras",), "pose_sigma_mm": 0.0}, "pose_sigma_mm"),
     ({"refine": ("cameras",), "shift_sigma_px": math.nan}, "shift_sigma_px")],
)  # fmt: skip
def test_invalid_settings_are_refused(options, field):
    with refused(field):
        NeRIF(**options)


def test_parameters_that_the_data_cannot_have_are_refused(measured):
    cameras = tuple(replace(camera, pose_sigma=torch.zeros(6)) for camera in measured.cameras)
    with refused("pose_sigma"):
        Refinement.for_measurement(replace(measured, cameras=cameras), ["cameras"])
    with refused("pose_sigma of view '0deg'"):
        replace(cameras[0], pose_sigma=-torch.ones(6))
    flat = simulate(make_phantom("gaussians", BOX, 0), RING.cameras(), BOX, 1.0, techniques=[Absorption])
    for group in ("shift", "background"):
        with refused("refine"):
            Refinement.for_measurement(flat, [group])


@pytest.mark.parametrize(
    ("view", "mm", "sigma"),
    [(0, None, [0, 0.1, 0.2, 0.3, 0.4, 0.5]), (1, None, [math.radians(0.02)] * 3 + [0.2] * 3),
     (0, 1.0, [0, 0.1, 0.2, 1, 1, 1])],
)  # fmt: skip
def test_priors_are_given_or_of_the_camera_or_the_default(measured, view, mm, sigma):
    cameras = (replace(measured.cameras[0], pose_sigma=torch.arange(6) / 10), *measured.cameras[1:])
    refinement = Refinement.for_measurement(replace(measured, cameras=cameras), ["cameras"], mm=mm)
    assert refinement.sigma[view, :6].tolist() == pytest.approx(sigma)


def test_significant_corrections_are_reported():
    near = {"name": "a", "correction_over_sigma": 0.5, "image_shift_px": 0.0}
    near |= {"values": {"shift_x": 0.1}, "prior_sigma": {"shift_x": 0.2}}
    far = {**near, "name": "b", "correction_over_sigma": 5.0, "values": {"shift_x": 1.0}}
    first, line = refinement_lines([near, far, near, near])
    assert "b, 5.0 × the prior" in first
    assert line.startswith("view b is not where its calibration says: shift_x 1 mm, 5.0 × the prior")


@pytest.mark.slow
def test_the_command_line_refines_writes_and_evaluates(wrong, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("nerif.reconstruction.uncertainty.rig_posterior.VOXELS", 6)
    grid = Grid.of_resolution(BOX, 24)
    write_netcdf(tmp_path / "truth.nc", [Volume.of(BALLS.sample(grid), grid, "index_excess", 1.00027)])
    wrong.write(tmp_path / "m.nc")
    quick = ["--max-steps", "12", "--points-per-batch", "1024", "--voxels", "16", "--no-report", "--device", "cpu"]
    out = tmp_path / "r"
    words = ["reconstruct", str(tmp_path / "m.nc"), "-o", str(out), "--refine", "cameras,shift", *quick]
    assert main(words) == 0
    assert "refined 5 views; " in capsys.readouterr().out
    refined = read_cameras(out / "calibration.toml")
    before = json.loads((out / "metrics.json").read_text())
    assert [camera.name for camera in refined] == [row["name"] for row in before["rig"]] == list(wrong.names)
    assert torch.allclose(refined[2].camera().rotation, with_corrections(wrong, before["rig"]).cameras[2].rotation)
    words = ["evaluate", str(out), "--truth", str(tmp_path / "truth.nc"), "--measurement", str(tmp_path / "m.nc")]
    assert main([*words, "--align", "rigid"]) == 0
    assert "L2 aligned" in capsys.readouterr().out
    after = json.loads((out / "metrics.json").read_text())
    assert after["aligned"]["l2"] <= after["l2"]
    assert [v["rms"] for v in after["views"]] == pytest.approx([v["rms"] for v in before["views"]], rel=1e-6)
    assert main(["evaluate", str(out), "--measurement", str(tmp_path / "m.nc"), "--align", "rigid"]) == 2
    assert "align: expected together with --truth" in capsys.readouterr().err
    assert main(["reconstruct", str(tmp_path / "m.nc"), "-o", str(tmp_path / "x"), "--refine", "lens", *quick]) == 2


def test_a_field_is_aligned_with_the_truth():
    grid = Grid.of_resolution(BOX, 32)
    turn, shift = torch.tensor([0.01, -0.02, 0.03]).double(), torch.tensor([0.4, -0.3, 0.2]).double()
    truth = Volume.of(MovedField(BALLS, turn, shift).sample(grid), grid, "index_excess", 1.00027)
    field = aligned(BALLS, truth)
    assert torch.allclose(field.turn, turn, atol=2e-4)
    assert torch.allclose(field.shift, shift, atol=2e-3)
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) * 20 - 10
    _, slope = field.value_and_gradient(points)
    numeric = torch.stack([(field(points + h) - field(points - h)) / 2e-2 for h in 1e-2 * torch.eye(3)], dim=-1)
    assert torch.allclose(slope, numeric, atol=2e-3 * float(slope.abs().max()))
