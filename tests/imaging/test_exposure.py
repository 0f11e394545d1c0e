"""Full scale and saturation, of sensors of any depth, on either side of their container."""

from __future__ import annotations

import numpy as np
import pytest

from imaging_files import packed, write_photron
from nerif.imaging.readers.exposure import check_exposure, effective_bits, full_scale, saturated
from nerif.imaging.readers.open import open_frames

SHAPE = (60, 80)


def synthetic(bits: int, shift: int = 0, saturate: bool = True, seed: int = 0) -> np.ndarray:
    """A noisy pattern of a sensor of so many bits, moved up by `shift`, with a reflection of 12 x 10 px in it."""
    rng = np.random.default_rng(seed)
    full = 2**bits - 1
    image = full * (0.35 + 0.2 * rng.random(SHAPE)) + 0.01 * full * rng.standard_normal(SHAPE)
    if saturate:
        image[20:32, 30:40] = 1.3 * full
    return (np.clip(image, 0, full).astype(np.uint16) << shift).astype(np.uint8 if bits + shift == 8 else np.uint16)


def opened(tmp_path, *images: np.ndarray):
    np.save(tmp_path / "a.npy", np.stack(images))
    return open_frames(tmp_path / "a.npy")


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize("left", [False, True])
def test_a_full_sensor_is_known_on_either_side_of_16_bit(tmp_path, bits, left):
    shift = 16 - bits if left else 0
    image = synthetic(bits, shift)
    full = full_scale(opened(tmp_path, image, synthetic(bits, shift, saturate=False, seed=1)))
    assert full == (2**bits - 1) << shift
    expected = np.zeros(SHAPE, dtype=bool)
    expected[20:32, 30:40] = True
    assert np.array_equal(saturated(image, full), expected)
    assert not saturated(synthetic(bits, shift, saturate=False, seed=1), full).any()


@pytest.mark.parametrize(("bits", "top"), [(8, 255), (16, 65535)])
def test_a_container_that_is_filled(tmp_path, bits, top):
    image = synthetic(bits)
    full = full_scale(opened(tmp_path, image))
    assert full == top
    assert saturated(image, full).sum() == 120


@pytest.mark.parametrize("level", [3000, 3900])
def test_a_sensor_that_is_full_below_the_top_of_its_range(level):
    image = np.minimum(synthetic(12), level).astype(np.uint16)
    assert np.array_equal(saturated(image, 4095.0), image == level)
    assert saturated(image, 4095.0).sum() == 120


def test_nothing_is_saturated_where_the_highest_values_are_noise(tmp_path):
    rng = np.random.default_rng(2)
    for bits, shift in ((8, 0), (10, 0), (12, 0), (12, 4)):
        for brightness in (0.1, 0.4, 0.7):
            photons = rng.poisson(200 * brightness, SHAPE) / 200
            image = ((2**bits - 1) * np.clip(photons, 0, 0.97)).astype(np.uint16) << shift
            assert image.max() < 0.99 * (2 ** (bits + shift))
            frames = opened(tmp_path, image.astype(np.uint8 if bits == 8 else np.uint16))
            assert not saturated(frames[0], full_scale(frames)).any(), (bits, shift, brightness)


def test_a_plateau_tells_nothing_in_a_image_without_noise():
    image = np.full(SHAPE, 60, np.uint8)
    image[10:30, 10:50] = 200
    assert not saturated(image, 255.0).any()


def test_a_brighter_image_than_those_looked_at_is_not_saturated(tmp_path):
    dark = opened(tmp_path, synthetic(10, saturate=False))
    bright = synthetic(12, saturate=False)
    assert full_scale(dark) == 1023
    assert not saturated(bright, full_scale(dark)).any()


def test_stated_bits_that_the_values_exceed_are_not_believed(tmp_path):
    import h5py

    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = synthetic(12, 4)[None]
        file["x"].attrs["bits"] = 12
    assert full_scale(open_frames(tmp_path / "a.h5")) == 65520


def test_full_scale_of_two_sources_is_that_of_the_brighter(tmp_path):
    np.save(tmp_path / "dark.npy", synthetic(10, saturate=False)[None])
    bright = opened(tmp_path, synthetic(12))
    assert full_scale(open_frames(tmp_path / "dark.npy"), bright) == 4095


@pytest.mark.parametrize(("peak", "bits"), [(200, 10), (1023, 10), (1024, 12), (4095, 12), (16383, 14), (16384, 16)])
def test_effective_bits_of_unknown_ones(tmp_path, peak, bits):
    stack = np.zeros((4, *SHAPE), np.uint16)
    stack[0, 3, 4] = peak
    frames = opened(tmp_path, *stack)
    assert effective_bits(frames) == bits
    assert frames.bits == 16


def test_effective_bits_of_known_ones(tmp_path):
    stack = np.stack([synthetic(12, seed=s) for s in range(4)])
    assert effective_bits(opened(tmp_path, *(stack // 16).astype(np.uint8))) == 8
    assert effective_bits(opened(tmp_path, *(stack / 4095).astype(np.float32))) == 1
    header = write_photron(tmp_path, packed(stack // 8), n=4, h=SHAPE[0], w=SHAPE[1])
    assert effective_bits(open_frames(header)) == 12


def test_exposure_lines():
    rng = np.random.default_rng(0)
    image = (1000 + 20 * rng.standard_normal((20, 50))).astype(np.uint16)
    assert check_exposure(image, 4095.0, "cam1/ref_001.tif") is None
    image.flat[:42] = 4095
    line = "cam1/ref_001.tif: 4.2% of the pixels are over-exposed (full scale 4095); lower the exposure"
    assert check_exposure(image, 4095.0, "cam1/ref_001.tif") == line
    assert check_exposure(image, 4095.0, "x", limit=0.05) is None
    dark = np.full((40, 50), 41, np.uint16)
    dark[3, 4] = 4095  # a hot pixel
    assert check_exposure(dark, 4095.0, "x") == (
        "x: nearly black, 1.0% of the range is used (full scale 4095); raise the exposure"
    )
    assert check_exposure(dark, 1023.0, "x") is None
    assert "over-exposed" in str(check_exposure(np.ones((20, 50), np.float32), 1.0, "x"))
