"""Backgrounds that repeat are named with their period; random ones are not."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from nerif.imaging.displacement.displacement import measure
from nerif.imaging.imaging_settings import DisplacementSettings
from nerif.imaging.patterns import KINDS, Background
from nerif.imaging.quality.repetition import repetition

SHAPE = (220, 260)


def coordinates(angle: float, perspective: float = 0.0):
    """Position on a background turned by `angle` (degrees), seen under perspective."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    x, y = columns - 130, rows - 110
    scale = 1 + perspective * x / 260
    cosine, sine = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    return (cosine * x + sine * y) / scale, (-sine * x + cosine * y) / scale


def grey(pattern: np.ndarray, noise: float = 20.0) -> np.ndarray:
    """Image of a 12-bit camera, brighter on one side."""
    light = np.linspace(1200, 2400, pattern.shape[1])
    rng = np.random.default_rng(0)
    return 200 + light * gaussian_filter(pattern.astype(float), 0.8) + noise * rng.standard_normal(pattern.shape)


def dot_grid(period: float, angle: float = 0.0, perspective: float = 0.0) -> np.ndarray:
    x, y = (np.cos(2 * np.pi * v / period) for v in coordinates(angle, perspective))
    return grey(x + y > 1)


@pytest.mark.parametrize(("period", "angle"), [(5.0, 0.0), (12.4, 30.0), (30.0, 0.0), (30.0, 30.0)])
def test_a_grid_of_dots_repeats_in_both_directions(period, angle):
    result = repetition(dot_grid(period, angle))
    assert [np.linalg.norm(p) for p in result.periods] == pytest.approx([period] * 2, rel=0.02)
    first, second = ((np.degrees(np.arctan2(p[1], p[0])) + 20) % 180 - 20 for p in result.periods)
    assert [first, second] == pytest.approx([angle, angle + 90], abs=2)
    assert result.lines is None
    if angle == 0:
        assert re.match(r"repeats every [\d.]+ px along x and every [\d.]+ px along y, so shifts", str(result))


def test_perspective_changes_the_period_over_the_image():
    result = repetition(dot_grid(12.4, 5, 0.25))
    assert [np.linalg.norm(p) for p in result.periods] == pytest.approx([12.4] * 2, rel=0.05)


@pytest.mark.parametrize("noise", [20.0, 500.0])
def test_checkers_repeat_along_their_diagonals(noise):
    x, y = coordinates(0)
    result = repetition(grey(np.sin(np.pi * x / 10) * np.sin(np.pi * y / 10) > 0, noise))
    assert [np.linalg.norm(p) for p in result.periods] == pytest.approx([10 * 2**0.5] * 2, rel=0.02)


@pytest.mark.parametrize("angle", [0.0, 25.0, 90.0])
def test_lines_repeat_in_one_direction_and_measure_nothing_along_it(angle):
    x, _ = coordinates(angle)
    image = grey(np.sin(2 * np.pi * x / 14) > 0)
    result = repetition(image)
    (period,) = result.periods
    assert np.linalg.norm(period) == pytest.approx(14, rel=0.02)
    assert abs(period @ result.lines) < 0.5
    assert np.degrees(np.arctan2(result.lines[1], result.lines[0])) % 180 == pytest.approx((angle + 90) % 180, abs=3)
    if angle == 0:
        sigma = np.median(measure([image], [np.roll(image, 1)], DisplacementSettings("dis")).sigma, axis=(0, 1))
        assert sigma[1] > 5 * sigma[0]


def test_reach_is_the_part_of_a_period():
    result = repetition(dot_grid(12.4))
    assert result.reach(np.array([[6.2, 0.0], [0.0, -3.1], [0.0, 0.0]])) == pytest.approx([0.5, 0.25, 0], abs=0.02)


@pytest.mark.parametrize("kind", [*KINDS, "noise", "blank"])
def test_random_patterns_do_not_repeat(kind):
    for seed, (fill, dot, blur) in enumerate([(0.1, 3, 0), (0.35, 2, 2), (0.6, 10, 1)]):
        if kind in KINDS:
            pattern = Background(kind, 260, 220, dot=dot, fill=fill, seed=seed).raster(1.0)
        else:
            pattern = np.random.default_rng(seed).random(SHAPE) if kind == "noise" else np.ones(SHAPE)
        assert repetition(grey(gaussian_filter(pattern, blur))) is None


def test_small_images_are_not_judged():
    assert repetition(dot_grid(5)[:40]) is None
