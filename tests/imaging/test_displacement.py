"""Displacement from images: signs, size, noise, validity, and camera shake."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from nerif.imaging.displacement.correlation import normalised_median_outliers, window_correlation
from nerif.imaging.displacement.displacement import UNEVEN, displacement, measure
from nerif.imaging.displacement.optical_flow import FLOWS
from nerif.imaging.displacement.warping import warp
from nerif.imaging.imaging_settings import DisplacementSettings
from nerif.imaging.patterns import Background
from nerif.imaging.shake import border, remove_shake
from refusals import refused

SHAPE = (90, 120)
FULL = 4095.0
INNER = (slice(8, -8), slice(8, -8))
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
STILL = np.zeros((*SHAPE, 2))


@pytest.fixture(scope="module")
def pattern():
    """Printed dots as a function of position."""
    fine = gaussian_filter(Background("dots", 140.0, 110.0, dot=3.0, seed=4).raster(0.25), 2.0)
    return interpolator(fine, lambda pixels: (pixels + 10) * 4 + 1.5)


def interpolator(fine, places):
    """Cubic splines through a fine image, as a function of rows and columns in px."""
    spline = spline_filter(fine, mode="reflect")
    return lambda rows, columns: map_coordinates(
        spline, [places(rows), places(columns)], order=3, mode="reflect", prefilter=False
    )


@pytest.fixture(scope="module")
def truth():
    """A smooth d (px), different in u and v, largest off the middle."""
    bump = np.exp(-(((ROWS - 40) / 16) ** 2) - ((COLUMNS - 75) / 22) ** 2)
    return np.stack([2.0 * bump, -1.2 * bump * (COLUMNS - 75) / 22], axis=-1)


def images(pattern, d, count=1, noise=12.0, seed=0):
    """Counts of a 12-bit camera: `count` references, and the flow image reference(p - d(p))."""
    rng = np.random.default_rng(seed)
    still = 0.8 * FULL * pattern(ROWS, COLUMNS)
    moved = 0.8 * FULL * pattern(ROWS - d[..., 1], COLUMNS - d[..., 0])
    references = [np.clip(still + noise * rng.standard_normal(SHAPE), 0, FULL).astype(np.uint16) for _ in range(count)]
    return references, np.clip(moved + noise * rng.standard_normal(SHAPE), 0, FULL).astype(np.uint16)


def median_error(d, truth, inner=INNER):
    return np.median(np.linalg.norm(d - truth, axis=-1)[inner])


@pytest.mark.parametrize("method", FLOWS)
def test_every_method_has_the_sign_and_grid_of_the_conventions(pattern, truth, method):
    (reference,), flow = images(pattern, truth)
    settings = DisplacementSettings(method)
    d = displacement(reference, flow, settings)
    assert d.shape == (*SHAPE, 2)
    assert median_error(d, truth) < (0.08 if method == "tvl1" else 0.03)
    for k in range(2):
        assert np.corrcoef(d[INNER][..., k].ravel(), truth[INNER][..., k].ravel())[0, 1] > 0.97
    assert np.abs(displacement(reference, reference, settings)).max() < 1e-3
    if method in ("deepflow", "dis", "correlation"):  # brightness and contrast have no effect
        dimmed = displacement(reference, 0.5 * flow.astype(np.float32) + 300, settings)
        assert np.median(np.abs(d - dimmed)) < 0.01


def test_warp_undoes_the_flow(pattern, truth):
    (reference,), flow = images(pattern, truth, noise=0.0)
    residual = (flow - warp(reference, -truth))[INNER].std()  # pixels cannot resolve dots of 3 px
    assert residual < 0.15 * (flow.astype(float) - reference)[INNER].std()


def test_local_contrast_compensates_uneven_light(pattern, truth):
    (reference,), flow = images(pattern, truth)
    uneven = flow * (1 - 0.006 * COLUMNS) + 1500 * np.exp(-(((ROWS - 40) / 20) ** 2))
    d = displacement(reference, uneven.astype(np.float32), DisplacementSettings("dis", local_contrast=15))
    assert median_error(d, truth) < 0.08


@pytest.mark.parametrize(("method", "references"), [("deepflow", 4), ("dis", 1), ("ilk", 4), ("correlation", 1)])
def test_sigma_is_about_the_error(pattern, truth, method, references):
    frames, flow = images(pattern, truth, references, noise=40.0)
    result = measure(frames, [flow], DisplacementSettings(method), FULL)
    assert result.noise_source == ("repeats" if references >= 3 else "structure tensor")
    ratio = np.sqrt(np.mean(((result.displacement - truth)[INNER] / result.sigma[INNER]) ** 2))
    assert 0.3 < ratio < 3


def test_repeats_follow_the_noise_of_the_camera(pattern):
    sigma = []
    for noise in (20.0, 80.0):
        references, flow = images(pattern, STILL, 6, noise)
        sigma.append(np.median(measure(references, [flow], DisplacementSettings("dis")).sigma))
    assert 2.0 < sigma[1] / sigma[0] < 8.0


def test_averaging_flow_images_lowers_noise(pattern):
    references, _ = images(pattern, STILL, 4, noise=60.0)
    flows, _ = images(pattern, STILL, 6, noise=60.0, seed=20)
    one, six = (measure(references, f, DisplacementSettings("dis")) for f in (flows[:1], flows))
    assert np.square(six.displacement[INNER]).mean() < 0.64 * np.square(one.displacement[INNER]).mean()
    assert np.median(six.sigma) < np.median(one.sigma)


def test_unmeasurable_pixels_are_not_valid(pattern, truth):
    references, flow = images(pattern, truth, 1)
    rng = np.random.default_rng(1)
    references[0][20:40, 20:40] = 1600  # no pattern
    flow[20:40, 20:40] = (1600 + 12 * rng.standard_normal((20, 20))).astype(np.uint16)
    flow[60:75, 60:80] = (FULL * rng.random((15, 20))).astype(np.uint16)  # an obstacle
    flow[70:80, 10:20] = 4095  # a reflection
    valid = measure(references, [flow], DisplacementSettings("dis"), FULL, COLUMNS >= 6).valid
    assert valid[64:71, 65:75].mean() < 0.1
    assert not valid[70:80, 10:20].any()
    assert not valid[:, :6].any()
    assert valid[26:34, 26:34].mean() < 0.1
    assert valid[30:55, 90:110].all()


def test_pixels_from_outside_the_reference_are_not_valid(pattern):
    references, flow = images(pattern, STILL + np.array([2.5, 0]))
    valid = measure(references, [flow], DisplacementSettings("correlation")).valid
    assert not valid[:, :2].any()
    assert valid[10:-10, 10:-10].mean() > 0.95


def test_shake_is_removed(pattern, truth):
    y, x = ROWS - 45, COLUMNS - 60
    shake = np.stack([0.8 + 0.004 * x - 0.006 * y, -0.5 + 0.006 * x + 0.004 * y], axis=-1)
    references, flow = images(pattern, truth + shake, 1)
    plain, still = (measure(references, [flow], DisplacementSettings("dis", shake_border=n)) for n in (0, 10))
    inner = (slice(12, -12), slice(12, -12))
    assert median_error(plain.displacement, truth, inner) > 0.5
    assert median_error(still.displacement, truth, inner) < 0.05
    assert still.valid.mean() > 0.9


@pytest.mark.parametrize(
    ("movement", "width"), [((14.3, -3.0, 0.0), 20), ((-6.0, 21.0, 0.0), 0), ((11.0, 8.0, 0.02), 20)]
)
def test_a_camera_that_moved_far_is_found_first(pattern, truth, movement, width):
    u, v, roll = movement
    shake = np.stack([u - roll * (ROWS - 45), v + roll * (COLUMNS - 60)], axis=-1)
    references, flow = images(pattern, truth + shake)
    result = measure(references, [flow], DisplacementSettings(shake_border=width))
    error = np.linalg.norm(result.displacement - (truth if width else truth + shake), axis=-1)
    row, column = ROWS - shake[..., 1], COLUMNS - shake[..., 0]
    interior = (row > 8) & (row < SHAPE[0] - 8) & (column > 8) & (column < SHAPE[1] - 8)
    assert result.valid[interior].mean() > 0.95
    assert np.sqrt(np.mean(error[result.valid] ** 2)) < 0.1
    assert np.allclose(result.shift, (u, v), atol=1.5)
    assert not result.valid[(row < -1) | (column < -1) | (row > SHAPE[0]) | (column > SHAPE[1])].any()
    if width:  # a fit to the images has no data where the reference ends
        assert np.isnan(result.pair.flow[(row < -2) | (column < -2)]).all()


PEAKS = [("correlation", 25.0, 50.0, 0.9), ("correlation", 20.0, 22.0, 0.0), ("dis", 16.0, 34.0, 0.85)]


@pytest.mark.parametrize(("method", "largest", "radius", "share"), PEAKS)
def test_displacements_larger_than_the_window_are_right_or_not_valid(method, largest, radius, share):
    shape = (180, 200)
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    fine = gaussian_filter(Background("dots", 280.0, 260.0, dot=3.0, seed=2).raster(0.5), 1.0)
    at = interpolator(fine, lambda pixels: 2 * pixels + 80.5)
    bump = largest * np.exp(-((rows - 85) ** 2 + (columns - 104) ** 2) / radius**2)
    d = np.stack([0.8 * bump, -0.6 * bump], axis=-1)

    def exposed(y, x, seed):
        return 3000 * at(y, x) + 12 * np.random.default_rng(seed).standard_normal(shape)

    reference, flow = exposed(rows, columns, 0), exposed(rows - d[..., 1], columns - d[..., 0], 1)
    result = measure([reference], [flow], DisplacementSettings(method))
    error = np.abs(result.displacement - d)[INNER]
    valid, core = result.valid[INNER], (bump > 0.5 * largest)[INNER]
    assert valid.mean() > 0.8
    assert valid[core].mean() >= share
    assert (error > 3 * result.sigma[INNER]).any(axis=-1)[valid].mean() < 0.01
    assert error[valid].max() < 1.0
    if not share:
        assert result.losses[UNEVEN] > 0.01


@pytest.mark.parametrize(("jump", "width"), [(2.0, 1.0), (4.0, 3.0), (1.0, 2.0)])
def test_sigma_grows_at_fronts(pattern, jump, width):
    across = COLUMNS - 0.2 * ROWS - 50
    d = np.stack([jump * (np.clip(across / width + 0.5, 0, 1) - 0.5), 0 * across], axis=-1)
    references, flow = images(pattern, d)
    result = measure(references, [flow], DisplacementSettings())
    front, away = np.abs(across[INNER]) < 8, np.abs(across[INNER]) > 25
    error, sigma = np.abs(result.displacement - d)[INNER][..., 0], result.sigma[INNER][..., 0]
    valid = result.valid[INNER]
    assert (error > 3 * sigma)[front & valid].mean() < 0.05
    assert np.median(sigma[front]) > 4 * np.median(sigma[away])


def test_shake_ignores_outliers_and_leaves_a_still_image_unchanged():
    d = (0.02 * np.random.default_rng(0).standard_normal((*SHAPE, 2))).astype(np.float32)
    d[:10, 20:50] += 3.0
    assert np.abs(np.median(remove_shake(d, border(SHAPE, 12)) - d, axis=(0, 1))).max() < 0.02


@pytest.mark.usefixtures("unchecked")
def test_invalid_images(pattern):
    references, flow = images(pattern, STILL)
    settings = DisplacementSettings("dis")
    shaken = dataclasses.replace(settings, shake_border=45)
    for field, arguments in (
        ("images", (references, [flow[:50]], settings)),
        ("reference", ([np.full(SHAPE, 7, np.uint16)], [flow], settings)),
        ("images", ([], [flow], settings)),
        ("shake_border", (references, [flow], shaken)),
    ):
        with refused(field):
            measure(*arguments)
    with refused("window"):
        window_correlation(flow, flow, window=64)


def test_outliers_are_detected():
    rng = np.random.default_rng(3)
    vectors = 0.05 * rng.standard_normal((12, 15, 2)) + np.linspace(0, 2, 15)[None, :, None]
    vectors[4, 7] = (5, -5)
    vectors[9, 0] += 3
    bad = normalised_median_outliers(vectors)
    assert bad[4, 7]
    assert bad[9, 0]
    assert bad.mean() < 0.06
    volume = np.zeros((4, 5, 6, 3))
    volume[2, 1, 3, 2] = 3.0
    assert np.argwhere(normalised_median_outliers(volume)).tolist() == [[2, 1, 3]]
