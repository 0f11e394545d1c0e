"""From the images of one camera to a measurement without a calibration target, by the verbs."""

from __future__ import annotations

import imageio.v3 as iio
import pytest
import torch

from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.geometry import Box
from nerif.imaging.calibration.cameras_file import read_box, read_cameras

DISTANCES = ("--simple", "--distance", "700", "--background-distance", "300")
LENS = ("--focal-length", "50", "--pixel-pitch-um", "50")
VIEW = "-90deg"


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Images of one camera on the side of y-, as `nerif displacement` takes them."""
    folder = tmp_path_factory.mktemp("simple") / "images"
    code = main(
        ["render", "-o", str(folder), "--phantom", "gaussians", "--views", "1", "--arc", "-90", "-90", "--image-size",
         "96", "80", "--pixel-pitch", "0.05", "--poses", "0", "--references", "2", "--background-distance", "300",
         "--truth-voxels", "8"]
    )  # fmt: skip
    assert code == 0
    return folder


@pytest.fixture(scope="module")
def calibration(images):
    out = images.parent / "calibration.toml"
    assert main(["calibrate", str(images), *DISTANCES, *LENS, "-o", str(out)]) == 0
    return out


def test_the_camera_is_the_rendered_one(images, calibration):
    (truth,), (found,) = read_cameras(images / "truth" / "calibration.toml"), read_cameras(calibration)
    assert found.name == truth.name == VIEW
    assert found.image_size == truth.image_size
    for name in ("intrinsics", "rotation", "translation"):
        assert torch.allclose(getattr(found, name), getattr(truth, name), atol=1e-9)
    assert found.background is not None
    assert truth.background is not None
    assert torch.allclose(found.background.normal, truth.background.normal)
    assert found.background.offset == truth.background.offset
    assert read_box(calibration) == Box((-28, -28, -33.6), (28, 28, 33.6))
    assert iio.imread(calibration.with_suffix(".rig.png")).std() > 5


def test_displacements_go_by_the_box_of_the_calibration(images, calibration, tmp_path, capsys):
    words = ["displacement", str(images), "--calibration", str(calibration), "--method", "dis"]
    assert main([*words, "-o", str(tmp_path / "m.nc")]) == 0
    measurement = Measurement.read(tmp_path / "m.nc")
    assert measurement.box == read_box(calibration)
    assert measurement.names == (VIEW,)
    given = ["--lower", "-20", "-20", "-30", "--upper", "20", "20", "30"]
    assert main([*words, *given, "-o", str(tmp_path / "own.nc")]) == 0
    assert Measurement.read(tmp_path / "own.nc").box == Box((-20, -20, -30), (20, 20, 30))
    words[3] = str(images / "truth" / "calibration.toml")
    for some, said in (((), "holds none; give --lower X Y Z and --upper"), (given[:4], "both corners of the box")):
        assert main([*words, *some, "-o", str(tmp_path / "none.nc")]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "none.nc").exists()


def test_what_was_measured_is_said(images, tmp_path, capsys):
    out = tmp_path / "c.toml"
    line = ["calibrate", str(images), *DISTANCES, "--mm-per-px", "0.25", "-o", str(out)]
    assert main([*line, "--lower", "-5", "-5", "0", "--upper", "5", "5", "9"]) == 0
    said = capsys.readouterr().out
    assert f"camera '{VIEW}', 700 mm from the axis of the flow, the background 300 mm behind it" in said
    assert "scale: 0.25 mm per px at the axis" in said
    assert "box: x -5 to 5, y -5 to 5, z 0 to 9 mm" in said
    again = tmp_path / "again.toml"
    assert main(["calibrate", str(out), "-o", str(again)]) == 0
    assert read_box(again) == Box((-5, -5, 0), (5, 5, 9))


def test_a_image_and_a_look_at_the_rig(images, tmp_path):
    image = str(images / VIEW / "reference" / "reference_000.tif")
    out = tmp_path / "c.toml"
    line = ["calibrate", image, *DISTANCES, "--mm-per-px", "0.25", "-o", str(out)]
    assert main([*line, "--check"]) == 0
    assert out.with_suffix(".rig.png").exists()
    assert not out.exists()
    assert main([*line, "--views", "jet", "--force"]) == 0
    assert read_cameras(out)[0].name == "jet"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--distance", "700"], "distance: expected together with --simple"),
        ([*DISTANCES, *LENS[:2]], "mm_per_px: expected the scale at the axis"),
        (["--simple", *LENS, "--distance", "700"], "background_distance: expected a positive number"),
        ([*DISTANCES, *LENS, "--distance", "0"], "distance: expected a positive number, got 0"),
        ([*DISTANCES, *LENS, "--axis-from", "5", "5"], "axis_from, axis_to: expected two points"),
        ([*DISTANCES, *LENS, "--views", "cam7"], "views: expected some of -90deg, got 'cam7'"),
        ([*DISTANCES, *LENS, "--projection", "telecentric", "--side", "a", "x+"], "expected perspective with --simple"),
        ([*DISTANCES, *LENS, "--lower", "0", "0", "0"], "expected both corners of the box"),
    ],
)
def test_what_cannot_be_is_refused(images, tmp_path, capsys, words, said):
    assert main(["calibrate", str(images), *words, "-o", str(tmp_path / "c.toml")]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert not (tmp_path / "c.toml").exists()
