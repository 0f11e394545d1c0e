"""Films have the frames, values and times that were recorded, and open quickly whatever their size."""

from __future__ import annotations

import os
import pickle
import struct
import time
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import av
import numpy as np
import pytest
from av.video.frame import PictureType

from imaging_files import LUMINANCE, packed, same, write_cine
from nerif.common.conventions import InputError
from nerif.imaging.readers.cine import TWELVE_BIT
from nerif.imaging.readers.exposure import full_scale
from nerif.imaging.readers.frames import read_each
from nerif.imaging.readers.open import open_frames
from nerif.imaging.readers.video import CONTAINERS, VideoFrames
from refusals import refused

N, H, W = 5, 6, 16


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def by_ffmpeg(path) -> np.ndarray:
    with av.open(str(path)) as film:
        return np.stack([frame.to_ndarray() for frame in film.decode(video=0)])


# --- video


@pytest.mark.parametrize("suffix", [".avi", ".mp4", ".mkv"])
def test_a_script_by_the_name_of_a_film_opens_no_other_file(tmp_path, suffix):
    write_video(tmp_path / "b.avi", moving(3), "rawvideo", "gray")
    (tmp_path / f"a{suffix}").write_text("ffconcat version 1.0\nfile b.avi\n")
    with refused(f"a{suffix}"):
        open_frames(f"a{suffix}", tmp_path)


def write_video(path, images, codec="libx264", pixels="yuv420p", rate=30, options=()) -> None:
    """A film whose brightness has the values of the images (row, column), or whose colours those of R, G, B."""
    options = dict(options)
    with av.open(str(path), "w") as film:
        stream = film.add_stream(codec, rate=rate, options=options)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pixels
        if codec == "libx264":
            stream.codec_context.gop_size, stream.codec_context.max_b_frames = 8, 3
        for i, image in enumerate(images):
            if image.ndim == 3:
                frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixels)
            else:
                frame = av.VideoFrame(image.shape[1], image.shape[0], pixels)
                kind, step = image.dtype.newbyteorder(">" if "be" in pixels else "<"), 1 + (pixels == "yuyv422")
                for k, plane in enumerate(frame.planes):
                    values = np.full((plane.height, plane.line_size // image.itemsize), 128, kind)
                    if not k:
                        values[:, : step * plane.width : step] = image
                    plane.update(values)
            frame.pts = i
            film.mux(stream.encode(frame))
        film.mux(stream.encode())


def moving(n: int, h=48, w=64, top=255) -> np.ndarray:
    """Stripes that move, so that every frame differs from all others and codecs use reordered frames."""
    x = np.arange(w) + 3.7 * np.arange(n)[:, None, None] + 5 * np.sin(np.arange(h))[:, None]
    return np.rint((0.5 + 0.45 * np.sin(x / 5)) * top).astype(np.uint8 if top < 256 else np.uint16)


LOSSLESS = (("qp", "0"), ("preset", "fast"))


OPEN = (("x264-params", "open-gop=1"),)


@pytest.mark.parametrize(("suffix", "options"), [(".mp4", ()), (".mov", OPEN), (".mkv", OPEN), (".avi", OPEN)])
def test_every_frame_of_a_film_with_reordered_frames(tmp_path, rng, suffix, options):
    images = moving(26)
    write_video(tmp_path / f"a{suffix}", images, options=(("qp", "8"), *options))
    with av.open(str(tmp_path / f"a{suffix}")) as film:
        decoded = list(film.decode(video=0))
    assert PictureType.B in {frame.pict_type for frame in decoded}
    stack = np.stack([np.frombuffer(f.planes[0], np.uint8).reshape(48, -1)[:, :64] for f in decoded])
    np.testing.assert_allclose(stack, images.astype(float), atol=12)
    frames = open_frames(tmp_path / f"a{suffix}")
    same(frames, stack)
    for i in rng.permutation(26):
        np.testing.assert_array_equal(frames[i], stack[i])
    np.testing.assert_allclose(frames.times, np.arange(26) / 30, atol=1e-12)
    assert frames.white == 235
    assert "h264" in frames.notes[0]
    same(pickle.loads(pickle.dumps(frames)), stack)


@pytest.mark.parametrize(
    ("codec", "pixels", "suffix", "top"),
    [
        ("rawvideo", "gray", ".avi", 255), ("rawvideo", "yuyv422", ".avi", 255), ("ffv1", "gray", ".mkv", 255),
        ("ffv1", "gray12le", ".mkv", 4095), ("ffv1", "gray16le", ".avi", 65535),
        ("rawvideo", "gray16be", ".mov", 65535),
        ("ffv1", "yuv420p10le", ".mkv", 1023), ("libx264", "yuv420p10le", ".mp4", 1023), ("png", "gray", ".mov", 255),
    ],
)  # fmt: skip
def test_brightness_is_that_stored(tmp_path, codec, pixels, suffix, top):
    stack = moving(20, top=top)
    path, options = tmp_path / f"a{suffix}", LOSSLESS if codec == "libx264" else ()
    write_video(path, stack, codec, pixels, options=options)
    frames = open_frames(path)
    same(frames, stack)
    assert frames.bits == top.bit_length()
    assert frames.white == (235 << top.bit_length() - 8 if "yu" in pixels else None)
    assert not any("loss" in note for note in frames.notes) or codec == "libx264"


@pytest.mark.parametrize(("codec", "pixels"), [("rawvideo", "bgr24"), ("ffv1", "bgr0"), ("utvideo", "gbrp")])
def test_colours_of_films_become_luminance(tmp_path, rng, codec, pixels):
    stack = rng.integers(0, 256, (N, 48, 64, 3)).astype(np.uint8)
    write_video(tmp_path / "a.avi", stack, codec, pixels)
    frames = open_frames(tmp_path / "a.avi")
    same(frames, np.rint(stack @ LUMINANCE).astype(np.uint8))
    assert frames.white is None


def write_dib(path, images: np.ndarray, palette: np.ndarray, sign: int) -> None:
    """An AVI of Windows' grey bitmaps, with a palette before the first one; from the bottom where sign is 1."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)

    n, h, w = images.shape
    row = w + -w % 4
    frames = [b"".join(line.tobytes().ljust(row, b"\0") for line in image[::-sign]) for image in images]
    bitmap = struct.pack("<IiiHHIIiiII", 40, w, sign * h, 1, 8, 0, row * h, 0, 0, 256, 0) + palette.tobytes()
    stream = struct.pack("<4s4s10I4h", b"vids", b"DIB ", 0, 0, 0, 1, 25, 0, n, row * h, 0, 0, 0, 0, w, h)
    head = struct.pack("<14I", 40000, 0, 0, 16, n, 0, 1, row * h, w, h, 0, 0, 0, 0)
    streams = chunk(b"LIST", b"strl" + chunk(b"strh", stream) + chunk(b"strf", bitmap))
    body = b"AVI " + chunk(b"LIST", b"hdrl" + chunk(b"avih", head) + streams)
    body += chunk(b"LIST", b"movi" + b"".join(chunk(b"00db", frame) for frame in frames))
    entries = (struct.pack("<4s3I", b"00db", 16, 4 + k * (8 + row * h + row * h % 2), row * h) for k in range(n))
    path.write_bytes(chunk(b"RIFF", body + chunk(b"idx1", b"".join(entries))))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("width", [16, 17, 18])
def test_avi_of_windows_bitmaps(tmp_path, rng, sign, width):
    stack = rng.integers(0, 256, (4, 9, width)).astype(np.uint8)
    palette = np.repeat(np.arange(255, -1, -1, dtype=np.uint8), 4)  # dark and bright exchanged
    write_dib(tmp_path / "a.avi", stack, palette, sign)
    same(open_frames(tmp_path / "a.avi"), 255 - stack)
    np.testing.assert_array_equal(open_frames(tmp_path / "a.avi").single(2), 255 - stack[2])  # at once


def test_film_stored_from_the_bottom(tmp_path, rng, monkeypatch):
    monkeypatch.setitem(CONTAINERS, "format_whitelist", "cine")
    stack = rng.integers(0, 256, (3, H, W)).astype(np.uint8)
    write_cine(tmp_path / "a.cine", [image[::-1].tobytes() for image in stack], H, W, 8, 8)
    same(VideoFrames(tmp_path / "a.cine", "a.cine"), stack)  # FFmpeg has it with a negative step between rows


def test_a_film_is_read_by_several_threads(tmp_path):
    stack = moving(20)
    write_video(tmp_path / "a.mkv", stack, "ffv1", "gray")
    frames = open_frames(tmp_path / "a.mkv")
    numbers = [*range(20), *range(19, -1, -1)] * 3
    with ThreadPoolExecutor(4) as pool:
        for i, image in zip(numbers, pool.map(frames.load, numbers), strict=True):
            np.testing.assert_array_equal(image, stack[i])


def test_a_film_of_constant_rate_has_exact_times_and_others_their_own(tmp_path):
    write_video(tmp_path / "a.mkv", moving(7), "ffv1", "gray", rate=30)  # times to 1 ms in the file
    np.testing.assert_allclose(open_frames(tmp_path / "a.mkv").times, np.arange(7) / 30, atol=1e-12)
    with av.open(str(tmp_path / "b.mkv"), "w") as film:
        stream = film.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.time_base = 64, 48, "gray", Fraction(1, 1000)
        stream.codec_context.time_base = Fraction(1, 1000)
        for image, pts in zip(moving(4), (0, 40, 50, 200), strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame.pts, frame.time_base = pts, Fraction(1, 1000)
            film.mux(stream.encode(frame))
        film.mux(stream.encode())
    np.testing.assert_allclose(open_frames(tmp_path / "b.mkv").times, [0, 0.04, 0.05, 0.2])


def test_notes_about_a_video(tmp_path):
    write_video(tmp_path / "a.avi", moving(4), "mjpeg", "yuvj420p")
    loss, rate = open_frames("a.avi", tmp_path).notes
    assert loss.startswith("a.avi: compressed with loss (mjpeg)")
    assert rate.startswith("a.avi: times by its 30 frames per second")
    assert open_frames(tmp_path / "a.avi").white is None  # of full range
    write_video(tmp_path / "b.avi", moving(4), "rawvideo", "gray")
    (rate,) = open_frames("b.avi[1:]", tmp_path).notes
    assert "--frame-rate" in rate


def test_full_scale_of_limited_range(tmp_path):
    image = np.minimum(moving(2), 235)
    write_video(tmp_path / "a.mkv", image, "ffv1", "yuv420p")
    assert full_scale(open_frames(tmp_path / "a.mkv")) == 235
    image[0, 3, 4] = 250  # cameras that use the range above
    write_video(tmp_path / "a.mkv", image, "ffv1", "yuv420p")
    assert full_scale(open_frames(tmp_path / "a.mkv")) == 255


def test_a_film_is_decoded_once_when_read_in_order(tmp_path, monkeypatch):
    write_video(tmp_path / "a.mp4", moving(50))
    frames = open_frames(tmp_path / "a.mp4")
    starts = []
    start = VideoFrames._start
    monkeypatch.setattr(VideoFrames, "_start", lambda self, key: (starts.append(key), start(self, key)))
    for i in range(1, 50):
        frames.load(i)
    assert len(starts) == 1


@pytest.mark.parametrize("suffix", [".avi", ".mkv"])
def test_truncated_video(tmp_path, suffix):
    stack = moving(30)
    path = tmp_path / f"a{suffix}"
    write_video(path, stack, "rawvideo" if suffix == ".avi" else "ffv1", "gray")
    os.truncate(path, path.stat().st_size // 2)
    frames = open_frames(path.name, tmp_path)
    assert 5 < len(frames) < 30
    errors = dict(read_each(frames, range(len(frames))))
    bad = [i for i, image in errors.items() if isinstance(image, InputError)]
    assert bad in ([], [len(frames) - 1])
    for i in set(errors) - set(bad):
        np.testing.assert_array_equal(errors[i], stack[i])
    assert any("truncated" in note for note in frames.notes) or suffix == ".mkv"


def test_videos_that_cannot_be_read(tmp_path):
    write_video(tmp_path / "a.mp4", moving(30))
    os.truncate(tmp_path / "a.mp4", 2000)  # its index is at the end
    (tmp_path / "b.avi").write_bytes(b"")
    (tmp_path / "c.mkv").write_text("no film")
    for name in ("a.mp4", "b.avi", "c.mkv"):
        with refused(name):
            open_frames(name, tmp_path)
    write_video(tmp_path / "d.avi", moving(4, top=65535), "rawvideo", "gray16le")  # read as colours of 5 bit
    with pytest.raises(InputError, match=r"^d.avi frame 1: .*16-bit grey AVI"):
        open_frames("d.avi", tmp_path)[1]


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
@pytest.mark.parametrize(("bits", "packing"), [(10, 256), (12, 1024)])
def test_cine_of_packed_values_of_which_10_bit_are_made_linear(tmp_path, rng, h, w, bits, packing):
    stack = rng.integers(0, 2**bits, (N, h, w)).astype(np.uint16)
    write_cine(tmp_path / "a.cine", [packed(image, bits) for image in stack], h, w, bits=bits, packing=packing)
    frames = open_frames(tmp_path / "a.cine")
    same(frames, TWELVE_BIT[stack] if bits == 10 else stack)
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


@pytest.mark.parametrize("change", [{"compression": 1}, {"depth": 32}, {"packing": 512}, {"w": 0}])
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
