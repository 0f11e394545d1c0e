"""Displacement from images: signs, sizes, noise, what is not valid, and camera shake."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from nerif.common.conventions import InputError
from nerif.imaging.displacement.correlation import normalised_median_outliers, window_correlation
from nerif.imaging.displacement.displacement import DisplacementSettings, border, displacement, measure, remove_shake
from nerif.imaging.displacement.optical_flow import FLOWS
from nerif.imaging.displacement.warping import warp
from nerif.imaging.patterns import Background
from refusals import refused

SHAPE = (90, 120)
FULL = 4095.0


@pytest.fixture(scope="module")
def pattern():
    """A function of position: the printed dots."""
    fine = gaussian_filter(Background("dots", 140.0, 110.0, dot=3.0, seed=4).raster(0.25), 2.0)

    def at(rows, columns):
        return map_coordinates(fine, [(rows + 10) * 4 + 1.5, (columns + 10) * 4 + 1.5], order=3, mode="reflect")

    return at


@pytest.fixture(scope="module")
def truth():
    """A smooth d (px) that differs in u and v and is largest off the middle."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    bump = np.exp(-(((rows - 40) / 16) ** 2) - ((columns - 75) / 22) ** 2)
    return np.stack([2.0 * bump, -1.2 * bump * (columns - 75) / 22], axis=-1)


def images(pattern, d, count=1, noise=12.0, seed=0):
    """Counts of a 12-bit camera: `count` references, and the flow image reference(p - d(p))."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    still = 0.8 * FULL * pattern(rows, columns)
    moved = 0.8 * FULL * pattern(rows - d[..., 1], columns - d[..., 0])
    references = [np.clip(still + noise * rng.standard_normal(SHAPE), 0, FULL).astype(np.uint16) for _ in range(count)]
    return references, np.clip(moved + noise * rng.standard_normal(SHAPE), 0, FULL).astype(np.uint16)


@pytest.mark.parametrize("method", FLOWS)
def test_every_method_has_the_sign_and_grid_of_the_conventions(pattern, truth, method):
    references, flow = images(pattern, truth)
    d = displacement(references[0].astype(np.float32), flow.astype(np.float32), DisplacementSettings(method))
    assert d.shape == (*SHAPE, 2)
    error = np.linalg.norm(d - truth, axis=-1)[8:-8, 8:-8]
    assert np.median(error) < (0.08 if method == "tvl1" else 0.03)
    inner = (slice(8, -8), slice(8, -8))
    for k in range(2):
        assert np.corrcoef(d[inner][..., k].ravel(), truth[inner][..., k].ravel())[0, 1] > 0.97


def test_warp_undoes_the_flow(pattern, truth):
    references, flow = images(pattern, truth, noise=0.0)
    back = warp(references[0].astype(np.float32), -truth)
    left = (flow - back)[8:-8, 8:-8].std()  # dots of 3 px are finer than pixels can carry
    assert left < 0.15 * (flow.astype(float) - references[0])[8:-8, 8:-8].std()


@pytest.mark.parametrize("method", ["deepflow", "dis", "correlation"])
def test_brightness_and_contrast_do_not_matter(pattern, truth, method):
    references, flow = images(pattern, truth)
    settings = DisplacementSettings(method)
    d = displacement(references[0].astype(np.float32), flow.astype(np.float32), settings)
    dimmed = displacement(references[0].astype(np.float32), 0.5 * flow.astype(np.float32) + 300, settings)
    assert np.median(np.abs(d - dimmed)) < 0.01


def test_local_contrast_copes_with_uneven_light(pattern, truth):
    references, flow = images(pattern, truth)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    glow = flow * (1 - 0.006 * columns) + 1500 * np.exp(-(((rows - 40) / 20) ** 2))
    evened = DisplacementSettings("dis", local_contrast=15)
    d = displacement(references[0].astype(np.float32), glow.astype(np.float32), evened)
    assert np.median(np.linalg.norm(d - truth, axis=-1)[8:-8, 8:-8]) < 0.08


@pytest.mark.parametrize("references", [1, 6])
@pytest.mark.parametrize("method", ["deepflow", "dis", "ilk", "correlation"])
def test_sigma_is_about_the_error(pattern, truth, method, references):
    many, flow = images(pattern, truth, references, noise=40.0)
    found = measure(many, [flow], DisplacementSettings(method), FULL)
    assert found.noise_source == ("repeats" if references >= 3 else "structure tensor")
    error = (found.displacement - truth)[8:-8, 8:-8]
    ratio = np.sqrt(np.mean((error / found.sigma[8:-8, 8:-8]) ** 2))
    assert 0.3 < ratio < 3


def test_repeats_follow_the_noise_of_the_camera(pattern):
    settings = DisplacementSettings("dis")
    sigma = []
    for noise in (20.0, 80.0):
        references, flow = images(pattern, np.zeros((*SHAPE, 2)), 6, noise)
        sigma.append(np.median(measure(references, [flow], settings).sigma))
    assert 2.0 < sigma[1] / sigma[0] < 8.0


def test_averaging_flow_images_lowers_noise(pattern, truth):
    still = 0 * truth  # so that noise is the only error
    references, _ = images(pattern, still, 6, noise=60.0)
    flows = [images(pattern, still, 1, 60.0, seed=s)[1] for s in range(20, 26)]
    settings = DisplacementSettings("ilk")
    one, six = measure(references, flows[:1], settings), measure(references, flows, settings)

    def error(found):
        return np.sqrt(np.mean(found.displacement[8:-8, 8:-8] ** 2))

    assert error(six) < 0.8 * error(one)
    assert np.median(six.sigma) < np.median(one.sigma)


def test_what_cannot_be_measured_is_not_valid(pattern, truth):
    references, flow = images(pattern, truth, 1)
    rng = np.random.default_rng(1)
    references[0][20:40, 20:40] = 1600  # nothing printed here
    flow[20:40, 20:40] = (1600 + 12 * rng.standard_normal((20, 20))).astype(np.uint16)
    flow[60:75, 60:80] = (FULL * rng.random((15, 20))).astype(np.uint16)  # something in the way
    flow[70:80, 10:20] = 4095  # a reflection
    region = np.ones(SHAPE, dtype=bool)
    region[:, :6] = False
    found = measure(references, [flow], DisplacementSettings("dis"), FULL, region)
    assert found.valid[64:71, 65:75].mean() < 0.1
    assert not found.valid[70:80, 10:20].any()
    assert not found.valid[:, :6].any()
    assert found.valid[26:34, 26:34].mean() < 0.1
    assert found.valid[30:55, 90:110].all()


def test_pixels_that_come_from_outside_the_reference_are_not_valid(pattern):
    d = np.zeros((*SHAPE, 2))
    d[..., 0] = 2.5
    references, flow = images(pattern, d)
    found = measure(references, [flow], DisplacementSettings("correlation"))
    assert not found.valid[:, :2].any()
    assert found.valid[10:-10, 10:-10].mean() > 0.95


def test_shake_is_removed(pattern, truth):
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    y, x = rows - 45, columns - 60
    shake = np.stack([0.8 + 0.004 * x - 0.006 * y, -0.5 + 0.006 * x + 0.004 * y], axis=-1)
    references, flow = images(pattern, truth + shake, 1)
    plain = measure(references, [flow], DisplacementSettings("dis"))
    still = measure(references, [flow], DisplacementSettings("dis", shake_border=10))
    inner = (slice(12, -12), slice(12, -12))
    assert np.median(np.linalg.norm((plain.displacement - truth)[inner], axis=-1)) > 0.5
    assert np.median(np.linalg.norm((still.displacement - truth)[inner], axis=-1)) < 0.05
    assert still.valid.mean() > 0.9


def test_shake_ignores_outliers_and_leaves_a_still_image_alone(truth):
    rng = np.random.default_rng(0)
    d = (0.02 * rng.standard_normal((*SHAPE, 2))).astype(np.float32)
    d[:10, 20:50] += 3.0
    assert np.abs(np.median(remove_shake(d, border(SHAPE, 12)) - d, axis=(0, 1))).max() < 0.02


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": "piv"}, "method: expected one of deepflow"),
        ({"smoothness": 0.0}, "smoothness"),
        ({"max_sigma": -1.0}, "max_sigma"),
        ({"local_contrast": -1}, "local_contrast"),
        ({"shake_border": -3}, "shake_border"),
        ({"min_correlation": 1.5}, "min_correlation"),
    ],
)
def test_settings_that_cannot_be_right(change, words):
    with pytest.raises(InputError, match=words):
        DisplacementSettings(**change)


@pytest.mark.usefixtures("unchecked")
def test_images_that_cannot_be_right(pattern):
    references, flow = images(pattern, np.zeros((*SHAPE, 2)))
    settings = DisplacementSettings("dis")
    with refused("images"):
        measure(references, [flow[:50]], settings)
    with refused("reference"):
        measure([np.full(SHAPE, 7, np.uint16)], [flow], settings)
    with refused("images"):
        measure([], [flow], settings)
    with refused("shake_border"):
        measure(references, [flow], dataclasses.replace(settings, shake_border=45))
    with refused("window"):
        window_correlation(flow.astype(np.float32), flow.astype(np.float32), window=64)


def test_no_movement_is_no_displacement(pattern):
    references, _ = images(pattern, np.zeros((*SHAPE, 2)))
    for method in FLOWS:
        still = references[0].astype(np.float32)
        d = displacement(still, still, DisplacementSettings(method))
        assert np.abs(d).max() < 1e-3


def test_outliers_stand_out():
    rng = np.random.default_rng(3)
    vectors = 0.05 * rng.standard_normal((12, 15, 2)) + np.linspace(0, 2, 15)[None, :, None]
    vectors[4, 7] = (5, -5)
    vectors[9, 0] += 3
    bad = normalised_median_outliers(vectors)
    assert bad[4, 7]
    assert bad[9, 0]
    assert bad.mean() < 0.06
