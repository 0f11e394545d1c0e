"""White residuals, and residuals with the pattern of a cause."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from nerif.analysis.prediction import predict
from nerif.analysis.residuals import COARSE, white_noise, whiteness
from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.fields.voxel_field import VoxelField

RIGS = Path(__file__).parents[3] / "shared" / "data" / "rigs"
SHAPE, SIGMA = (96, 80), 0.05
ALL = np.ones(SHAPE, dtype=bool)


def flow(rng: np.random.Generator) -> np.ndarray:
    """The displacement by a smooth flow, px."""
    return np.stack([gaussian_filter(rng.standard_normal(SHAPE), 4) * 12 for _ in range(2)], axis=-1)


SPOILT = {
    "offset": lambda d: d + np.array([0.06, -0.03]),
    "calibration": lambda d: shift(d, (0.0, 0.4, 0.0), order=3, mode="nearest"),
    "rows": lambda d: d + 0.1 * np.sin(np.arange(SHAPE[0]) / 9)[:, None, None] * np.array([1.0, 0.4]),
    "scale": lambda d: 1.15 * d,
    "blur": lambda d: gaussian_filter(d, (1.5, 1.5, 0)),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cause", SPOILT)
def test_causes_are_distinguished(cause, seed):
    rng = np.random.default_rng(seed)
    d = flow(rng)
    residual = (SPOILT[cause](d) - d) / SIGMA + rng.standard_normal(d.shape)
    test = whiteness(residual, d, ALL)
    assert (test.white, test.cause) == (False, cause)
    assert test.grain > 1 or cause == "blur"
    assert whiteness(residual, None, ALL).cause == ""


def test_noise_of_any_size_is_white():
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        mask = rng.random(SHAPE) > 0.2
        test = whiteness(rng.exponential() * rng.standard_normal((*SHAPE, 2)), flow(rng), mask)
        assert (test.white, test.cause, test.correlated) == (True, "", 0)
        assert test.grain == pytest.approx(1, abs=0.25)


def test_position_and_size():
    rng = np.random.default_rng(5)
    residual = rng.standard_normal((*SHAPE, 2))
    residual[24:32, 40:48] += 6.0
    test = whiteness(residual, np.zeros((*SHAPE, 2)), ALL)
    assert not test.white
    assert max(abs(test.row - 28), abs(test.column - 44)) <= COARSE / 2
    everywhere = whiteness(rng.standard_normal((*SHAPE, 2)) + 0.5, None, ALL)
    assert everywhere.correlated == pytest.approx(0.5 / np.sqrt(1.25), rel=0.1)


def test_few_pixels_and_exact_fits_are_not_tested():
    rng = np.random.default_rng(6)
    mask = np.zeros(SHAPE, dtype=bool)
    mask[:16, :16] = True
    assert whiteness(rng.standard_normal((*SHAPE, 2)), flow(rng), mask) is None
    assert whiteness(rng.standard_normal((5, 7, 1)), None, np.ones((5, 7), dtype=bool)) is None
    assert whiteness(np.zeros((*SHAPE, 2)), None, ALL) is None


@pytest.mark.skipif(not RIGS.is_dir(), reason="the shared rigs are not there")
@pytest.mark.parametrize(
    ("file", "cause", "views"),
    [("thin", "", 9), pytest.param("offset", "offset", 8, marks=pytest.mark.slow), ("pose_large", "calibration", 7),
     pytest.param("window6", "blur", 8, marks=pytest.mark.slow), pytest.param("f4", "blur", 7, marks=pytest.mark.slow)],
)  # fmt: skip
def test_measurements_of_another_program(file, cause, views):
    """Against the prediction of the true field for the stated rig by thin rays: at least n views with the cause."""
    measured, thin = Measurement.read(RIGS / f"{file}.nc"), Measurement.read(RIGS / "thin.nc")
    truth = read_volume(RIGS / "truth.nc")
    field = VoxelField.through(truth.values.double(), truth.grid)
    cameras = (measured if file == "pose_large" else thin).cameras
    expected = predict(field, cameras, measured.box, measured.n_ambient).displacements
    causes = []
    for i in range(len(cameras)):
        residual = (measured.displacements[i] - expected[i]) / measured.sigma[i]
        mask = (measured.usable & measured.sees_box)[i].numpy()
        causes.append(whiteness(residual.nan_to_num(0.0).numpy(), expected[i].numpy(), mask).cause)
    assert causes.count(cause) >= views, causes


def test_white_noise_is_the_pixel_to_pixel_noise():
    rng = np.random.default_rng(5)
    mask = ALL.copy()
    mask[:, :7] = False
    noise = SIGMA * rng.standard_normal((*SHAPE, 2))
    misfit = 0.2 * flow(rng)
    detail = np.zeros_like(noise)
    detail[30:60, 20:50] = 0.5 * rng.standard_normal((30, 30, 2))
    invalid = np.where(mask[..., None], 0.0, 1e3)
    assert white_noise(noise + misfit + invalid, mask) == pytest.approx(SIGMA, rel=0.06)
    assert white_noise(noise + detail, mask) == pytest.approx(SIGMA, rel=0.25)
    assert white_noise(misfit, mask) < 0.02 * SIGMA / 0.05
    assert white_noise(gaussian_filter(noise, (1, 1, 0)), mask) < 0.2 * SIGMA
    assert white_noise(noise[:1], mask[:1]) is None


def test_images_of_two_rows_are_too_few_for_the_test():
    residual = np.ones((2, 48, 2))
    assert whiteness(residual, residual, np.ones((2, 48), dtype=bool)) is None
