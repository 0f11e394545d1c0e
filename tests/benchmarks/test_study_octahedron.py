"""What a record of the study holds of an octahedron."""

from __future__ import annotations

import json

import pytest
import torch

from nerif.common.files import write_json
from nerif.fields.base import Field
from nerif.fields.grid import VoxelField
from nerif.fields.phantoms import Octahedron
from nerif.geometry import Box, Grid, Ring
from study.octahedron import from_plain, pixels_per_unit, to_plain
from study.resolution import measure_resolution

PHANTOM = Octahedron(Box.cube(50.0))


class Nothing(Field):
    def value_and_gradient(self, points):
        return torch.zeros_like(points[..., 0]), torch.zeros_like(points)


def coarse() -> Field:
    grid = Grid.of_resolution(PHANTOM.box, 24)
    return VoxelField.through(PHANTOM.sample(grid), grid)


@pytest.mark.parametrize("field", [coarse(), PHANTOM, Nothing()], ids=["coarse", "sharp", "nothing"])
def test_there_and_back_by_a_json_file(field, tmp_path):
    resolution = measure_resolution(field, PHANTOM, patches=2, points=1)
    path = tmp_path / "resolution.json"
    write_json(path, to_plain(resolution))
    plain = json.loads(path.read_text())
    back = from_plain(plain)
    for before, after in ((vars(resolution), vars(back)), (vars(resolution.mtf), vars(back.mtf))):
        for name, value in before.items():
            if name != "mtf":
                torch.testing.assert_close(after[name], value, rtol=0, atol=0, equal_nan=True)
    assert plain["lp_per_unit"] == pytest.approx(resolution.lp_per_unit) or plain["lp_per_unit"] is None
    assert plain["finest_lp_per_unit"] == pytest.approx(128)


def test_pixels_of_a_unit():
    ring = Ring(views=2, focal_length=50, pixel_pitch=0.02, image_size=(30, 40), distance=700, elevation=10)
    centred = Octahedron(Box((-25.0, -30.0, -35.0), (25.0, 30.0, 35.0)))
    for camera in ring.cameras():  # 50 / 700 of 12.5 mm, in pixels of 0.02 mm
        assert pixels_per_unit(camera, centred) == pytest.approx(50 / 700 * 12.5 / 0.02)
