"""From the images of one camera to a measurement without a calibration target, by the commands."""

from __future__ import annotations

import imageio.v3 as iio
import pytest
import torch

from commands import run
from nerif.data.cameras_file import read_box, read_cameras, write_cameras
from nerif.data.measurement import Measurement
from nerif.geometry import Box

DISTANCES = str.split("--simple --distance 700 --background-distance 300")
LENS = str.split("--focal-length 50 --pixel-pitch-um 50")
VIEW = "-90deg"


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Images of one camera on the side of y-, as `nerif displacement` takes them."""
    folder = tmp_path_factory.mktemp("simple") / "images"
    words = str.split("--phantom gaussians --views 1 --arc -90 -90 --image-size 96 80 --pixel-pitch 0.05 --poses 0")
    words += str.split("--references 2 --background-distance 300 --truth-voxels 8")
    assert run("render", "-o", folder, *words) == 0
    return folder


@pytest.fixture(scope="module")
def calibration(images):
    out = images.parent / "calibration.toml"
    assert run("calibrate", images, *DISTANCES, *LENS, "-o", out) == 0
    return out


def test_the_camera_is_the_rendered_one(images, calibration):
    (truth,), (camera,) = read_cameras(images / "truth/calibration.toml"), read_cameras(calibration)
    assert camera.name == truth.name == VIEW
    assert camera.image_size == truth.image_size
    for name in ("intrinsics", "rotation", "translation"):
        assert torch.allclose(getattr(camera, name), getattr(truth, name), atol=1e-9)
    assert torch.allclose(camera.background.normal, truth.background.normal)
    assert camera.background.offset == truth.background.offset
    assert read_box(calibration) == Box((-28, -28, -33.6), (28, 28, 33.6))
    assert iio.imread(calibration.with_suffix(".rig.png")).std() > 5


def test_the_box_is_that_of_the_calibration_or_an_option(images, calibration, tmp_path, refusal):
    words = ["displacement", images, "--method", "dis", "--calibration"]
    assert run(*words, calibration, "-o", tmp_path / "m.nc") == 0
    measurement = Measurement.read(tmp_path / "m.nc")
    assert (measurement.box, measurement.names) == (read_box(calibration), (VIEW,))
    corners = str.split("--lower -20 -20 -30 --upper 20 20 30")
    assert run(*words, calibration, *corners, "-o", tmp_path / "own.nc") == 0
    assert Measurement.read(tmp_path / "own.nc").box == Box((-20, -20, -30), (20, 20, 30))
    write_cameras(tmp_path / "boxless.toml", read_cameras(calibration))
    for options, text in (([], "--lower X Y Z"), (corners[:4], "both corners of the box")):
        assert text in refusal(*words, tmp_path / "boxless.toml", *options, "-o", tmp_path / "none.nc")
    assert not (tmp_path / "none.nc").exists()


def test_distances_scale_and_box_are_printed(images, tmp_path, capsys):
    words = [*DISTANCES, "--mm-per-px", "0.25", *str.split("--lower -5 -5 0 --upper 5 5 9")]
    assert run("calibrate", images, *words, "-o", tmp_path / "c.toml") == 0
    text = capsys.readouterr().out
    assert f"camera '{VIEW}', 700 mm from the axis of the flow, background 300 mm behind it" in text
    assert "scale: 0.25 mm per px at the axis" in text
    assert "box: x -5 to 5, y -5 to 5, z 0 to 9 mm" in text
    assert run("calibrate", tmp_path / "c.toml", "-o", tmp_path / "again.toml") == 0
    assert read_box(tmp_path / "again.toml") == Box((-5, -5, 0), (5, 5, 9))


def test_a_single_image_and_a_drawing_of_the_rig(images, tmp_path):
    out = tmp_path / "c.toml"
    image = images / VIEW / "reference/reference_000.tif"
    words = ["calibrate", image, *DISTANCES, "--mm-per-px", "0.25", "-o", out]
    assert run(*words, "--check") == 0
    assert out.with_suffix(".rig.png").exists()
    assert not out.exists()
    assert run(*words, "--views", "jet", "--force") == 0
    assert read_cameras(out)[0].name == "jet"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--distance", "700"], "distance: expected together with --simple"),
        ([*DISTANCES, *LENS, "--projection", "telecentric", "--side", "a", "x+"], "projection: "),
        ([*DISTANCES, *LENS, "--lower", "0", "0", "0"], "expected both corners of the box"),
    ],
)
def test_invalid_options(images, tmp_path, refusal, words, text):
    assert text in refusal("calibrate", images, *words, "-o", tmp_path / "c.toml")
    assert not (tmp_path / "c.toml").exists()
