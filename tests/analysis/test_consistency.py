"""Mistakes put into a measurement are noticed, named, and laid at the right door; a clean one is left in peace."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scipy.ndimage import gaussian_filter

from nerif.analysis.consistency import binned, check_consistency, fit, open_faces, without_spikes
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring, paper_rig
from nerif.simulation.simulate import simulate

BOX = Box((-25.0, -25.0, -25.0), (25.0, 25.0, 25.0))


def measure(phantom: str, seed: int, noise: float = 0.05, box: Box = BOX, height: int = 30) -> Measurement:
    ring = Ring(views=6, arc=(0.0, 150.0), image_size=(height, 36), pixel_pitch=0.12)
    field = make_phantom(phantom, box, seed)
    return replace(simulate(field, ring.cameras(), box, 1.00027, noise, seed, steps=30), box=BOX)


@pytest.fixture(scope="module")
def clean() -> Measurement:
    """Balls without symmetry, seen by six views."""
    return measure("gaussians", 1)


def spoilt(clean: Measurement, mistake) -> Measurement:
    d = clean.displacement.clone()
    return replace(clean, displacement=mistake(d))


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


MISTAKES = {
    "swapped": (in_view(2, lambda d: d.flip(-1)), "view 60deg: u and v are swapped"),
    "sign": (in_view(1, lambda d: -d), "view 30deg: the sign of the displacement is flipped"),
    "sign of v": (in_view(4, lambda d: d * torch.tensor([1.0, -1.0])), "view 120deg: the sign of v is flipped"),
    "mirrored": (
        in_view(3, lambda d: d.flip(1) * torch.tensor([-1.0, 1.0])), "view 90deg: the image is mirrored left to right"
    ),
    "upside down": (
        in_view(3, lambda d: d.flip(0) * torch.tensor([1.0, -1.0])), "view 90deg: the image is upside down"
    ),
    "exchanged": (exchanged(1, 4), "views 30deg and 120deg: these two views are exchanged"),
    "swapped everywhere": (lambda d: d.flip(-1), "all views: u and v are swapped"),
    "sign of v everywhere": (lambda d: d * torch.tensor([1.0, -1.0]), "all views: the sign of one component"),
    "too large": (in_view(2, lambda d: 2.5 * d), "view 60deg: displacement 2."),
}  # fmt: skip


@pytest.mark.slow  # the quick one is test_the_command_names_the_view
@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named(clean, name):
    mistake, words = MISTAKES[name]
    found = check_consistency(spoilt(clean, mistake), voxels=20)
    assert len(found.findings) == 1, found.findings
    assert found.findings[0].sentence.startswith(words)
    assert len(found.views) == 6


@pytest.mark.slow
def test_exchanged_neighbours_of_nine_are_told_from_straight_ones():
    ring = Ring(views=9, arc=(0.0, 170.0), image_size=(40, 48), pixel_pitch=0.09)
    field = make_phantom("flame", BOX, 0)
    straight = simulate(field, ring.cameras(), BOX, 1.00027, 0.05, 0, steps=30)
    assert check_consistency(straight).findings == ()
    found = check_consistency(spoilt(straight, exchanged(3, 4)))
    assert [(f.code, f.views) for f in found.findings] == [("exchanged", ("63.75deg", "85deg"))]


@pytest.mark.slow
def test_a_view_of_something_else_is_named(clean):
    other = measure("gaussians", 3).displacement[2]
    found = check_consistency(spoilt(clean, in_view(2, lambda d: other)), voxels=20)
    assert [v.name for v in found.views if v.verdict] == ["60deg"]


@pytest.mark.slow
def test_a_view_of_noise_alone_is_named(clean):
    noise = 0.04 * torch.randn(clean.displacement.shape[1:], generator=torch.Generator().manual_seed(0))
    found = check_consistency(spoilt(clean, in_view(2, lambda d: noise)), voxels=20)
    assert ("unlike", ("60deg",)) in [(f.code, f.views) for f in found.findings]


@pytest.mark.parametrize(
    ("phantom", "seed", "noise", "step"),
    [
        ("flame", 0, 0.05, 2),
        pytest.param("flame", 0, 0.05, 1, marks=pytest.mark.slow),
        pytest.param("gaussians", 2, 0.15, 1, marks=pytest.mark.slow),
        pytest.param("gaussians", 0, 0.05, 1, marks=pytest.mark.slow),
    ],
)
def test_no_false_alarm(phantom, seed, noise, step):
    measurement = measure(phantom, seed, noise=noise)
    found = check_consistency(measurement.select(measurement.names[::step]), voxels=20)
    assert found.findings == ()
    assert all(v.verdict == "" for v in found.views)
    assert any("lighter" in r for r in found.remarks)


@pytest.fixture(scope="module")
def cut() -> Measurement:
    """A flame that ends at the top and bottom of the box, all of which the images show, without noise."""
    cameras, box = paper_rig(32)
    return simulate(make_phantom("flame", box, 0), cameras[::2], box, 1.00027, steps=30)


@pytest.mark.parametrize("smeared", [0.0, 1.0])
def test_a_flame_that_ends_at_the_box_does_not_go_on_beyond_it(cut, smeared):
    """Optical flow smears the edges at the ends over its window."""
    d = torch.from_numpy(gaussian_filter(cut.displacement.numpy(), (0, smeared, smeared, 0)))
    small = replace(cut, displacement=d)
    field, _ = fit(small, 24, 3e-3)
    assert open_faces(field, small) == []


@pytest.mark.slow
def test_a_flipped_sign_of_everything_shows_as_a_denser_flow(clean):
    found = check_consistency(spoilt(clean, lambda d: -d), voxels=20)
    assert found.findings == ()
    assert any("denser" in r for r in found.remarks)


@pytest.fixture(scope="module")
def tall() -> Measurement:
    """A flame twice as tall as the box it is reconstructed in."""
    return measure("flame", 0, box=Box((-25.0, -25.0, -50.0), (25.0, 25.0, 50.0)), height=44)


def test_flow_that_leaves_through_the_ends_is_seen_in_the_rays_through_them(tall):
    field, _ = fit(tall, 20, 3e-3)
    below, above = open_faces(field, tall)
    assert below.code == above.code == "open_face"
    assert below.sentence.startswith("face z-")
    assert "--open-faces z+" in above.sentence


@pytest.mark.slow
def test_flow_that_leaves_through_the_ends_is_told(tall):
    found = check_consistency(tall, voxels=20)
    assert [f.sentence.split(":")[0] for f in found.findings] == ["face z-", "face z+"]


def test_too_few_views_are_no_error(clean):
    found = check_consistency(clean.select(clean.names[:2]))
    assert found.views == ()
    assert found.findings == ()
    assert "fewer than three views" in found.remarks[-1]


@pytest.mark.slow
def test_camera_shake_and_missing_pixels_are_told(clean):
    moved = spoilt(clean, in_view(2, lambda d: d + torch.tensor([1.5, 0.0])))
    valid = torch.ones(moved.displacement.shape[:3], dtype=torch.bool)
    valid[0, :20] = False
    found = check_consistency(replace(moved, valid=valid), voxels=20)
    assert any("view 60deg: its rim is displaced by (1." in r for r in found.remarks)
    assert any("view 0deg: only 33% of its pixels" in r for r in found.remarks)


def test_a_small_flow_among_zeros_is_no_spike(clean):
    d = torch.zeros_like(clean.displacement)
    d[:, 14:17, 14:22] = clean.displacement[:, 14:17, 14:22]  # 2 % of the pixels
    d[0, 0, 0] = 1e4
    kept = without_spikes(spoilt(clean, lambda _: d)).displacement
    assert kept[0, 0, 0].isnan().all()
    d[0, 0, 0] = torch.nan
    assert torch.equal(kept.isnan(), d.isnan())


def test_views_of_nothing_are_told(clean):
    found = check_consistency(spoilt(clean.select(clean.names[:3]), torch.zeros_like), voxels=8)
    assert found.findings == found.views == ()
    assert found.remarks[-1] == "every displacement of rays through the box is 0: there is nothing to compare"


@pytest.mark.parametrize("apart", [2, 4, 8])
def test_sparse_vectors_are_kept(clean, apart):
    sparse = torch.full_like(clean.displacement, torch.nan)
    sparse[:, ::apart, ::apart] = clean.displacement[:, ::apart, ::apart]
    sparse[2] = clean.displacement[2]
    sparse[2, :2, :4] = torch.nan
    sparse[2, 0, 0] = 1.0
    found = binned(spoilt(clean, lambda _: sparse), 18)
    assert int(found.usable[0].sum()) == -(-30 // apart) * -(-36 // apart)
    assert found.usable[2, 0, :2].tolist() == [False, False]  # of a dense view, squares that are empty by half are not
    torch.testing.assert_close(found.displacement[0, 0, 0], sparse[0, 0, 0] / 2)


def test_binning_keeps_rays_and_displacements(clean):
    fine = Ring(views=3, arc=(0.0, 90.0), image_size=(60, 72), pixel_pitch=0.06)
    field = make_phantom("gaussians", BOX, 1)
    measurement = simulate(field, fine.cameras(), BOX, 1.00027, steps=30)
    small = binned(measurement, 36)
    assert small.displacement.shape == (3, 30, 36, 2)
    coarse = Ring(views=3, arc=(0.0, 90.0), image_size=(30, 36), pixel_pitch=0.12)
    truth = simulate(field, coarse.cameras(), BOX, 1.00027, steps=30)
    for a, b in zip(small.cameras, truth.cameras, strict=True):
        assert torch.allclose(a.intrinsics, b.intrinsics)
    error = (small.displacement - truth.displacement).square().mean().sqrt()
    assert float(error) < 0.05 * float(truth.displacement.square().mean().sqrt())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mirrored", "exchanged"])
def test_what_was_found_is_undone(clean, tmp_path, capsys, name):
    """Values, sigma and masks are as they were, and a measurement without mistakes is not written again."""
    mask = torch.rand(clean.usable.shape, generator=torch.Generator().manual_seed(0)) > 0.05
    good = replace(clean, flow_mask=mask)
    mistake = {"mirrored": mirrored(3), "exchanged": swapped(1, 4)}[name]
    path, out = tmp_path / "m.nc", tmp_path / "corrected.nc"
    mistake(good).write(path)
    assert main(["check", str(path), "-o", str(out)]) == 0
    found = Measurement.read(out)
    torch.testing.assert_close(found.displacement, good.displacement.float())
    torch.testing.assert_close(found.sigma, good.sigma.float())
    assert torch.equal(found.flow_mask, mask)
    assert main(["check", str(path), "-o", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["check", str(out), "-o", str(tmp_path / "again.nc")]) == 2
    assert "nothing was found" in capsys.readouterr().err
    assert not (tmp_path / "again.nc").exists()


def mirrored(view: int):
    """Everything that a view has, as of an image that is mirrored left to right."""

    def mistake(m: Measurement) -> Measurement:
        maps = {"displacement": m.displacement.clone(), "sigma": m.sigma.clone(), "flow_mask": m.flow_mask.clone()}
        for values in maps.values():
            values[view] = values[view].flip(1)
        maps["displacement"][view, ..., 0] *= -1
        return replace(m, **maps)

    return mistake


def swapped(i: int, j: int):
    """Everything that two views have, exchanged."""

    def mistake(m: Measurement) -> Measurement:
        maps = {"displacement": m.displacement.clone(), "sigma": m.sigma.clone(), "flow_mask": m.flow_mask.clone()}
        for values in maps.values():
            values[[i, j]] = values[[j, i]]
        return replace(m, **maps)

    return mistake


def test_the_command_names_the_view(clean, tmp_path, capsys):
    path = tmp_path / "m.nc"
    spoilt(clean.select(clean.names[::2]), in_view(1, lambda d: -d)).write(path)
    assert main(["check", str(path), "--voxels", "16", "--strict"]) == 1
    said = capsys.readouterr().out
    assert "FOUND: view 60deg: the sign of the displacement is flipped" in said
    assert main(["check", str(path), "--voxels", "3"]) == 2
    assert main(["check", str(tmp_path / "none.nc")]) == 2
