"""Target images that are left out by name, and errors of images that a calibration file tells."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from calibration_images import target_images
from nerif.common.conventions import InputError
from nerif.geometry import Ring
from nerif.imaging.calibration.calibrate import calibrate, calibrate_views
from nerif.imaging.calibration.result import read_errors, rms_of
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.readers.views import find_views
from refusals import refused

TARGET = CalibrationTarget("charuco", 9, 7, pitch=12.0)


def test_what_is_left_out_is_not_used_and_the_rest_is_told_in_the_file(tmp_path):
    cameras = Ring(views=3, arc=(20.0, 100.0), image_size=(400, 500), pixel_pitch=0.03).cameras()
    found = target_images(cameras, TARGET, noise=0.05, poses=10)
    name = f"{found[0].name}/target/{next(iter(found[0].poses))}"
    result = calibrate([view.without([name, f"{found[1].name}/background/0"]) for view in found])
    names = {error.name for error in result.errors}
    assert name not in names
    assert len(names) == sum(len(v.poses) + len(v.background) for v in found) - 2
    result.write(tmp_path / "c.toml")
    errors = read_errors(tmp_path / "c.toml")
    assert errors == result.errors
    assert rms_of(errors) == pytest.approx(result.rms())


def test_a_image_that_is_not_there_is_refused(tmp_path: Path):
    (tmp_path / "cam1" / "target").mkdir(parents=True)
    iio.imwrite(tmp_path / "cam1" / "target" / "pose_007.png", np.zeros((20, 24), np.uint8))
    with refused("leave_out"):
        calibrate_views(find_views(tmp_path), TARGET, leave_out=["cam1/target/8"])


def test_a_calibration_file_may_tell_no_errors_but_not_wrong_ones(tmp_path: Path):
    file = tmp_path / "c.toml"
    file.write_text('format = "nerif-calibration-1"\n')
    assert read_errors(file) == ()
    file.write_text('[about]\nimage = [{name = "cam1"}]\n')
    with pytest.raises(InputError, match=r"expected about.image with name"):
        read_errors(file)
