"""Noise of cameras from their images, and image pairs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from nerif.forward.images import Images
from nerif.imaging.displacement.displacement import Reference, measure
from nerif.imaging.displacement.photometry import CameraNoise, ImagePair
from nerif.imaging.displacement.warping import warp
from nerif.imaging.imaging_settings import DisplacementSettings

SHAPE = (90, 100)
READ, ELECTRONS = 6.0, 3.0  # grey values; electrons per grey value
BLURRED = gaussian_filter(np.random.default_rng(0).normal(size=SHAPE), 1.6)
LIGHT = 200 + 2800 * (BLURRED - BLURRED.min()) / np.ptp(BLURRED)
VARIANCE = READ**2 + LIGHT / ELECTRONS
EVERYWHERE = np.ones(SHAPE, dtype=bool)
DIS = DisplacementSettings("dis")


def exposed(light: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.round(rng.poisson(light * ELECTRONS) / ELECTRONS + READ * rng.standard_normal(light.shape))


@pytest.mark.parametrize("repeats", [2, 8])
def test_repeats_give_the_noise_in_spite_of_a_flickering_lamp(repeats):
    images = [exposed(LIGHT * (1 + 0.02 * (-1) ** i), i) for i in range(repeats)]
    noise = CameraNoise.of_repeats(images, np.mean(images, axis=0), repeats)
    assert noise.variance(LIGHT) == pytest.approx(VARIANCE, rel=0.15)


@pytest.mark.parametrize("references", [6, 12, 40])
def test_the_noise_does_not_depend_on_the_number_of_references(references, monkeypatch):
    monkeypatch.setattr("nerif.imaging.displacement.displacement._repeat_sigma", lambda *_: None)  # slow
    rng = np.random.default_rng(0)
    images = [LIGHT + np.sqrt(VARIANCE) * rng.standard_normal(SHAPE) for _ in range(references)]
    noise = Reference.of(images, DisplacementSettings()).camera_noise
    assert float(np.mean(noise.variance(LIGHT) / VARIANCE)) == pytest.approx(1, abs=0.03)


def test_the_residual_gives_the_noise_with_a_single_reference():
    still, other = exposed(LIGHT, 1), exposed(LIGHT, 2)
    other[::10, ::7] += 500  # outliers
    ratio = CameraNoise.of_residual(other, still, EVERYWHERE).variance(LIGHT) / VARIANCE
    assert float(np.median(ratio)) == pytest.approx(1, abs=0.15)
    assert 0.6 < float(ratio.min()) < float(ratio.max()) < 1.5


@pytest.mark.parametrize("references", [1, 5])
def test_a_pair_has_the_images_and_their_noise(references):
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    d = np.stack([0.6 * np.exp(-((column - 50) ** 2 + (row - 45) ** 2) / 600), np.zeros(SHAPE)], axis=-1)
    flow = exposed(1.04 * warp(LIGHT, -d), 99)
    flow[10:14, 20:24] = 4095
    pair = measure([exposed(LIGHT, i) for i in range(references)], [flow], DIS, full_scale=4095).pair
    assert np.isnan(pair.flow[10:14, 20:24]).all()
    assert np.nanmean(np.isfinite(pair.flow)) > 0.99
    inner = (slice(20, -15), slice(15, -15))
    residual = (pair.flow - 1.04 * warp(pair.reference, -d))[inner] / pair.sigma[inner]
    assert 0.75 < float(np.sqrt(np.nanmean(residual**2))) < 1.15


def test_noise_by_attributes_of_a_file_is_that_of_a_pair():
    reference, flow = exposed(LIGHT, 1), exposed(1.2 * LIGHT, 2)
    noise = CameraNoise(READ**2, 1 / ELECTRONS)
    pair = ImagePair.of(reference, flow, np.zeros((*SHAPE, 2)), noise, 1, EVERYWHERE, EVERYWHERE)
    maps = {"flow": torch.tensor(flow)[None], "reference": torch.tensor(reference)[None]}
    complete = Images.complete(maps, {"read_noise": READ, "electrons_per_grey_value": ELECTRONS})
    np.testing.assert_allclose(complete["image_sigma"][0].numpy(), pair.sigma, rtol=0.01)


def test_shake_is_removed_from_the_reference():
    shaken = warp(LIGHT, np.full((*SHAPE, 2), -1.3))  # d = 1.3 everywhere
    pair = measure([exposed(LIGHT, 0)], [exposed(shaken, 1)], DisplacementSettings(shake_border=12)).pair
    inner = (slice(8, -8), slice(8, -8))
    residual = float((pair.flow - pair.reference)[inner].std())
    assert residual < 0.3 * float((pair.flow - LIGHT)[inner].std())


def test_several_flow_images_give_no_pair():
    images = [exposed(LIGHT, i) for i in range(4)]
    assert measure(images[:2], images[2:], DIS).pair is None
