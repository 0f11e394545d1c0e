"""Noise of cameras from their images, and pairs of images with it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from nerif.forward.images import Images
from nerif.imaging.displacement.displacement import DisplacementSettings, Reference, measure
from nerif.imaging.displacement.photometry import CameraNoise, ImagePair
from nerif.imaging.displacement.warping import warp

READ, ELECTRONS = 6.0, 3.0  # grey values; electrons a grey value


def scene(seed: int = 0) -> np.ndarray:
    """A smooth pattern of 200 to 3000 grey values."""
    blurred = gaussian_filter(np.random.default_rng(seed).normal(size=(90, 100)), 1.6)
    return 200 + 2800 * (blurred - blurred.min()) / np.ptp(blurred)


def exposed(light: np.ndarray, seed: int) -> np.ndarray:
    draw = np.random.default_rng(seed)
    return np.round(draw.poisson(light * ELECTRONS) / ELECTRONS + READ * draw.standard_normal(light.shape))


def variance(light: np.ndarray) -> np.ndarray:
    return READ**2 + light / ELECTRONS


@pytest.mark.parametrize("repeats", [2, 8])
def test_repeats_tell_the_noise_of_a_flickering_lamp(repeats):
    light = scene()
    images = [exposed(light * (1 + 0.02 * (-1) ** i), i) for i in range(repeats)]
    noise = CameraNoise.of_repeats(images, np.mean(images, axis=0), repeats)
    assert noise.variance(light) == pytest.approx(variance(light), rel=0.15)


@pytest.mark.parametrize("references", [6, 12, 40])
def test_the_noise_does_not_change_with_the_number_of_references(references, monkeypatch):
    """Of many only some are compared with the mean of all."""
    monkeypatch.setattr("nerif.imaging.displacement.displacement._repeat_sigma", lambda *_: None)  # it is slow
    light, draw = scene(), np.random.default_rng(0)
    images = [light + np.sqrt(variance(light)) * draw.standard_normal(light.shape) for _ in range(references)]
    noise = Reference.of(images, DisplacementSettings()).camera_noise
    assert float(np.mean(noise.variance(light) / variance(light))) == pytest.approx(1, abs=0.03)


def test_a_single_reference_leaves_it_to_what_is_left():
    light = scene()
    still, other = exposed(light, 1), exposed(light, 2)
    other[::10, ::7] += 500  # a few that the prediction misses
    noise = CameraNoise.of_residual(other, still, np.ones(light.shape, dtype=bool))
    ratio = noise.variance(light) / variance(light)
    assert float(np.median(ratio)) == pytest.approx(1, abs=0.15)
    assert 0.6 < float(ratio.min()) < float(ratio.max()) < 1.5


@pytest.mark.parametrize("references", [1, 5])
def test_a_pair_holds_the_images_and_their_noise(references):
    light = scene()
    row, column = np.mgrid[: light.shape[0], : light.shape[1]]
    d = np.stack([0.6 * np.exp(-((column - 50) ** 2 + (row - 45) ** 2) / 600), np.zeros(light.shape)], axis=-1)
    repeats = [exposed(light, i) for i in range(references)]
    flow = exposed(1.04 * warp(light, -d), 99)
    flow[10:14, 20:24] = 4095
    found = measure(repeats, [flow], DisplacementSettings("dis"), full_scale=4095)
    pair = found.pair
    assert pair is not None
    assert np.isnan(pair.flow[10:14, 20:24]).all()
    assert np.nanmean(np.isfinite(pair.flow)) > 0.99
    inner = (slice(20, -15), slice(15, -15))
    left = (pair.flow - 1.04 * warp(pair.reference, -d))[inner] / pair.sigma[inner]
    assert 0.75 < float(np.sqrt(np.nanmean(left**2))) < 1.15


def test_noise_told_by_attributes_of_a_file_is_that_of_a_pair():
    light, everywhere = scene(), np.ones((90, 100), dtype=bool)
    reference, flow = exposed(light, 1), exposed(1.2 * light, 2)
    noise = CameraNoise(READ**2, 1 / ELECTRONS)
    pair = ImagePair.of(reference, flow, np.zeros((*light.shape, 2)), noise, 1, everywhere, everywhere)
    maps = {"flow": torch.tensor(flow)[None], "reference": torch.tensor(reference)[None]}
    told = Images.complete(maps, {"read_noise": READ, "electrons_per_grey_value": ELECTRONS})["image_sigma"]
    np.testing.assert_allclose(told[0].numpy(), pair.sigma, rtol=0.01)


def test_shake_is_taken_from_the_reference():
    light = scene()
    shaken = warp(light, np.full((*light.shape, 2), -1.3))  # d = 1.3 everywhere
    found = measure([exposed(light, 0)], [exposed(shaken, 1)], DisplacementSettings(shake_border=12))
    assert found.pair is not None
    inner = (slice(8, -8), slice(8, -8))
    left = (found.pair.flow - found.pair.reference)[inner]
    assert float(left.std()) < 0.3 * float((found.pair.flow - light)[inner].std())


def test_the_mean_of_several_images_is_no_image():
    light = scene()
    images = [exposed(light, i) for i in range(4)]
    assert measure(images[:2], images[2:], DisplacementSettings("dis")).pair is None
