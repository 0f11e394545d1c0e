"""One camera from lengths measured with a ruler."""

from __future__ import annotations

import dataclasses
import math
import shutil

import numpy as np
import pytest
import torch

from imaging_files import write_images
from nerif.common.conventions import InputError
from nerif.data.cameras_file import read_box, read_cameras, write_cameras
from nerif.data.measurement import Measurement
from nerif.geometry import Box, Lens
from nerif.imaging.calibration.calibration_settings import ImportSettings, SimpleRig
from nerif.imaging.calibration.importers.importers import import_box
from nerif.imaging.calibration.simple_rig import box_about_axis, find_image, simple_camera
from refusals import refused

SIZE = (320, 240)
BEHIND = ImportSettings(background_distance=300.0)
RULED = SimpleRig(distance=700.0, mm_per_px=0.1)
AXES = [
    ((119.5, 319.0), (119.5, 0.0)),
    ((90.0, 310.0), (150.0, 20.0)),
    ((150.0, 15.0), (80.0, 300.0)),
    ((10.0, 170.0), (230.0, 150.0)),
    ((230.0, 100.0), (10.0, 100.0)),
]


def points(*rows: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("middle", [None, (100.0, 200.0)])
def test_the_axis_is_imaged_where_it_was_marked(axis, middle):
    rig = dataclasses.replace(RULED, axis_from=axis[0], axis_to=axis[1], principal_point=middle)
    camera = simple_camera(rig, SIZE, BEHIND).camera()
    first, last = (np.array(end) for end in axis)
    foot = camera.project(points((0, 0, 0)))[0].numpy()
    along = (last - first) / np.linalg.norm(last - first)
    assert abs((np.array(middle or (119.5, 159.5)) - foot) @ along) < 1e-9  # nearest the principal point
    heights = [0.1 * float((end - foot) @ along) for end in (first, last)]
    assert heights[1] - heights[0] == pytest.approx(0.1 * math.dist(*axis))
    pixels = camera.project(points(*((0, 0, z) for z in heights))).numpy()
    assert np.abs(pixels - [first, last]).max() < 1e-6
    assert torch.det(camera.rotation) == pytest.approx(1)


def test_scale_sides_and_background_of_an_upright_axis():
    camera = simple_camera(RULED, SIZE, BEHIND, "jet").camera()
    assert camera.name == "jet"
    assert torch.allclose(camera.centre, points((0, -700, 0))[0])
    assert float(camera.pixel_size(points((0, 0, 5)))) == pytest.approx(0.1)
    middle, right, up, away = camera.project(points((0, 0, 0), (3, 0, 0), (0, 0, 3), (0, 3, 0))).numpy()
    assert middle == pytest.approx([119.5, 159.5])
    assert right - middle == pytest.approx([30, 0])
    assert up - middle == pytest.approx([0, -30])
    assert away == pytest.approx(middle)
    rays = camera.rays(torch.tensor([[0.0, 0.0], [239.0, 319.0]], dtype=torch.float64))
    assert rays.end_points[:, 1].tolist() == pytest.approx([300, 300])
    assert camera.depth(camera.plane) == pytest.approx(1000)
    assert camera.pose_sigma is not None
    assert camera.pose_sigma.tolist() == pytest.approx([math.radians(0.5)] * 3 + [1.0] * 3)
    assert camera.lens is None


def test_a_focal_length_gives_the_same_scale_as_a_ruler():
    lens = SimpleRig(distance=700.0, focal_length=50.0, pixel_pitch_um=1000 * 0.1 * 50 / 700, f_number=8.0)
    by_lens, by_ruler = (simple_camera(rig, SIZE, BEHIND) for rig in (lens, RULED))
    assert torch.allclose(by_lens.intrinsics, by_ruler.intrinsics)
    assert torch.allclose(by_lens.translation, by_ruler.translation)
    assert by_lens.lens == Lens(6.25)
    with_lens = dataclasses.replace(BEHIND, aperture_diameter=5.0, focus_distance=900.0, pose_sigma_mm=3.0,
                                pose_sigma_deg=0.2)  # fmt: skip
    camera = simple_camera(RULED, SIZE, with_lens)
    assert camera.lens == Lens(5.0, 900.0)
    assert camera.pose_sigma is not None
    assert float(camera.pose_sigma[5]) == 3


@pytest.mark.parametrize("axis", [None, *AXES])
def test_the_box_fills_the_image(axis):
    rig = RULED if axis is None else dataclasses.replace(RULED, axis_from=axis[0], axis_to=axis[1])
    calibrated = simple_camera(rig, SIZE, BEHIND)
    box, camera = box_about_axis(calibrated), calibrated.camera()
    assert box.lower[0] == box.lower[1] == -box.upper[0] == -box.upper[1]
    corners = points(*((x, 0, z) for x in (box.lower[0], box.upper[0]) for z in (box.lower[2], box.upper[2])))
    room = np.array([240, 320]) - 0.5 - camera.project(corners).numpy()
    slack = np.minimum(room, np.array([240, 320]) - room)
    assert slack.min() > -1e-6
    assert slack.min(axis=0).max() < 0.02 * 320  # rounding


@pytest.mark.parametrize(
    ("measures", "behind", "half", "height"),
    [
        ({}, 300.0, 12, 16), ({"axis_from": (59.5, 300.0), "axis_to": (59.5, 100.0)}, 300.0, 6, 16),
        ({}, 5.0, 4.99, 16), ({"mm_per_px": 1.2345}, 300.0, 148, 197),
    ],
)  # fmt: skip
def test_boxes_of_an_upright_axis(measures, behind, half, height):
    camera = simple_camera(dataclasses.replace(RULED, **measures), SIZE, ImportSettings(background_distance=behind))
    assert box_about_axis(camera) == Box((-half, -half, -height), (half, half, height))


@pytest.mark.parametrize("distance", [3.0, 5.0, 7.3, 12.0, 1 / 3])
def test_a_measurement_takes_the_box_before_a_near_background(distance):
    calibrated = simple_camera(RULED, SIZE, ImportSettings(background_distance=distance))
    box = box_about_axis(calibrated)
    assert 0.98 * distance < box.upper[1] < distance
    values = torch.zeros(1, *SIZE, 2)
    assert Measurement((calibrated.camera(),), values, box, 1.0003).box == box


@pytest.mark.parametrize("column", [239.5, 300.0, -10.0])
def test_an_axis_beside_the_image_has_no_box(column):
    rig = dataclasses.replace(RULED, axis_from=(column, 300.0), axis_to=(column, 100.0))
    with refused("axis_from, axis_to"):
        box_about_axis(simple_camera(rig, SIZE, BEHIND))


def test_the_box_is_in_the_calibration_file(tmp_path):
    path, camera, box = tmp_path / "c.toml", simple_camera(RULED, SIZE, BEHIND), Box((-1, -2, -3), (4, 5.5, 6))
    write_cameras(path, [camera], {"source": "here"}, box)
    assert read_box(path) == import_box(path) == box
    assert import_box(path, ImportSettings(scale_mm=10.0)) == Box((-10, -20, -30), (40, 55, 60))
    assert torch.equal(read_cameras(path)[0].rotation, camera.rotation)
    write_cameras(path, [camera])
    assert read_box(path) is None
    (tmp_path / "other.toml").write_text("[box]\nK = 1\n")
    assert import_box(tmp_path / "other.toml") is import_box(tmp_path / "c.csv") is None


@pytest.mark.parametrize(
    ("box", "words"),
    [("[[0, 0, 0], [1, -1, 1]]", "lower < upper"), ("[0, 0, 0]", "2 x 3 numbers, got 3"), ("'all'", "2 x 3 numbers")],
)
def test_boxes_of_files_that_cannot_be(tmp_path, box, words):
    path = tmp_path / "c.toml"
    path.write_text(f'format = "nerif-calibration-1"\nbox = {box}\n')
    with pytest.raises(InputError, match=words) as error:
        read_box(path)
    assert str(path) in str(error.value)


def test_the_one_view_is_found(tmp_path):
    images = np.random.default_rng(0).integers(0, 255, (2, 12, 20), dtype=np.uint8)
    for name in ("cam1", "cam2"):
        (tmp_path / "both" / name).mkdir(parents=True)
        write_images(tmp_path / "both" / name / "reference", images)
    for names in ((), ("cam1", "cam2")):
        with refused("views"):
            find_image(tmp_path / "both", names)
    assert find_image(tmp_path / "both", ("cam2",)) == ("cam2", (12, 20))
    assert find_image(tmp_path / "both", ("cam2",), (9, 8)) == ("cam2", (9, 8))
    image = tmp_path / "both" / "cam1" / "reference" / "ref_000.png"
    assert find_image(image) == ("camera", (12, 20))
    assert find_image(image, ("jet",)) == ("jet", (12, 20))
    with pytest.raises(InputError, match=r"none\.png"):
        find_image(tmp_path / "none.png")
    shutil.rmtree(tmp_path / "both" / "cam2")
    left = '[views.left]\nreference = "cam1/reference"\nwidth = 7\nrotate = 90\n'
    (tmp_path / "both" / "views.toml").write_text(left)
    assert find_image(tmp_path / "both") == ("left", (7, 12))
