"""Targets rendered as a camera images them, detected to a hundredth of a pixel."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from calibration_images import camera_at_origin, imaged
from nerif.imaging.calibration.targets import CalibrationTarget

TARGETS = {
    "chessboard": CalibrationTarget("chessboard", 10, 7, pitch=6.0),
    "charuco": CalibrationTarget("charuco", 9, 7, pitch=7.0),
    "circles": CalibrationTarget("circles", 9, 6, pitch=7.0),
}


TILTED = (25, -20, 8)


@cache
def photograph(target: CalibrationTarget, angles: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """An image of 12 bit, and the true points."""
    return imaged(target, camera_at_origin((-0.1, 0.05, 0.001, -0.001, 0)), angles)


def errors(target: CalibrationTarget, image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors of the detected points, px."""
    detection = target.detect(image)
    assert detection is not None
    return detection.pixels - truth[detection.ids]


@pytest.mark.parametrize("kind", TARGETS)
@pytest.mark.parametrize("angles", [(0, 0, 0), TILTED])
def test_points_are_detected_where_they_are(kind, angles):
    image, truth = photograph(TARGETS[kind], angles)
    error = errors(TARGETS[kind], image, truth)
    assert len(error) > 0.8 * len(truth)
    assert np.sqrt(np.mean(error**2)) < (0.03 if kind == "circles" else 0.02)


@pytest.mark.parametrize(
    ("kind", "turn"), [("chessboard", 180), ("chessboard", 90), ("charuco", 180), ("circles", -60), ("circles", 80)]
)
def test_a_rotated_target_keeps_its_numbers(kind, turn):
    target = CalibrationTarget(kind, 7, 6, pitch=6.0)
    assert np.abs(errors(target, *photograph(target, (10, 5, turn)))).max() < 0.2


@pytest.mark.parametrize("kind", TARGETS)
def test_white_on_black(kind):
    target = TARGETS[kind]
    image, truth = photograph(target, TILTED)
    black = image.max() - image
    # a chessboard of an odd and an even number of squares is its own negative turned by 180 degrees
    truth = truth[::-1] if kind == "chessboard" else truth
    assert np.sqrt(np.mean(errors(target, black, truth) ** 2)) < 0.03
    assert [target.detect(i).negative for i in (image, black)] == [False, kind != "chessboard"]


@pytest.mark.parametrize(("kind", "columns", "rows"), [("circles", 8, 6), ("circles", 9, 5), ("charuco", 9, 6)])
def test_a_part_of_a_larger_target_is_not_detected(kind, columns, rows):
    image, _ = photograph(TARGETS[kind], TILTED)
    assert CalibrationTarget(kind, columns, rows, pitch=7.0).detect(image) is None


def test_dots_and_markers_of_any_size_in_a_large_image():
    for target, step in ((CalibrationTarget("circles", 9, 6), 270), (CalibrationTarget("charuco", 9, 6), 40)):
        print_ = (20 + 200 * target.raster(target.pitch / step)).astype(np.uint8)
        image = np.full((2000, 3000), 120, np.uint8)
        image[: print_.shape[0], : print_.shape[1]] = print_
        detection = target.detect(image)
        assert detection is not None
        scale = step / target.pitch
        shift = detection.pixels - scale * detection.points[:, :2]
        assert np.abs(shift - shift.mean(axis=0)).max() < 0.2


def test_any_bit_depth():
    image, truth = photograph(TARGETS["chessboard"], TILTED)
    for other in ((image >> 4).astype(np.uint8), image << 4):
        assert np.abs(errors(TARGETS["chessboard"], other, truth)).max() < 0.1


def test_a_charuco_board_may_be_partly_hidden():
    image, truth = photograph(TARGETS["charuco"], (0, 0, 0))
    image = np.where(np.arange(len(image))[:, None] < 90, np.uint16(900), image)
    error = errors(TARGETS["charuco"], image, truth)
    assert 6 <= len(error) < 48
    assert np.abs(error).max() < 0.3


@pytest.mark.parametrize("kind", TARGETS)
def test_noise_holds_no_target(kind):
    noise = np.random.default_rng(0).integers(0, 4095, (240, 320)).astype(np.uint16)
    assert TARGETS[kind].detect(noise) is None


@pytest.mark.parametrize("kind", TARGETS)
def test_points_are_centred_and_a_pitch_apart(kind):
    target = TARGETS[kind]
    points = target.points
    assert np.allclose(points.mean(axis=0), 0)
    assert len(points) == np.prod(target.shape)
    assert np.isclose(np.linalg.norm(points[1] - points[0]), target.pitch)
