"""Target images that are left out by name, and errors of images in a calibration file."""

from __future__ import annotations

import imageio.v3 as iio
import numpy as np
import pytest

from calibration_images import target_images
from nerif.geometry import Ring
from nerif.imaging.calibration.calibrate import calibrate, calibrate_views
from nerif.imaging.calibration.result import read_errors, rms_of
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.readers.views import find_views
from refusals import refused

TARGET = CalibrationTarget("charuco", 9, 7, pitch=12.0)


def test_images_left_out_are_not_used_and_the_errors_of_the_others_are_in_the_file(tmp_path):
    cameras = Ring(views=3, arc=(20.0, 100.0), image_size=(400, 500), pixel_pitch=0.03).cameras()
    views = target_images(cameras, TARGET, noise=0.05, poses=10)
    name = f"{views[0].name}/target/{next(iter(views[0].poses))}"
    result = calibrate([view.without([name, f"{views[1].name}/background/0"]) for view in views])
    names = {error.name for error in result.errors}
    assert name not in names
    assert len(names) == sum(len(v.poses) + len(v.background) for v in views) - 2
    result.write(tmp_path / "c.toml")
    errors = read_errors(tmp_path / "c.toml")
    assert errors == result.errors
    assert rms_of(errors) == pytest.approx(result.rms())


def test_a_missing_image_cannot_be_left_out(tmp_path):
    (tmp_path / "cam1" / "target").mkdir(parents=True)
    iio.imwrite(tmp_path / "cam1" / "target" / "pose_007.png", np.zeros((20, 24), np.uint8))
    with refused("leave_out"):
        calibrate_views(find_views(tmp_path), TARGET, leave_out=["cam1/target/8"])


def test_a_calibration_file_may_have_no_errors_but_not_invalid_ones(tmp_path):
    file = tmp_path / "c.toml"
    file.write_text('format = "nerif-calibration-1"\n')
    assert read_errors(file) == ()
    file.write_text('[about]\nimage = [{name = "cam1"}]\n')
    with refused(file):
        read_errors(file)
