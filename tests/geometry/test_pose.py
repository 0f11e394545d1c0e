"""Corrections of cameras: rays that move with their camera are those of the corrected camera."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.geometry import PROJECTIONS, Box, Camera, Lens, Plane, Rays
from nerif.geometry.pose import GEOMETRY, Corrections, rotation_matrix

BOX = Box((-25.0,) * 3, (25.0,) * 3)
TILTS = (0.15, 0.0), (0.0, -0.1)  # rad


def camera(projection: str, lens: Lens | None, turn: float) -> Camera:
    """Askew, distorted, before a slanted background."""
    scale = 900.0 if projection == "perspective" else 2.0
    k = torch.tensor([[scale, 0.003 * scale, 60], [0, 0.98 * scale, 50], [0, 0, 1]], dtype=torch.float64)
    rotation = rotation_matrix(torch.tensor([0.1, turn, 0.2], dtype=torch.float64))
    translation = torch.tensor([3.0, 4.0, 500.0], dtype=torch.float64)
    normal = torch.nn.functional.normalize(rotation[2] + torch.tensor([0.05, 0.02, 0.1]).double(), dim=0)
    behind = float(normal @ (-rotation.T @ translation + 900 * rotation[2]))
    bent = [0.1, 0.05, 0.01, -0.02, 0.03] if projection == "perspective" else [1e-5, 0, 0, 0, 0]
    distortion = torch.tensor(bent, dtype=torch.float64)
    made = Camera(k, rotation, translation, (100, 120), Plane(normal, behind), distortion, f"{turn}", lens=lens)
    return replace(made, projection=PROJECTIONS[projection])


@pytest.mark.parametrize("lens", [None, Lens(6.0), Lens(6.0, focus=800.0), Lens(3.0, window=4.0)])
@pytest.mark.parametrize("projection", sorted(PROJECTIONS))
@pytest.mark.parametrize("background", [True, False])
def test_rays_move_as_those_of_the_corrected_cameras(projection, lens, background):
    if not background and (lens is None or lens.focus is None):
        lens = None
    cameras = [camera(projection, lens, turn) for turn in (0.0, 0.5)]
    if projection == "perspective":  # about one axis of the sensor each: of two, a zoom is exact to second order
        cameras = [replace(c, tilt=torch.tensor(a, dtype=torch.float64)) for c, a in zip(cameras, TILTS, strict=True)]
    if not background:
        cameras = [replace(c, background=None) for c in cameras]
    sizes = torch.tensor([0.01] * 3 + [2.0] * 3 + [0.02, 5.0], dtype=torch.float64)
    corrections = Corrections(cameras, torch.randn(2, 8, generator=torch.Generator().manual_seed(0)).double() * sizes)
    pixels = torch.rand(50, 2, generator=torch.Generator().manual_seed(1)).double() * 100

    def rays_of(by) -> Rays:
        return Rays.concatenate([c.rays(pixels, True, i).clip(BOX) for i, c in enumerate(by)])

    expected, result = rays_of(corrections.corrected), corrections.apply(rays_of(cameras), BOX)
    assert float((expected.direction - rays_of(cameras).direction).abs().max()) > 1e-3
    pairs = [(getattr(expected, n), getattr(result, n)) for n in ("origin", "direction", "near", "far")]
    if background:
        pairs += [(getattr(expected.ends, n), getattr(result.ends, n)) for n in ("sensitivity", "distance")]
    if lens is not None:
        pairs += [(getattr(expected.lens, n), getattr(result.lens, n)) for n in ("axis", "normal", "radius", "focus")]
    for a, b in pairs:
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-8)
    assert torch.equal(result.view, expected.view)


@pytest.mark.parametrize("order", [("perspective", "telecentric"), ("telecentric", "perspective")])
def test_a_rig_may_mix_cameras_with_and_without_a_beginning_of_their_rays(order):
    telecentric = camera("telecentric", Lens(6.0), 0.0)
    across, down, _ = telecentric.translation.tolist()
    inside = replace(telecentric, translation=torch.tensor([across, down, 0.0], dtype=torch.float64))
    kinds = {"perspective": camera("perspective", Lens(6.0), 0.5), "telecentric": inside}
    cameras = [kinds[name] for name in order]
    pixels = torch.rand(50, 2, generator=torch.Generator().manual_seed(1)).double() * 100
    rays = Rays.concatenate([c.rays(pixels, True, i).clip(BOX) for i, c in enumerate(cameras)])
    half = int(50 * order.index("telecentric"))
    assert bool((rays.near[half : half + 50] < -5).any())  # its plane z_cam = 0 cuts the box
    moved = Corrections(cameras, torch.zeros(2, len(GEOMETRY))).apply(rays, BOX)
    through = rays.spread(1)
    for part in (moved, through, rays[torch.arange(100)]):
        assert torch.allclose(part.near, rays.near, atol=1e-9)
        assert torch.allclose(part.far, rays.far, atol=1e-9)


def test_records_that_differ_in_what_is_no_array_are_not_joined():
    rays = camera("perspective", Lens(6.0), 0.0).rays(torch.zeros(2, 2, dtype=torch.float64))
    with pytest.raises(AssertionError, match="box"):
        Rays.concatenate([rays.clip(BOX), rays.clip(Box((-9.0,) * 3, (9.0,) * 3))])
    with pytest.raises(AssertionError, match="lens"):
        Rays.concatenate([replace(rays, lens=None), rays])


def test_no_correction_changes_nothing():
    cameras = [camera("perspective", None, 0.0)]
    none = Corrections(cameras, torch.zeros(1, len(GEOMETRY)))
    assert torch.allclose(none.corrected[0].rotation, cameras[0].rotation, atol=1e-14)
    assert torch.allclose(none.corrected[0].translation, cameras[0].translation, atol=1e-10)


def test_a_shift_is_along_the_axes_of_the_camera_and_a_turn_about_them():
    first = camera("perspective", None, 0.5)
    moved = Corrections([first], torch.tensor([[0, 0, 0.1, 0, 0, 2.0, 0, 0]])).corrected[0]
    assert torch.allclose(moved.centre, first.centre + 2 * first.rotation[2], atol=1e-9)
    assert torch.allclose(moved.rotation[2], first.rotation[2], atol=1e-12)
    away = Corrections([first], torch.tensor([[0, 0, 0, 0, 0, 0, 0, 3.0]])).corrected[0]
    assert away.depth(away.plane) > first.depth(first.plane)
