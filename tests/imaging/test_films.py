"""Films have the frames, values and times that were recorded, and open quickly whatever their size."""

from __future__ import annotations

import os
import time

import av
import numpy as np
import pytest

from imaging_files import packed, write_cine
from nerif.imaging.readers.cine import TWELVE_BIT
from nerif.imaging.readers.frames import Frames
from nerif.imaging.readers.open import open_frames
from refusals import refused

N, H, W = 5, 6, 16
LUMINANCE = [0.299, 0.587, 0.114]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def same(frames: Frames, stack: np.ndarray) -> None:
    assert len(frames) == len(stack)
    for i in [*range(len(stack))[::-1], *range(len(stack))]:
        assert frames[i].dtype == stack.dtype
        np.testing.assert_array_equal(frames[i], stack[i])


def by_ffmpeg(path) -> np.ndarray:
    with av.open(str(path)) as film:
        return np.stack([frame.to_ndarray() for frame in film.decode(video=0)])


# --- Phantom


@pytest.mark.parametrize(("depth", "bits"), [(8, 8), (16, 10), (16, 12), (16, 14)])
def test_cine_of_grey_frames(tmp_path, rng, depth, bits):
    stack = rng.integers(0, 2**bits, (N, H, W)).astype(f"u{depth // 8}")
    path, times = tmp_path / "a.cine", np.arange(N) * 1.25e-5
    write_cine(path, [image[::-1].tobytes() for image in stack], H, W, depth, bits, times=times)
    frames = open_frames("a.cine", tmp_path)
    same(frames, stack)
    np.testing.assert_array_equal(by_ffmpeg(path) >> (depth - bits), stack)  # another reader; scales to the whole range
    assert (frames.bits, frames.cfa, frames.notes, frames.name(2)) == (bits, None, (), "a.cine frame 2")
    np.testing.assert_allclose(frames.times, times, atol=1e-9)
    same(open_frames("a.cine[1:3]", tmp_path), stack[1:3])
    write_cine(path, [image.tobytes() for image in stack], -H, W, depth, bits)  # from the top
    same(open_frames(path), stack)


@pytest.mark.parametrize("channel", ["u1", "u2"])
def test_cine_of_colours(tmp_path, rng, channel):
    stack = rng.integers(0, 256, (N, H, W, 3)).astype(channel)
    write_cine(tmp_path / "a.cine", [image[::-1, :, ::-1].tobytes() for image in stack], H, W, 24 * int(channel[1]), 8)
    same(open_frames(tmp_path / "a.cine"), np.rint(stack @ LUMINANCE).astype(channel))


@pytest.mark.parametrize(("h", "w"), [(6, 16), (5, 7)])
def test_cine_of_packed_12_bit(tmp_path, rng, h, w):
    stack = rng.integers(0, 4096, (N, h, w)).astype(np.uint16)
    write_cine(tmp_path / "a.cine", [packed(image) for image in stack], h, w, packing=1024)
    frames = open_frames(tmp_path / "a.cine")
    same(frames, stack)
    assert frames.bits == 12


@pytest.mark.parametrize(("h", "w"), [(6, 16), (5, 7)])
def test_cine_of_packed_10_bit_is_made_linear(tmp_path, rng, h, w):
    codes = rng.integers(0, 1024, (N, h, w))
    write_cine(tmp_path / "a.cine", [packed(image, 10) for image in codes], h, w, bits=10, packing=256)
    frames = open_frames(tmp_path / "a.cine")
    same(frames, TWELVE_BIT[codes])
    assert frames.bits == 12


def test_table_of_packed_10_bit():
    """Black and white of the format, and the curve of BT.709 between them, to 2.5 of 4095."""
    assert [TWELVE_BIT[code] for code in (0, 64, 1014, 1015, 1023)] == [2, 64, 4064, 4095, 4095]
    assert (np.diff(TWELVE_BIT.astype(int)) >= 0).all()
    u = (np.arange(20, 1015) - 64) / 950
    curve = 64 + 4000 * np.where(u < 0.081, u / 4.5, (np.maximum(u + 0.099, 0) / 1.099) ** (1 / 0.45))
    np.testing.assert_allclose(TWELVE_BIT[20:1015], curve, atol=2.5)


@pytest.mark.parametrize(("code", "cfa"), [(0, None), (3, "GBRG"), (4, "RGGB"), (5, "GRBG"), (6, "BGGR")])
def test_cine_of_raw_colours(tmp_path, rng, code, cfa):
    stack = rng.integers(0, 4096, (N, H, W)).astype(np.uint16)
    path = tmp_path / "a.cine"
    write_cine(path, [image[::-1].tobytes() for image in stack], H, W, compression=2, cfa=code)
    frames = open_frames(path)
    np.testing.assert_array_equal(frames.load(1), stack[1])
    assert (frames.cfa, frames.notes) == (cfa, ())
    if code in (3, 4):
        with av.open(str(path)) as film:
            frame = next(film.decode(video=0))
        assert frame.format.name == f"bayer_{cfa.lower()}16le"


def test_notes_about_a_cine(tmp_path, rng):
    data = [bytes(H * W * 2)] * N
    write_cine(tmp_path / "a.cine", data, H, W, compression=2, cfa=1, flip=1, times=[0, 0, 1, 2, 3], rate=500)
    frames = open_frames("a.cine", tmp_path)
    assert frames.cfa is None
    np.testing.assert_allclose(frames.times, np.arange(N) / 500)
    for note, word in zip(frames.notes, ("mosaic", "500 frames per second", "flipped"), strict=True):
        assert note.startswith("a.cine: ")
        assert word in note


def test_cine_of_20_gb_opens_at_once(tmp_path):
    h, w, n = 1024, 1280, 8000
    path = tmp_path / "a.cine"
    write_cine(path, [b"12"] * n, h, w, times=np.arange(n) / 1e4)
    data = bytearray(path.read_bytes())
    step, begin = 8 + 5 + h * w * 2, len(data) - n * (8 + 5 + 2)
    positions = begin + step * np.arange(n, dtype="<i8")
    data[begin - 8 * n : begin] = positions.tobytes()
    path.write_bytes(data[:begin])
    with path.open("r+b") as file:  # sparse
        file.truncate(begin + n * step)
        file.seek(positions[7777])
        file.write(b"\x0d\0\0\0event" + (h * w * 2).to_bytes(4, "little") + b"\x34\x12")
    assert path.stat().st_size > 20e9
    start = time.perf_counter()
    frames = open_frames(path)
    image = frames.load(7777)
    assert time.perf_counter() - start < 1
    assert (len(frames), image[-1, 0], image.max()) == (n, 0x1234, 0x1234)


@pytest.mark.parametrize("cut", [1, 3 * (H * W * 2 + 13) - 5])
def test_cine_that_breaks_off(tmp_path, rng, cut):
    stack = rng.integers(0, 4096, (N, H, W)).astype(np.uint16)
    path = tmp_path / "a.cine"
    write_cine(path, [image[::-1].tobytes() for image in stack], H, W)
    os.truncate(path, path.stat().st_size - cut)
    frames = open_frames("a.cine", tmp_path)
    first = N - 1 if cut == 1 else N - 3
    np.testing.assert_array_equal(frames[first - 1], stack[first - 1])
    for i in range(first, N):
        with refused(f"a.cine frame {i}"):
            frames[i]


def test_cine_of_an_interrupted_recording(tmp_path, rng):
    stack = rng.integers(0, 4096, (N, H, W)).astype(np.uint16)
    path = tmp_path / "a.cine"
    write_cine(path, [image[::-1].tobytes() for image in stack], H, W)
    data = bytearray(path.read_bytes())
    end = len(data) - N * (H * W * 2 + 13)
    data[end - 8 : end] = bytes(8)  # position of the last frame
    path.write_bytes(data)
    same(open_frames("a.cine[:4]", tmp_path), stack[:4])
    with refused("a.cine frame 4"):
        open_frames("a.cine", tmp_path)[4]


@pytest.mark.parametrize(
    "change",
    [{"compression": 1}, {"depth": 32}, {"packing": 512}, {"w": 0}],
)
def test_invalid_cine(tmp_path, change):
    write_cine(tmp_path / "a.cine", [bytes(H * W * 2)], **{"h": H, "w": W, **change})
    with refused("a.cine"):
        open_frames("a.cine", tmp_path)


def test_cine_without_its_header(tmp_path):
    write_cine(tmp_path / "a.cine", [bytes(H * W * 2)], H, W)
    data = (tmp_path / "a.cine").read_bytes()
    for content in (b"", data[:30], data[:300], data[:7000], b"RIFF" + data[4:]):
        (tmp_path / "a.cine").write_bytes(content)
        with refused("a.cine"):
            open_frames("a.cine", tmp_path)
