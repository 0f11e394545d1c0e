"""What is left of a view is called white where it is, and else by what has left it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from nerif.analysis.prediction import predict
from nerif.analysis.residuals import BLOCK, leftover, white_noise
from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.fields.grid import VoxelField

RIGS = Path(__file__).parents[3] / "shared" / "data" / "rigs"
SHAPE, SIGMA = (96, 80), 0.05


def seen(rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """What a smooth flow might displace, px."""
    maps = [gaussian_filter(rng.standard_normal(shape), 4) * 12 for _ in range(2)]
    return np.stack(maps, axis=-1)


def blurred(d: np.ndarray) -> np.ndarray:
    return gaussian_filter(d, (1.5, 1.5, 0))


SPOILT = {
    "offset": lambda d: d + np.array([0.06, -0.03]),
    "calibration": lambda d: shift(d, (0.0, 0.4, 0.0), order=3, mode="nearest"),
    "scale": lambda d: 1.15 * d,
    "blur": blurred,
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cause", SPOILT)
def test_causes_are_told_apart(cause, seed):
    rng = np.random.default_rng(seed)
    d = seen(rng)
    residual = (SPOILT[cause](d) - d) / SIGMA + rng.standard_normal(d.shape)
    found = leftover(residual, d, np.ones(SHAPE, dtype=bool))
    assert found is not None
    assert not found.white
    assert found.cause == cause
    assert found.grain > 1 or cause == "blur"
    assert leftover(residual, None, np.ones(SHAPE, dtype=bool)).cause == ""


def test_noise_is_white_however_large():
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        mask = rng.random(SHAPE) > 0.2
        found = leftover(rng.exponential() * rng.standard_normal((*SHAPE, 2)), seen(rng), mask)
        assert found is not None
        assert found.white
        assert found.cause == ""
        assert found.alike == 0
        assert found.grain == pytest.approx(1, abs=0.25)


def test_where_it_is_and_how_large():
    rng = np.random.default_rng(5)
    residual = rng.standard_normal((*SHAPE, 2))
    residual[24:32, 40:48] += 6.0
    found = leftover(residual, np.zeros((*SHAPE, 2)), np.ones(SHAPE, dtype=bool))
    assert found is not None
    assert not found.white
    assert abs(found.row - 28) <= BLOCK / 2
    assert abs(found.column - 44) <= BLOCK / 2
    everywhere = leftover(rng.standard_normal((*SHAPE, 2)) + 0.5, None, np.ones(SHAPE, dtype=bool))
    assert everywhere is not None
    assert everywhere.alike == pytest.approx(0.5 / np.sqrt(1.25), rel=0.1)


def test_of_a_few_pixels_nothing_is_said():
    rng = np.random.default_rng(6)
    mask = np.zeros(SHAPE, dtype=bool)
    mask[:16, :16] = True
    assert leftover(rng.standard_normal((*SHAPE, 2)), seen(rng), mask) is None
    assert leftover(rng.standard_normal((5, 7, 1)), None, np.ones((5, 7), dtype=bool)) is None
    assert leftover(np.zeros((*SHAPE, 2)), None, np.ones(SHAPE, dtype=bool)) is None  # met exactly


@pytest.mark.skipif(not RIGS.is_dir(), reason="the shared rigs are not there")
@pytest.mark.parametrize(
    ("file", "cause", "views"),
    [
        ("thin", "", 9),
        pytest.param("offset", "offset", 8, marks=pytest.mark.slow),
        ("pose_large", "calibration", 7),
        pytest.param("window6", "blur", 8, marks=pytest.mark.slow),
        pytest.param("f4", "blur", 7, marks=pytest.mark.slow),
    ],
)
def test_on_measurements_made_by_others(file, cause, views):
    """Against what the stated rig would see of the true field by thin rays: so many views are called so."""
    measured = Measurement.read(RIGS / f"{file}.nc")
    truth = read_volume(RIGS / "truth.nc")
    field = VoxelField.through(truth.values.double(), truth.grid)
    thin = Measurement.read(RIGS / "thin.nc")
    cameras = [c if file == "pose_large" else t for c, t in zip(measured.cameras, thin.cameras, strict=True)]
    expected = predict(field, cameras, measured.box, measured.n_ambient).displacements
    causes = []
    for i in range(len(cameras)):
        residual = (measured.displacements[i] - expected[i]) / measured.sigma[i]
        mask = (measured.usable & measured.sees_box)[i].numpy()
        found = leftover(residual.nan_to_num(0.0).numpy(), expected[i].numpy(), mask)
        assert found is not None
        causes.append(found.cause)
    assert causes.count(cause) >= views, causes


def test_white_noise_is_what_differs_from_pixel_to_pixel():
    rng = np.random.default_rng(5)
    mask = np.ones(SHAPE, dtype=bool)
    mask[:, :7] = False
    noise = SIGMA * rng.standard_normal((*SHAPE, 2))
    misfit = 0.2 * seen(rng)
    detail = np.zeros_like(noise)
    detail[30:60, 20:50] = 0.5 * rng.standard_normal((30, 30, 2))
    beyond = np.where(mask[..., None], 0.0, 1e3)
    assert white_noise(noise + misfit + beyond, mask) == pytest.approx(SIGMA, rel=0.06)
    assert white_noise(noise + detail, mask) == pytest.approx(SIGMA, rel=0.25)
    assert white_noise(misfit, mask) < 0.02 * SIGMA / 0.05
    assert white_noise(gaussian_filter(noise, (1, 1, 0)), mask) < 0.2 * SIGMA
    assert white_noise(noise[:1], mask[:1]) is None
