"""Cameras from DLT coefficients and from lists of points, and what PIVlab writes."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pymatreader
import pytest
import scipy.io
import torch

from nerif.cli.commands import calibrate
from nerif.common.conventions import InputError
from nerif.data.cameras_file import read_cameras
from nerif.geometry import Camera, paper_rig
from nerif.imaging.calibration.calibration_settings import ImportSettings
from nerif.imaging.calibration.importers.importers import import_cameras
from refusals import refused

RIG = paper_rig(240)[0]
HEIGHT, WIDTH = SIZE = (200, 240)


def make(view: int, distorted: bool) -> Camera:
    """A camera of the paper's rig with an oblong image and fx, fy, skew, distortion."""
    k = [[2500.0 + view, 0.0 if distorted else 1.5, 117.25], [0, 2480.0, 101.5], [0, 0, 1]]
    return dataclasses.replace(
        RIG[view],
        intrinsics=torch.tensor(k, dtype=torch.float64),
        image_size=SIZE,
        distortion=torch.tensor([-0.2, 0.3, 0.002, -0.001, 0.0], dtype=torch.float64) * distorted,
        name=f"cam{view}",
    )


SHARP, CAMERAS = [make(i, False) for i in (1, 4)], [make(i, True) for i in (1, 4)]
POINTS = np.random.default_rng(0).uniform(-25, 25, (60, 3))
BOX = torch.from_numpy(np.random.default_rng(1).uniform(-25, 25, (100, 3)))
AXES = {
    "from 0": (0, False, np.eye(3)),
    "MATLAB": (1, False, np.array([[1, 0, 1], [0, 1, 1], [0, 0, 1]])),
    "older MATLAB": (1, True, np.array([[1, 0, 1], [0, -1, HEIGHT], [0, 0, 1]])),
    "edges": (0.5, True, np.array([[1, 0, 0.5], [0, -1, HEIGHT - 0.5], [0, 0, 1]])),
}
"""First pixel, whether rows count upwards, and the matrix from the pixels of nerif."""


def error(cameras: Any, expected: list[Camera]) -> float:
    """Largest difference of projections of points in the box, px."""
    pairs = zip(cameras, expected, strict=True)
    return max(float((a.camera(image_size=b.image_size).project(BOX) - b.project(BOX)).abs().max()) for a, b in pairs)


def coefficients(cameras: list[Camera], axes: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """DLT coefficients, (11, camera), for lengths in a unit in mm."""
    columns = []
    for c in cameras:
        matrix = axes @ c.intrinsics.numpy() @ np.column_stack([scale * c.rotation.numpy(), c.translation.numpy()])
        columns.append(matrix.ravel()[:11] / matrix[2, 3])
    return np.stack(columns, axis=1)


def write_dlt(path: Any, values: np.ndarray, head: str = "", separator: str = ",") -> Any:
    rows = [separator.join(repr(float(x)) for x in row) for row in values]
    path.write_text("\n".join([head, *rows] if head else rows))
    return path


# -- direct linear transformation ----------------------------------------------------------------------------------


@pytest.mark.parametrize("program", AXES)
def test_dlt_coefficients(tmp_path, program):
    first, upwards, axes = AXES[program]
    path = write_dlt(tmp_path / "dltcoefs.csv", coefficients(SHARP, axes, 10))
    settings = ImportSettings(first_pixel=first, rows_upward=upwards, scale_mm=10.0, image_size=SIZE)
    got = import_cameras(path, settings)
    assert error(got, SHARP) < 1e-6
    assert [c.name for c in got] == ["unnamed1", "unnamed2"]
    assert got[0].image_size == SIZE
    assert float(got[0].intrinsics[0, 1]) == pytest.approx(1.5)
    with refused(f"{path}: unnamed1"):  # mirrored
        import_cameras(path, dataclasses.replace(settings, rows_upward=not upwards))


def test_layouts_of_dlt_coefficients(tmp_path):
    """A head of names, a row a camera, decimal commas, four cameras (as many columns as vectors have)."""
    path, settings, values = tmp_path / "dlt.csv", ImportSettings(first_pixel=0), coefficients(SHARP, np.eye(3))
    assert error(import_cameras(write_dlt(path, values.T), settings), SHARP) < 1e-6
    write_dlt(path, values, '"left", "right"')
    assert [c.name for c in import_cameras(path, settings)] == ["left", "right"]
    path.write_text(write_dlt(path, values, separator=";").read_text().replace(".", ","), encoding="utf-16")
    assert error(import_cameras(path, settings), SHARP) < 1e-6
    write_dlt(path, coefficients(SHARP * 2, np.eye(3)))
    assert error(import_cameras(path, settings), SHARP * 2) < 1e-6
    with pytest.raises(InputError, match="--first-pixel 1"):
        import_cameras(path)
    with pytest.raises(InputError, match="--image-size"):
        import_cameras(path, ImportSettings(first_pixel=0, rows_upward=True))


PARALLEL = np.vstack([coefficients(SHARP, np.eye(3))[:8], np.zeros((3, 2))])


@pytest.mark.parametrize(("values", "words"), [
    (coefficients(SHARP, np.eye(3))[:10], "11 rows and a column a camera, got 10 x 2"),
    (PARALLEL, "expected a perspective camera"),
    (np.where(PARALLEL == 0, np.nan, PARALLEL), "expected finite coefficients"),
])  # fmt: skip
def test_other_numbers_are_no_dlt_coefficients(tmp_path, values, words):
    with pytest.raises(InputError, match=words):
        import_cameras(write_dlt(tmp_path / "dlt.csv", values), ImportSettings(first_pixel=0))


# -- points --------------------------------------------------------------------------------------------------------


def write_points(
    path: Any, cameras: list[Camera], points: np.ndarray = POINTS, axes: np.ndarray = AXES["from 0"][2],
    head: str = "camera,X,Y,Z,u,v", scale: float = 1.0,
) -> Any:  # fmt: skip
    lines = [head]
    for camera in cameras:
        pixels = camera.project(torch.from_numpy(points)).numpy() @ axes[:2, :2].T + axes[:2, 2]
        rows = np.column_stack([points / scale, pixels]).tolist()
        lines += [",".join([camera.name, *map(repr, row)]) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("program", AXES)
def test_cameras_are_fitted_to_points(tmp_path, program):
    first, upwards, axes = AXES[program]
    lines: list[str] = []
    path = write_points(tmp_path / "points.csv", CAMERAS, axes=axes)
    settings = ImportSettings(first_pixel=first, rows_upward=upwards, image_size=SIZE)
    got = import_cameras(path, settings, say=lines.append)
    assert error(got, CAMERAS) < 1e-3
    assert [c.name for c in got] == ["cam1", "cam4"]
    assert lines[0].startswith("points.csv: cam1: 60 points, rms ")
    assert len(lines) == 2
    with pytest.raises(InputError, match="mirror images"):
        import_cameras(path, dataclasses.replace(settings, rows_upward=not upwards))


@pytest.mark.parametrize(("count", "coefficients"), [(6, 0), (11, 0), (12, 1), (29, 1), (30, 4)])
def test_few_points_determine_few_coefficients(tmp_path, count, coefficients):
    """The size of the image is not known here."""
    (got,) = import_cameras(write_points(tmp_path / "p.csv", SHARP[:1], POINTS[:count]))
    assert int((got.distortion != 0).sum()) == coefficients
    assert got.image_size is None
    assert error([got], SHARP[:1]) < 0.3  # the skew is not fitted


def test_units_and_names_of_columns(tmp_path):
    path = write_points(tmp_path / "p.csv", CAMERAS, head="View, X [m], y (m), Z [m], U [px], v [px]", scale=1000.0)
    got = import_cameras(path, ImportSettings(image_size=SIZE))
    assert error(got, CAMERAS) < 1e-3
    text = path.read_text()
    path.write_text(text.replace("y (m)", "y (mm)"))
    with pytest.raises(InputError, match="one unit of X, Y, Z"):
        import_cameras(path)
    rows = [line + ",0.25,seen" for line in text.splitlines()[1:]]  # further columns, and points beside the image
    path.write_text("\n".join([text.splitlines()[0] + ",error,remark", *rows, "cam1,0,0,0,NaN,NaN", "cam1,0,0,0,,"]))
    assert error(import_cameras(path, ImportSettings(image_size=SIZE)), CAMERAS) < 1e-3


def test_outliers_are_named(tmp_path):
    path, lines = write_points(tmp_path / "p.csv", CAMERAS), []
    rows = path.read_text().splitlines()
    rows[7] = ",".join([*rows[7].split(",")[:4], "50", "60"])
    path.write_text("# by hand\n\n" + "\n".join(rows))
    got = import_cameras(path, ImportSettings(image_size=SIZE), say=lines.append)
    assert [line.split(" px")[0].rsplit(":", 1)[0] for line in lines if "note" in line] == ["note: p.csv, line 10"]
    assert error(got, CAMERAS) < 0.2


FLAT = POINTS * (1, 1, 0)
SHUFFLED = np.random.default_rng(3).permutation(POINTS)


def test_points_that_determine_no_camera(tmp_path):
    path = tmp_path / "p.csv"
    for points, words in ((FLAT, "60 on one plane.*second plane"), (POINTS[:5], "at least 6 points, got 5")):
        with pytest.raises(InputError, match=words) as caught:
            import_cameras(write_points(path, CAMERAS, points))
        assert caught.value.field == f"{path}: camera 'cam1'"
        assert "\n" not in str(caught.value)
    text = write_points(path, CAMERAS[:1]).read_text().splitlines()
    pixels = [line.split(",")[4:] for line in write_points(path, CAMERAS[:1], SHUFFLED).read_text().splitlines()[1:]]
    rows = [",".join([*line.split(",")[:4], *pixel]) for line, pixel in zip(text[1:], pixels, strict=True)]
    for lines, words in (
        (rows, "no camera fits its 60 points.*order of the columns"),
        ([rows[0].replace(",", ",x", 1)], "line 2: 'x': expected a number"),
        ([rows[0][4:]], "line 2: 'camera' is empty"),
        ([rows[0] + ",3"], "expected 6 columns, got 7"),
    ):
        path.write_text("\n".join([text[0], *lines]))
        with pytest.raises(InputError, match=words):
            import_cameras(path)


def test_points_on_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(calibrate, "_draw", lambda *rig: None)
    path, out = write_points(tmp_path / "points.csv", CAMERAS, axes=AXES["MATLAB"][2]), tmp_path / "c.toml"
    words = ["--first-pixel", "1", "--image-size", "200", "240"]
    calibrate.main([str(path), *words, "-o", str(out)])
    assert error(read_cameras(out), CAMERAS) < 1e-3
    assert "points.csv: cam4: 60 points, rms" in capsys.readouterr().out


# -- PIVlab --------------------------------------------------------------------------------------------------------


def test_calibrations_of_pivlab_are_to_be_exported(tmp_path, monkeypatch):
    path = tmp_path / "camera_calibration.mat"
    scipy.io.savemat(path, {"cam_K_opencv": np.eye(3), "cam_tilted_D": np.zeros(14), "cam_use_tilted_model": 1.0})
    words = r"PIVlab's object 'cameraParams'.* in MATLAB run  s = toStruct\(cameraParams\)"
    with pytest.raises(InputError, match=words):
        import_cameras(path)
    content = {"__function_workspace__": np.zeros(3), "cam_selected_target_images": np.ones(3)}  # of older versions
    monkeypatch.setattr(pymatreader, "read_mat", lambda p: content)
    with pytest.raises(InputError, match=words):
        import_cameras(path)
