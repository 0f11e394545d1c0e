"""What is expected of a rig is what its cameras see."""

from __future__ import annotations

import re
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from bodies import cuboid
from nerif.cli.cli import main
from nerif.fields.phantoms import GaussianBalls
from nerif.geometry import Box, Ring
from nerif.simulation.rig_design import DesignSettings, expect
from nerif.simulation.simulate import view_displacement
from refusals import refused

RING = Ring(views=5, image_size=(160, 200))
PARALLEL = replace(RING, projection="telecentric", magnification=0.08)
SETTINGS = DesignSettings()


@pytest.mark.parametrize("ring", [RING, PARALLEL], ids=lambda r: r.projection)
def test_expected_displacement_is_that_of_a_ball(ring):
    ball = GaussianBalls(
        torch.zeros(1, 3, dtype=torch.float64), torch.tensor([4.0], dtype=torch.float64),
        torch.tensor([-2e-4], dtype=torch.float64),
    )  # fmt: skip
    d = view_displacement(ball, ring.cameras()[0], Box.cube(50.0), 1.00027)
    expected = expect(ring, replace(SETTINGS, index_contrast=2e-4))
    assert float(d.norm(dim=-1).max()) == pytest.approx(expected.displacement, rel=0.01)


def test_lengths_are_those_of_similar_triangles():
    e = expect(RING, SETTINGS)
    focal = 50.0 / 0.02
    assert e.pixel_at_flow == pytest.approx(700 / focal)
    assert e.pixel_at_background == pytest.approx(1200 / focal)
    assert e.field_of_view == pytest.approx((200 * 700 / focal, 160 * 700 / focal))
    assert e.sensitivity == pytest.approx(focal * 500 / 1200 / 1000)
    assert e.cone == pytest.approx(50 / 16 * 500 / 1200)
    assert e.resolution == pytest.approx(np.sqrt(e.cone**2 + e.window**2 + e.diffraction**2))
    assert e.smallest_contrast * e.displacement == pytest.approx(SETTINGS.index_contrast * SETTINGS.displacement_noise)
    assert e.dot == pytest.approx(3 * e.pixel_at_background)


def test_lengths_of_a_telecentric_lens_are_those_of_its_magnification():
    e = expect(PARALLEL, SETTINGS)
    assert e.pixel_at_flow == pytest.approx(0.02 / 0.08)
    assert e.pixel_at_background == e.pixel_at_flow
    assert e.field_of_view == pytest.approx((200 * 0.25, 160 * 0.25))
    assert e.sensitivity == pytest.approx(500 / 0.25 / 1000)
    assert e.cone == pytest.approx(500 * 0.08 / 16)  # of the f-number on the sensor's side
    assert e.diffraction == pytest.approx(2.44 * 532e-6 * 16 / 0.08)
    further = expect(replace(PARALLEL, background_distance=1000.0), SETTINGS)
    assert further.displacement == pytest.approx(2 * e.displacement)


@pytest.mark.parametrize("ring", [RING, PARALLEL], ids=lambda r: r.projection)
def test_the_cone_is_the_one_that_is_rendered(ring):
    camera = ring.cameras()[0]
    middle = camera.with_f_number(ring.pixel_pitch, SETTINGS.f_number).rays(torch.tensor([[99.5, 79.5]]).double())
    rim = torch.tensor([[[1.0, 0.0, 0.0, 0.0]]], dtype=torch.float64)
    edges = [middle.through(offset) for offset in (rim, -rim)]
    assert torch.allclose(edges[0].end_points, edges[1].end_points, atol=1e-9)  # in focus on the background
    at_flow = [r.origin - r.origin[:, :1] / r.direction[:, :1] * r.direction for r in edges]  # on the plane x = 0
    assert float((at_flow[0] - at_flow[1]).norm()) == pytest.approx(expect(ring, SETTINGS).cone)


def test_trade_offs_go_the_right_way():
    near, far = (expect(replace(RING, background_distance=d), SETTINGS) for d in (200.0, 1000.0))
    assert far.displacement > near.displacement
    assert far.cone > near.cone
    wide, small = (expect(RING, replace(SETTINGS, f_number=n)) for n in (4.0, 32.0))
    assert wide.cone > small.cone
    assert wide.diffraction < small.diffraction


@pytest.mark.parametrize(
    ("ring", "settings", "words"),
    [
        (RING, replace(SETTINGS, index_contrast=1e-6), "hardly above the noise"),
        (RING, replace(SETTINGS, index_contrast=2e-2), "more than half a window"),
        (RING, replace(SETTINGS, f_number=1.4), "stop the lens down"),
        (RING, replace(SETTINGS, flow_size=90.0), "larger than the image"),
        (replace(RING, pixel_pitch=0.002), replace(SETTINGS, flow_size=1.0), "of most printers"),
        (replace(RING, background_distance=20.0), SETTINGS, "inside or next to the flow"),
        (replace(RING, arc=(0.0, 60.0)), SETTINGS, "a gap of 120 degrees"),
        (replace(RING, views=1), SETTINGS, "one view alone"),
    ],
)
def test_notes(ring, settings, words):
    assert any(words in note for note in expect(ring, settings).notes)


def test_a_good_rig_has_no_notes():
    assert expect(Ring(pixel_pitch=0.025), replace(SETTINGS, feature_size=6.0)).notes == ()
    with refused("f_number"):
        DesignSettings(f_number=0.0)


@pytest.mark.slow
def test_the_command_prints_and_draws(tmp_path, capsys):
    out = tmp_path / "design.png"
    assert main(["design", "--temperature", "1800", "--views", "4", "-o", str(out)]) == 0
    lines = capsys.readouterr().out
    assert "px/mrad" in lines
    contrast = float(lines.split("index contrast")[1].split()[0])
    assert contrast == pytest.approx(2.29e-4, rel=0.02)
    assert iio.imread(out).std() > 10
    assert main(["design", "--projection", "telecentric"]) == 0
    assert "pixel on the background               0.280 mm" in capsys.readouterr().out
    for words in (
        ["-o", str(out)],
        ["--magnification", "0.1"],
        ["--temperature", "-3"],
        ["-o", str(tmp_path / "x.txt")],
    ):
        assert main(["design", *words]) == 2


def test_pixels_that_a_body_hides_are_counted(tmp_path, capsys):
    import trimesh

    body = cuboid((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0))
    trimesh.Trimesh(body.vertices.numpy(), body.faces.numpy()).export(tmp_path / "cube.stl")
    rig = ["--views", "3", "--image-size", "32", "32", "--pixel-pitch", "0.125"]
    assert main(["design", *rig, "--body", str(tmp_path / "cube.stl")]) == 0
    shares = re.findall(r"hidden in view \S+ +([\d.]+)%", capsys.readouterr().out)
    assert len(shares) == 3
    assert all(1 < float(share) < 90 for share in shares)
