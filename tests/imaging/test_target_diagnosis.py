"""The target that is in the images is named where another one is set, with images that only OpenCV has made."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import tifffile
from scipy.spatial.transform import Rotation

from nerif.imaging.calibration import target_diagnosis
from nerif.imaging.calibration.calibrate import calibrate_views
from nerif.imaging.calibration.calibration_settings import CalibrationSettings
from nerif.imaging.calibration.target_diagnosis import Identification, explain, identify
from nerif.imaging.calibration.target_images import find_targets
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.readers.views import find_views
from refusals import refused

SHAPE = (480, 640)
SQUARE = 40  # px of the print
BOARD = CalibrationTarget("charuco", 9, 7)
slow = partial(pytest.param, marks=pytest.mark.slow)


@pytest.fixture(autouse=True)
def few_boards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search no more markers and boards than the prints here have: most of the time is their number."""
    monkeypatch.setattr(target_diagnosis, "IDS", 40)
    monkeypatch.setattr(target_diagnosis, "COUNTS", range(4, 13))


def charuco(columns: int, rows: int, dictionary: str, legacy: bool = False) -> np.ndarray:
    """A board printed by OpenCV."""
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, 0.6, markers)
    board.setLegacyPattern(legacy)
    return with_margin(board.generateImage((columns * SQUARE, rows * SQUARE)))


def chessboard(columns: int, rows: int) -> np.ndarray:
    i, j = np.mgrid[: rows * SQUARE, : columns * SQUARE] // SQUARE
    return with_margin(255 * ((i + j) % 2).astype(np.uint8))


def dots(columns: int, rows: int, asymmetric: bool = False) -> np.ndarray:
    """Black dots; every second row shifted by half a step, with half the step between rows."""
    step = SQUARE // 2 if asymmetric else SQUARE
    image = np.full((rows * step + SQUARE, columns * SQUARE + SQUARE), 255, np.uint8)
    for i in range(rows):
        for j in range(columns):
            x = (j + (i % 2) / 2 if asymmetric else j) * SQUARE + SQUARE // 2
            cv2.circle(image, (round(x), i * step + SQUARE // 2), step // 4, 0, -1, cv2.LINE_AA)
    return with_margin(image)


def with_margin(image: np.ndarray) -> np.ndarray:
    return np.pad(image, SQUARE // 2, constant_values=255)


def photographs(
    image: np.ndarray, count: int = 2, shape: tuple[int, int] = SHAPE, fill: float = 0.85, mirrored: bool = False,
    negative: bool = False, blur: float = 0.8,
) -> list[np.ndarray]:  # fmt: skip
    """A print in several tilted poses before a grey wall, with blur and noise."""
    rng, (height, width) = np.random.default_rng(3), image.shape
    image = 255 - image if negative else image
    result = []
    for _ in range(count):
        source = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
        turn = Rotation.from_euler("xyz", [*rng.uniform(-25, 25, 2), rng.uniform(-12, 12)], degrees=True)
        scale, focal = fill * min(shape[1] / width, shape[0] / height), 1.6 * shape[1]
        x, y, z = turn.apply(scale * np.c_[source - source.mean(axis=0), np.zeros(4)]).T
        places = focal / (z + focal) * np.array([x, y]) + np.array([[shape[1] / 2], [shape[0] / 2]])
        warp = cv2.getPerspectiveTransform(source, places.T.astype(np.float32))
        photo = cv2.warpPerspective(image, warp, shape[::-1], flags=cv2.INTER_AREA, borderValue=120.0)
        grey = cv2.GaussianBlur(20 + 0.8 * photo.astype(np.float32), (0, 0), blur) + rng.normal(0, 3, shape)
        grey = grey[:, ::-1] if mirrored else grey
        result.append(np.clip(grey, 0, 255).astype(np.uint8))
    return result


@pytest.mark.parametrize(
    ("dictionary", "mirrored"),
    [
        ("DICT_5X5_100", False),
        ("DICT_APRILTAG_36h11", True),
        *(slow(f"DICT_{name}", True) for name in ("6X6_50", "7X7_50", "ARUCO_ORIGINAL", "ARUCO_MIP_36h12")),
    ],
)
def test_the_dictionary_of_a_board_is_named_also_in_a_mirror(dictionary, mirrored, monkeypatch):
    images = photographs(charuco(9, 7, dictionary), mirrored=mirrored)
    assert all(BOARD.detect(image) is None for image in images)
    result = identify(images, BOARD)
    assert result.mirrored == mirrored
    named = result.target.dictionary
    assert named.rpartition("_")[0] == dictionary.rpartition("_")[0]
    assert result.target == replace(BOARD, dictionary=named)
    monkeypatch.setattr(target_diagnosis, "identify", lambda *_: result)
    text = explain(images, BOARD, 255.0)
    assert f"give --target.dictionary {named}" in text
    assert ('put flip = "horizontal" into views.toml' in text) == mirrored


@pytest.mark.parametrize(
    ("print_of", "settings", "options"),
    [
        ((9, 7), (7, 9), "--target.columns 9 --target.rows 7"),
        slow((9, 8), (8, 9), "--target.columns 9 --target.rows 8"), slow((9, 7), (10, 7), "--target.columns 9"),
        ((9, 7), (9, 6), "--target.rows 7"), ((8, 5), (12, 9), "--target.columns 8 --target.rows 5"),
        ((9, 8, True), (9, 8), "--target.legacy"), ((9, 8), (9, 8, True), "--target.no-legacy"),
    ],
)  # fmt: skip
def test_layout_of_a_board(print_of, settings, options):
    columns, rows, *legacy = settings
    target = CalibrationTarget("charuco", columns, rows, legacy=bool(legacy))
    columns, rows, *legacy = print_of
    images = photographs(charuco(columns, rows, target.dictionary, bool(legacy)))
    assert [target.detect(image) for image in images] == [None, None]
    assert explain(images, target, 255.0).endswith(f": give {options}")


def test_rows_that_could_be_outside_of_the_image_are_those_of_the_settings():
    image = photographs(charuco(9, 7, BOARD.dictionary), count=1)[0][:330]
    assert identify([image], replace(BOARD, columns=8)).target == BOARD


def test_the_remedy_for_a_mirrored_image_is_that_of_the_settings(monkeypatch):
    monkeypatch.setattr(target_diagnosis, "identify", lambda *_: Identification(BOARD, "", mirrored=True))
    for flip in ("horizontal", "vertical", "both"):
        remedy = 'put flip = "horizontal" into' if flip == "both" else f'remove flip = "{flip}" from'
        assert explain([], BOARD, 255.0, flip) == f"the images are mirrored: {remedy} views.toml"


@pytest.mark.parametrize(
    ("settings", "options"),
    [
        (("chessboard", 9, 6), "--target.columns 10 --target.rows 7"),  # inner corners
        slow(("chessboard", 8, 7), "--target.columns 10"),
        slow(("chessboard", 6, 9), "--target.columns 7 --target.rows 10"),
        slow(("charuco", 12, 9), "--target.kind chessboard --target.columns 10 --target.rows 7"),
    ],
)
def test_squares_of_a_chessboard_are_counted(settings, options):
    target = CalibrationTarget(*settings)
    images = photographs(chessboard(10, 7))
    text = explain(images, target, 255.0)
    assert text.endswith(f": give {options}")
    assert identify(images, target).target.detect(images[0]) is not None


def test_a_chessboard_that_looks_the_same_turned_is_refused():
    assert "chessboard of 8 x 6 squares, which looks the same" in explain(photographs(chessboard(8, 6)), BOARD, 255.0)


@pytest.mark.parametrize(("columns", "rows", "negative"), [(8, 6, False), (9, 5, True), (10, 7, False)])
def test_dots_are_counted_and_no_part_of_a_grid_is_detected(columns, rows, negative):
    images = photographs(dots(9, 6), negative=negative)
    target = CalibrationTarget("circles", columns, rows)
    assert [target.detect(image) for image in images] == [None, None]
    right = CalibrationTarget("circles", 9, 6)
    assert identify(images, target).target == right
    assert all(right.detect(image).negative == negative for image in images)


@pytest.mark.parametrize(("columns", "rows"), [(4, 11), (5, 8)])
def test_an_asymmetric_grid_is_named(columns, rows):
    images = photographs(dots(columns, rows, asymmetric=True))
    target = CalibrationTarget("circles", columns, rows)
    assert target.detect(images[0]) is None
    assert f"asymmetric grid of {columns * rows} dots, which is not supported" in explain(images, target, 255.0)


def test_grids_of_markers_are_named():
    grid = cv2.aruco.GridBoard((6, 4), 1.0, 0.3, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250))
    text = explain([with_margin(grid.generateImage((560, 400)))], BOARD, 255.0)
    assert text.startswith("24 markers of DICT_6X6_1000 (ids 0 to 23) were detected, but not in the layout")


@pytest.mark.parametrize("kind", ["chessboard", slow("charuco"), slow("circles")])
def test_without_a_target_none_is_named(kind, monkeypatch):
    monkeypatch.undo()
    rng = np.random.default_rng(5)
    shape = (240, 320)
    texture = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), 5)
    speckles = np.full(shape, 200, np.uint8)
    for x, y in rng.uniform(0, shape[1], (750, 2)):
        cv2.circle(speckles, (round(x), round(y)), 3, 20, -1)
    noise = rng.integers(0, 255, shape).astype(np.uint8)
    for image in (texture, speckles, noise):
        assert identify([image], CalibrationTarget(kind, 9, 6)) is None


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        slow({"blur": 5.0}, "px wide: out of focus"),
        slow({"shape": (600, 800), "fill": 0.24}, "px wide, and need 12 px or more"),
    ],
)
def test_faults_of_images_are_measured(change, cause):
    text = explain(photographs(charuco(12, 9, BOARD.dictionary), count=1, **change), CalibrationTarget(), 255.0)
    assert text.startswith("no marker of any dictionary")
    assert cause in text


def test_exposure_and_contrast_are_measured():
    noise = np.random.default_rng(0).normal(100, 3, SHAPE).astype(np.uint8)
    for image, cause in (
        (np.full(SHAPE, 255, np.uint8), "100.0% of the pixels are over-exposed"),
        (np.zeros(SHAPE, np.uint16), "nearly black"),
        (noise, "contrast of an image is as low as its noise"),
    ):
        assert cause in explain([image], BOARD, 255.0)


def test_a_view_is_explained_once(tmp_path, lines):
    for view in ("cam1", "cam2"):
        for source in ("target", "background"):
            (tmp_path / view / source).mkdir(parents=True)
    for i, image in enumerate(photographs(charuco(9, 7, "DICT_5X5_50"), count=2)):
        tifffile.imwrite(tmp_path / "cam1" / "target" / f"{i}.tif", image.astype(np.uint16) << 4)
        tifffile.imwrite(tmp_path / "cam1" / "background" / f"{i}.tif", image.astype(np.uint16)[:, ::-1] << 4)
    right = replace(BOARD, dictionary="DICT_5X5_50")
    views = find_views(tmp_path, ["cam1"])
    with refused("view 'cam1'") as error:
        calibrate_views(views, BOARD, CalibrationSettings(), say=lines.append)
    assert "in 2 of 2 target images; the target is charuco 9 x 7 of DICT_5X5_50" in str(error.value)
    assert lines == ["view 'cam1': looking for the target in the target images without a detection"]
    images = find_targets(views[0], right, lines.append)
    assert (len(images.poses), len(images.background)) == (2, 0)
    assert lines[-1] == (
        "note: view 'cam1': no charuco of 9 x 7 found in 2 of 2 background images; the images are mirrored: "
        'put flip = "horizontal" into views.toml'
    )


def test_an_error_for_few_detections_says_why(tmp_path):
    folder = tmp_path / "cam1" / "target"
    folder.mkdir(parents=True)
    others = photographs(charuco(9, 7, "DICT_5X5_50"), count=4)
    for i, image in enumerate([*photographs(charuco(9, 7, BOARD.dictionary), count=1), *others]):
        tifffile.imwrite(folder / f"{i}.tif", image)
    with refused("view 'cam1'") as error:
        calibrate_views(find_views(tmp_path), BOARD)
    assert "got 1; no charuco of 9 x 7 found in 4 of 5 target images" in str(error.value)
    assert "give --target.dictionary DICT_5X5_50" in str(error.value)
