"""Full scale and saturation, of sensors of any depth, at either end of their container."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from imaging_files import packed, write_photron
from nerif.imaging.readers.exposure import check_exposure, effective_bits, full_scale, saturated
from nerif.imaging.readers.open import open_frames

SHAPE = (60, 80)


def synthetic(bits: int, shift: int = 0, reflection: bool = True, seed: int = 0) -> np.ndarray:
    """A noisy pattern of a sensor, shifted up by `shift` bits, with a saturated reflection of 12 x 10 px."""
    rng = np.random.default_rng(seed)
    full = 2**bits - 1
    image = full * (0.35 + 0.2 * rng.random(SHAPE)) + 0.01 * full * rng.standard_normal(SHAPE)
    if reflection:
        image[20:32, 30:40] = 1.3 * full
    return (np.clip(image, 0, full).astype(np.uint16) << shift).astype(np.uint8 if bits + shift == 8 else np.uint16)


def saved(tmp_path, *images: np.ndarray, name: str = "a.npy"):
    np.save(tmp_path / name, np.stack(images))
    return open_frames(tmp_path / name)


@pytest.mark.parametrize(("bits", "shift"), [(8, 0), (10, 0), (12, 0), (14, 0), (16, 0), (10, 6), (12, 4), (14, 2)])
def test_full_scale_at_either_end_of_the_container(tmp_path, bits, shift):
    image, plain = synthetic(bits, shift), synthetic(bits, shift, reflection=False, seed=1)
    full = full_scale(saved(tmp_path, image, plain))
    assert full == (2**bits - 1) << shift
    expected = np.zeros(SHAPE, dtype=bool)
    expected[20:32, 30:40] = True
    assert np.array_equal(saturated(image, full), expected)
    assert not saturated(plain, full).any()


@pytest.mark.parametrize("level", [3000, 3900])
def test_sensor_that_saturates_below_the_top_of_its_range(level):
    image = np.minimum(synthetic(12), level).astype(np.uint16)
    assert np.array_equal(saturated(image, 4095.0), image == level)
    assert saturated(image, 4095.0).sum() == 120


@pytest.mark.parametrize(("bits", "shift"), [(8, 0), (10, 0), (12, 0), (12, 4)])
@pytest.mark.parametrize("brightness", [0.1, 0.4, 0.7])
def test_noise_is_not_saturation(tmp_path, bits, shift, brightness):
    photons = np.random.default_rng(2).poisson(200 * brightness, SHAPE) / 200
    image = ((2**bits - 1) * np.clip(photons, 0, 0.97)).astype(np.uint16) << shift
    frames = saved(tmp_path, image.astype(np.uint8 if bits == 8 else np.uint16))
    assert not saturated(frames[0], full_scale(frames)).any()


def test_plateau_of_an_image_without_noise_is_not_saturation():
    image = np.full(SHAPE, 60, np.uint8)
    image[10:30, 10:50] = 200
    assert not saturated(image, 255.0).any()


def test_full_scale_of_several_sources(tmp_path):
    dark = saved(tmp_path, synthetic(10, reflection=False), name="dark.npy")
    assert full_scale(dark) == 1023
    assert not saturated(synthetic(12, reflection=False), 1023).any()  # brighter than the sampled frames
    assert full_scale(dark, saved(tmp_path, synthetic(12))) == 4095
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = synthetic(12, 4)[None]
        file["x"].attrs["bits"] = 12  # contradicted by the values
    assert full_scale(open_frames(tmp_path / "a.h5")) == 65520


@pytest.mark.parametrize(("peak", "bits"), [(200, 10), (1023, 10), (1024, 12), (4095, 12), (16383, 14), (16384, 16)])
def test_effective_bits_by_the_values(tmp_path, peak, bits):
    stack = np.zeros((4, *SHAPE), np.uint16)
    stack[0, 3, 4] = peak
    frames = saved(tmp_path, *stack)
    assert (effective_bits(frames), frames.bits) == (bits, 16)


def test_effective_bits_by_type_and_metadata(tmp_path):
    stack = np.stack([synthetic(12, seed=s) for s in range(4)])
    assert effective_bits(saved(tmp_path, *(stack // 16).astype(np.uint8))) == 8
    assert effective_bits(saved(tmp_path, *(stack / 4095).astype(np.float32))) == 1
    header = write_photron(tmp_path, packed(stack // 8), n=4, h=SHAPE[0], w=SHAPE[1])
    assert effective_bits(open_frames(header)) == 12


def test_exposure_warnings():
    rng = np.random.default_rng(0)
    image = (1000 + 20 * rng.standard_normal((20, 50))).astype(np.uint16)
    assert check_exposure(image, 4095.0, "ref_001.tif") is None
    image.flat[:42] = 4095
    assert "ref_001.tif: 4.2% of the pixels are over-exposed" in str(check_exposure(image, 4095.0, "ref_001.tif"))
    assert check_exposure(image, 4095.0, "x", limit=0.05) is None
    dark = np.full((40, 50), 41, np.uint16)
    dark[3, 4] = 4095  # a hot pixel
    assert "nearly black, 1.0%" in str(check_exposure(dark, 4095.0, "x"))
    assert check_exposure(dark, 1023.0, "x") is None
    assert "over-exposed" in str(check_exposure(np.ones((20, 50), np.float32), 1.0, "x"))
