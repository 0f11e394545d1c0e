"""Images of any number type and memory layout give the results of the same grey values in double precision."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from nerif.imaging.calibration.targets import eight_bit, saddle_points
from nerif.imaging.displacement.correlation import correlate, normalised_median_outliers
from nerif.imaging.displacement.displacement import Reference, border, displacement, measure, remove_shake
from nerif.imaging.displacement.photometry import CameraNoise, ImagePair
from nerif.imaging.displacement.warping import warp
from nerif.imaging.imaging_settings import DisplacementSettings, MaskSettings
from nerif.imaging.masks import flow_mask
from nerif.imaging.noise import local_correlation, smoothing_error, structure_variance
from nerif.imaging.quality.image_quality import shrink
from nerif.imaging.readers.exposure import check_exposure, saturated

SHAPE = 32, 36
ALL = np.ones(SHAPE, dtype=bool)
LOCAL, WHOLE = DisplacementSettings("dis", local_contrast=9), DisplacementSettings("dis")
MASKS = MaskSettings(threshold=2.0, smallest=4)
SHIFT = np.full((*SHAPE, 2), 0.25, dtype=np.float32)

TYPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    **{name: lambda x, name=name: x.astype(name) for name in ("u1", ">u2", "i4", "f2", "f4")},
    "columns first": lambda x: np.asfortranarray(x.astype("u1")),
    "backwards": lambda x: x[::-1, ::-1].astype("u1")[::-1, ::-1],
}


def stacked(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([a, b], axis=-1)


def numbers(noise: CameraNoise) -> np.ndarray:
    return np.array([noise.read, noise.shot])


FUNCTIONS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "displacement": lambda a, b: displacement(a, b, WHOLE),
    "displacement, local contrast": lambda a, b: displacement(a, b, LOCAL),
    "measure": lambda a, b: measure([a], [b], WHOLE, 255.0).displacement,
    "reference": lambda a, b: Reference.of([a, b], WHOLE, 255.0).mean,
    "structure variance": lambda a, b: structure_variance(a, b, 1.8),
    "local correlation": lambda a, b: local_correlation(a, b, 3.0),
    "smoothing error": lambda a, b: smoothing_error(stacked(a, b), 1.8),
    "outliers": lambda a, b: normalised_median_outliers(stacked(a, b)),
    "correlate": lambda a, b: correlate(a, b, 12, passes=1).movement,
    "warp": lambda a, b: warp(a, SHIFT),
    "shake": lambda a, b: remove_shake(stacked(a, b), border(SHAPE, 4)),
    "noise of repeats": lambda a, b: numbers(CameraNoise.of_repeats([a, b], (a + 1.0 * b) / 2, 2)),
    "noise of the residual": lambda a, b: numbers(CameraNoise.of_residual(a, b, ALL)),
    "pair": lambda a, b: ImagePair.of(a, b, SHIFT, None, 1, ALL, ALL).sigma,
    "saturated": lambda a, b: saturated(a, 240.0),
    "exposure": lambda a, b: np.array([check_exposure(a, full, "p") is None for full in (240.0, 65535.0)]),
    "mask": lambda a, b: flow_mask(stacked(a, b), stacked(np.maximum(b, 9), np.maximum(a, 9)), MASKS),
    "eight bit": lambda a, b: eight_bit(a),
    "saddle points": lambda a, b: saddle_points(a, np.array([[9.0, 12.0], [20.3, 22.1]]), 5.0)[0],
    "shrink": lambda a, b: shrink(a, 23),
}


@pytest.fixture(scope="module")
def greys() -> tuple[np.ndarray, np.ndarray]:
    """A pattern and the same shifted, with noise; grey values 4 to 250, with 30 saturated pixels."""
    pattern = gaussian_filter(np.random.default_rng(0).normal(size=SHAPE), 1.2)
    both = [np.interp(x, (pattern.min(), pattern.max()), (4, 250)) for x in (pattern, warp(pattern, SHIFT))]
    noise = np.random.default_rng(1).normal(0, 2, (2, *SHAPE))
    first, second = (np.clip(np.round(x + n), 0, 255) for x, n in zip(both, noise, strict=True))
    return first, second


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_results_do_not_depend_on_the_number_type(greys, name):
    def result(images):
        return np.asarray(FUNCTIONS[name](*images), dtype=np.float64)

    expected = result(greys)
    for kind, convert in TYPES.items():
        assert np.allclose(result(map(convert, greys)), expected, rtol=1e-3, atol=1e-3, equal_nan=True), kind
    binary = [grey > 128 for grey in greys]
    expected = result(grey.astype(np.float64) for grey in binary)
    assert np.allclose(result(binary), expected, rtol=1e-3, atol=1e-3, equal_nan=True)
