"""Images are read lazily, in order and as written; an error names the file."""

from __future__ import annotations

import io
import os
import struct
import sys
import types
import zlib
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from imageio import v3
from PIL import EpsImagePlugin, Image

from imaging_files import (
    LUMINANCE,
    packed,
    same,
    stamped,
    write_b16,
    write_cv,
    write_dng,
    write_images,
    write_packed_tiff,
    write_photron,
    write_tiff,
)  # fmt: skip
from nerif.common.conventions import InputError
from nerif.data.volume_file import read_volume
from nerif.imaging.calibration.importers.matlab import read_matlab
from nerif.imaging.readers import image_files
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.frames import Frames, read_each
from nerif.imaging.readers.open import open_frames
from nerif.imaging.readers.views import View
from refusals import refused

N, H, W = 4, 7, 10
PACKED = Path(__file__).parents[3] / "shared" / "data" / "surface" / "circular_1.tif"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


@pytest.fixture
def stack8(rng) -> np.ndarray:
    return rng.integers(0, 256, (N, H, W)).astype(np.uint8)


@pytest.fixture
def stack12(rng) -> np.ndarray:
    return rng.integers(3000, 4096, (N, H, W)).astype(np.uint16)


def good_frames(frames: Frames) -> tuple[list[int], dict[str, str]]:
    """Numbers of the readable frames, and the errors of the others by their names."""
    images = dict(read_each(frames, range(len(frames))))
    errors = {i: x for i, x in images.items() if isinstance(x, InputError)}
    return [i for i in images if i not in errors], {error.field: str(error) for error in errors.values()}


# --- images


@pytest.mark.parametrize(
    "options", [{}, {"compression": "zlib"}, {"bigtiff": True}, {"byteorder": ">"}, {"imagej": True}]
)
def test_tiff_stack(tmp_path, stack12, options):
    write_tiff(tmp_path / "stack.tif", stack12, photometric="minisblack", **options)
    frames = open_frames("stack.tif", tmp_path)
    same(frames, stack12)
    assert (frames.bits, frames.times, frames.name(2)) == (16, None, "stack.tif frame 2")
    np.testing.assert_array_equal(frames[-1], stack12[-1])
    np.testing.assert_array_equal(np.stack(list(frames)), stack12)
    with pytest.raises(IndexError):
        frames[N]


def test_several_tiffs_of_several_pages(tmp_path, stack12):
    write_tiff(tmp_path / "a1.tif", stack12[:3], photometric="minisblack")
    write_tiff(tmp_path / "a2.TIFF", stack12[3])
    frames = open_frames(".", tmp_path)
    same(frames, stack12)
    assert [frames.name(i) for i in (2, 3)] == ["a1.tif frame 2", "a2.TIFF"]


def test_tiff_compressed_by_lzw(tmp_path, stack8):
    first, *others = [Image.fromarray(image) for image in stack8]
    first.save(tmp_path / "lzw.tif", compression="tiff_lzw", save_all=True, append_images=others)
    same(open_frames(tmp_path / "lzw.tif"), stack8)


@pytest.mark.parametrize("width", [12, 13, 7])  # 10 bit: rows of whole bytes, or not
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("fill", [1, 2])
@pytest.mark.parametrize("bits", [9, 10, 11, 12, 14, 15])
def test_tiff_with_packed_bits(tmp_path, rng, bits, fill, order, width):
    stack = rng.integers(0, 2**bits, (3, 8, width)).astype(np.uint16)
    path = tmp_path / "p.tif"
    write_packed_tiff(path, stack, bits, 3, fill, order)
    frames = open_frames(path)
    same(frames, stack)
    assert frames.bits == bits
    if bits in (10, 12, 14) and order == "<":  # another reader, which shifts the values to the top
        _, images = cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(np.stack(images) >> 16 - bits, stack)


def test_truncated_packed_tiff(tmp_path, rng):
    stack = rng.integers(0, 1024, (2, 8, 12)).astype(np.uint16)
    write_packed_tiff(tmp_path / "p.tif", stack, 10, 8)
    data = bytearray((tmp_path / "p.tif").read_bytes())
    end = len(data)
    struct.pack_into("<I", data, end - 4 - 4 * 12 + 8, end - 30)  # the offset of the second page
    (tmp_path / "p.tif").write_bytes(data)
    frames = open_frames("p.tif", tmp_path)
    np.testing.assert_array_equal(frames[0], stack[0])
    with refused("p.tif frame 1"):
        frames[1]


@pytest.mark.skipif(not PACKED.is_file(), reason="shared/data is missing")
def test_packed_tiff_of_a_camera():
    frames = open_frames(PACKED)
    assert (frames.bits, frames.shape, frames[0].min(), frames[0].max()) == (10, (1024, 1024), 1, 1023)


def test_bits_of_metadata(tmp_path, stack12):
    write_tiff(tmp_path / "max.tif", stack12[0], extratags=[(281, "H", 1, 4095, True)])
    write_tiff(tmp_path / "x.ome.tif", stack12[0], metadata={"axes": "YX", "SignificantBits": 14})
    assert [open_frames(tmp_path / name).bits for name in ("max.tif", "x.ome.tif")] == [12, 14]
    write_cv(tmp_path / "a.png", stack12[0] << 4)
    data = (tmp_path / "a.png").read_bytes()
    chunk = struct.pack(">I", 1) + b"sBIT\x0c" + struct.pack(">I", zlib.crc32(b"sBIT\x0c"))
    (tmp_path / "a.png").write_bytes(data[:33] + chunk + data[33:])  # behind the signature and IHDR
    frames = open_frames(tmp_path / "a.png")
    same(frames, stack12[:1])
    assert frames.bits == 12


@pytest.mark.parametrize(("codes", "cfa"), [(bytes([0, 1, 1, 2]), "RGGB"), (bytes([1, 2, 0, 1]), "GBRG")])
def test_bayer_pattern_of_tiff(tmp_path, stack12, codes, cfa):
    tags = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, codes, True)]
    write_tiff(tmp_path / "a.tif", stack12[0], photometric="cfa", extratags=tags)
    write_tiff(tmp_path / "grey.tif", stack12[0], extratags=tags)
    frames = open_frames(tmp_path / "a.tif")
    np.testing.assert_array_equal(frames.load(0), stack12[0])
    assert [frames.cfa, open_frames(f"{tmp_path}/a.tif[:]").cfa] == [cfa, cfa]
    assert open_frames(tmp_path / "grey.tif").cfa is None


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".pgm"])
def test_images_of_8_bit(tmp_path, stack8, suffix):
    write_images(tmp_path / "cam1", stack8, suffix)
    frames = open_frames("cam1", tmp_path)
    same(frames, stack8)
    assert (frames.bits, frames.name(3)) == (8, f"cam1/ref_003{suffix}")


def test_png_and_jpeg_by_other_programs(tmp_path, stack8, stack12):
    write_images(tmp_path / "cam1", stack12)
    same(open_frames(tmp_path / "cam1" / "ref_*.png"), stack12)
    v3.imwrite(tmp_path / "a.png", stack8[0])
    same(open_frames(tmp_path / "a.png"), stack8[:1])
    smooth = (np.add.outer(np.arange(16), 2 * np.arange(24)) * 3).astype(np.uint8)
    write_cv(tmp_path / "a.jpg", smooth)
    np.testing.assert_allclose(open_frames(tmp_path / "a.jpg")[0], smooth.astype(float), atol=12)


@pytest.mark.parametrize(("top", "bits"), [(255, 8), (1023, 10), (4095, 12), (65535, 16), (4000, 16)])
def test_pgm_of_all_depths(tmp_path, rng, top, bits):
    images = rng.integers(0, top, (2, H, W), endpoint=True).astype(np.uint8 if top < 256 else np.uint16)
    head = f"P5\n# of a camera\n{W} {H}\n{top}\n".encode()
    for i, image in enumerate(images):
        (tmp_path / f"{i}.pgm").write_bytes(head + (image if top < 256 else image.astype(">u2")).tobytes())
    frames = open_frames(tmp_path)
    same(frames, images)
    assert frames.bits == bits
    (tmp_path / "0.pgm").write_text(f"P2 {W} {H} {top}\n" + " ".join(map(str, images[0].ravel())))
    same(open_frames(tmp_path), images)


def test_jpeg_2000_and_webp_and_pcoraw(tmp_path, stack8, stack12):
    (tmp_path / "jp2").mkdir()
    for i, image in enumerate(stack12):
        Image.fromarray(image).save(tmp_path / "jp2" / f"{i}.jp2", irreversible=False)
    same(open_frames(tmp_path / "jp2"), stack12)
    Image.fromarray(stack8[0]).save(tmp_path / "a.webp", lossless=True)
    same(open_frames(tmp_path / "a.webp"), stack8[:1])
    write_tiff(tmp_path / "film.pcoraw", stack12, photometric="minisblack", bigtiff=True)
    same(open_frames(tmp_path / "film.pcoraw"), stack12)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".ppm", "planes.tif"])
def test_colours_become_luminance(tmp_path, rng, suffix):
    rgb = rng.integers(0, 256, (H, W, 3)).astype(np.uint8)
    path = tmp_path / f"a{suffix}"
    if suffix == "planes.tif":
        write_tiff(path, np.moveaxis(rgb, -1, 0), photometric="rgb", planarconfig="separate")
    elif suffix == ".tif":
        write_tiff(path, rgb, photometric="rgb")
    else:
        write_cv(path, rgb[..., ::-1])
    same(open_frames(path), np.rint(rgb @ LUMINANCE).astype(np.uint8)[None])


def test_equal_channels_and_alpha_change_nothing(tmp_path, stack12, rng):
    alpha = rng.integers(0, 65536, (H, W)).astype(np.uint16)
    write_cv(tmp_path / "a.png", np.dstack([stack12[0]] * 3 + [alpha]))
    same(open_frames(tmp_path / "a.png"), stack12[:1])


def test_natural_order(tmp_path, stack8):
    folder = tmp_path / "run[3]"  # brackets are literal
    folder.mkdir()
    for i, name in enumerate(("img1", "img2", "img10", "Img11")):
        write_cv(folder / f"{name}.png", stack8[i])
    (folder / "._img3.png").write_bytes(b"of another system")
    (folder / "notes.txt").write_text("x")
    for spec, expected in (("", stack8), ("*", stack8), ("img?.png", stack8[:2]), ("*.png[1:]", stack8[1:])):
        same(open_frames(f"{folder}/{spec}"), expected)
    for names in (("run_-3", "run_-2", "run_0", "run_2"), ("run-3", "run-2", "run0", "run2"), ("-11", "-2", "0", "7")):
        below = tmp_path / names[0]
        below.mkdir()
        for image, name in zip(stack8, names, strict=True):
            write_cv(below / f"{name}.png", image)
        same(open_frames(below), stack8)
        assert open_frames(below).numbers[-1] == int(names[-1].strip("run_"))


# --- Photron


@pytest.mark.parametrize("xml", [False, True])
@pytest.mark.parametrize(("h", "w"), [(7, 10), (7, 9), (1, 3)], ids=["even", "odd", "tiny"])
def test_photron_packed_12_bit(tmp_path, rng, xml, h, w, monkeypatch):
    stack = rng.integers(0, 4096, (5, h, w)).astype(np.uint16)
    header = write_photron(tmp_path, packed(stack), 5, h, w, xml=xml)
    monkeypatch.chdir(tmp_path)
    for path in (header, header.name, tmp_path / "rec.mraw"):
        same(open_frames(path), stack)
    frames = open_frames(header.name, tmp_path)
    assert (frames.bits, frames.name(3)) == (12, "rec.mraw frame 3")
    np.testing.assert_allclose(frames.times, np.arange(5) / 20000)


@pytest.mark.parametrize(
    ("bit", "depth", "side", "shift"), [(8, 8, "Lower", 0), (16, 12, "Lower", 0), (16, 12, "Higher", 4)]
)
def test_photron_whole_bytes(tmp_path, rng, bit, depth, side, shift):
    stack = rng.integers(0, 255, (N, H, W)).astype(np.uint8 if bit == 8 else np.uint16)
    header = write_photron(tmp_path, (stack << shift).tobytes(), bit=bit, depth=depth, side=side, rate=500)
    frames = open_frames(header)
    same(frames, stack)
    assert frames.bits == depth
    np.testing.assert_allclose(frames.times, np.arange(N) / 500)


def test_photron_reads_one_frame_of_a_long_recording(tmp_path):
    n, h, w = 2000, 1024, 1000  # a sparse file of 3 GB
    header = write_photron(tmp_path, b"", n, h, w)
    with (tmp_path / "rec.mraw").open("r+b") as file:
        file.truncate(n * h * w * 3 // 2)
        file.seek(777 * h * w * 3 // 2)
        file.write(b"\x12\x34\x56")
    frames = open_frames(header)
    assert len(frames) == n
    assert frames[777][0, :3].tolist() == [0x123, 0x456, 0]


def test_truncated_photron_file(tmp_path, stack12):
    header = write_photron(tmp_path, packed(stack12)[: 2 * H * W * 3 // 2 + 20])
    frames = open_frames(header.name, tmp_path)
    good, errors = good_frames(frames)
    assert (good, list(errors)) == ([0, 1], ["rec.mraw frame 2", "rec.mraw frame 3"])
    np.testing.assert_array_equal(frames[1], stack12[1])


@pytest.mark.parametrize("change", [{"bit": 36}, {"kind": "Tiff"}, {"n": 0}, {"h": "none"}, {"w": 640.5}])
def test_invalid_photron_header(tmp_path, change):
    write_photron(tmp_path, b"", **change)
    with refused("rec.cih"):
        open_frames("rec.cih", tmp_path)


def test_photron_needs_both_files(tmp_path):
    header = write_photron(tmp_path, b"")
    (tmp_path / "rec.mraw").unlink()
    with refused("rec.cih"):
        open_frames("rec.cih", tmp_path)
    header.rename(tmp_path / "rec.mraw")
    with refused("rec.mraw"):
        open_frames("rec.mraw", tmp_path)
    (tmp_path / "rec.cih").write_text("nothing of use\n")
    with refused("rec.cih"):
        open_frames("rec.cih", tmp_path)


# --- PCO


@pytest.mark.parametrize("extended", [False, True])
def test_b16_of_pco(tmp_path, stack12, extended):
    for i, image in enumerate(stack12):
        write_b16(tmp_path / f"a{i}.b16", image, b"a comment" * i, extended)
    same(open_frames(tmp_path), stack12)
    data = (tmp_path / "a1.b16").read_bytes()
    (tmp_path / "a1.b16").write_bytes(data[:-1])
    (tmp_path / "a2.b16").write_bytes(b"BM" + data[2:])
    (tmp_path / "a3.b16").write_bytes(b"")
    good, errors = good_frames(open_frames(".", tmp_path))
    assert (good, list(errors)) == ([0], ["a1.b16", "a2.b16", "a3.b16"])


@pytest.mark.parametrize("shift", [0, 2, 4])
def test_time_stamps_of_pco_are_noted(tmp_path, rng, shift):
    image = stamped(rng.integers(0, 65536, (H, 20)).astype(np.uint16), shift)
    write_b16(tmp_path / "a.b16", image)
    write_tiff(tmp_path / "b.tif", np.stack([image] * 2), photometric="minisblack")
    for name in ("a.b16", "b.tif"):
        (note,) = open_frames(name, tmp_path).notes
        assert note.startswith(f"{name}: ")
        assert "2024-05-03 12:34:56" in note
        np.testing.assert_array_equal(open_frames(name, tmp_path)[0], image)


@pytest.mark.parametrize("value", [0, 5, 0x11])
def test_grey_values_are_no_time_stamps(tmp_path, rng, value):
    for i, image in enumerate((np.full((H, 20), value, np.uint16), stamped(np.zeros((H, 20), np.uint16))[:, :12])):
        write_tiff(tmp_path / f"{i}.tif", image)
        assert open_frames(tmp_path / f"{i}.tif").notes == ()


# --- photo cameras


@pytest.mark.parametrize(("codes", "cfa"), [(bytes([0, 1, 1, 2]), "RGGB"), (bytes([1, 0, 2, 1]), "GRBG")])
def test_raw_images_of_photo_cameras(tmp_path, rng, codes, cfa):
    stack = rng.integers(60, 4001, (2, 60, 80)).astype(np.uint16)
    stack[:, 3, 5] = 4000
    for i, image in enumerate(stack):
        write_dng(tmp_path / f"IMG_{i}.dng", image, codes, 64, 4000)
    frames = open_frames(".", tmp_path)
    for i, image in enumerate(stack):
        np.testing.assert_array_equal(frames.load(i), np.maximum(image, 64) - 64)  # less the black level
    assert (len(frames), frames.cfa, frames.bits, frames.white, frames.name(1)) == (2, cfa, 12, 3936, "IMG_1.dng")
    assert frames.notes == ()
    (tmp_path / "IMG_2.dng").write_bytes((tmp_path / "IMG_1.dng").read_bytes()[:3000])
    with refused("IMG_2.dng"):
        open_frames("IMG_2.dng", tmp_path)[0]


@pytest.mark.parametrize(
    ("package", "name", "words"),
    [
        ("rawpy", "a.NEF", r"\[raw\]', or export"), ("av", "a.avi", r"\[video\]', or export"),
        *(("lvpyio", name, r"\[lavision\]'.*LaVision's own terms") for name in ("a.im7", "a.vc7")),
    ],
)  # fmt: skip
def test_files_without_the_package_that_reads_them(tmp_path, monkeypatch, package, name, words):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).touch()
    with pytest.raises(InputError, match=f"pip install 'nerif-bost{words}"):
        open_frames(tmp_path / name)


# --- LaVision


@pytest.fixture
def lavision(monkeypatch):
    """A substitute for lvpyio 1.5, whose files are NumPy arrays; returns the paths that are read."""
    reads = []

    def read_buffer(path):
        assert isinstance(path, str)
        reads.append(path)
        try:
            stack = np.load(io.BytesIO(Path(path).read_bytes()))
        except ValueError:
            raise RuntimeError("Can't read buffers with different frame sizes yet!") from None
        key = "PIXEL" if path.endswith(".im7") else "U0"
        return [types.SimpleNamespace(components={key: types.SimpleNamespace(planes=[a])}) for a in stack]

    monkeypatch.setitem(sys.modules, "lvpyio", types.SimpleNamespace(read_buffer=read_buffer))
    return reads


def write_lavision(path: Path, stack: np.ndarray) -> None:
    with path.open("wb") as file:
        np.save(file, stack)


def test_lavision_images(tmp_path, stack12, lavision):
    write_lavision(tmp_path / "B00001.im7", stack12[:2])
    write_lavision(tmp_path / "B00002.im7", stack12[2:])
    frames = open_frames(".", tmp_path)
    assert len(lavision) == 1  # all have as many images as the first
    same(frames, stack12)
    assert frames.name(3) == "B00002.im7 frame 1"
    same(open_frames(tmp_path / "B00002.im7[1]"), stack12[3:])


def test_invalid_lavision_files(tmp_path, stack12, lavision):
    write_lavision(tmp_path / "a.vc7", stack12)
    with pytest.raises(InputError, match=r"a.vc7: expected images, got vectors"):
        open_frames("a.vc7", tmp_path)[0]
    write_lavision(tmp_path / "B1.im7", stack12[:2])
    write_lavision(tmp_path / "B2.im7", stack12[:1])
    (tmp_path / "B3.im7").write_bytes(b"damaged")
    frames = open_frames("*.im7", tmp_path)
    errors = [str(image) for _, image in read_each(frames, range(3, 6)) if isinstance(image, InputError)]
    assert good_frames(frames)[0] == [0, 1, 2]
    assert errors[0].startswith("B2.im7 frame 1: expected at least 2 images")
    assert errors[1].startswith("B3.im7 frame 0: cannot be read")
    assert "different frame sizes" in errors[1]


# --- arrays


def test_npy_is_mapped(tmp_path, stack12):
    np.save(tmp_path / "a.npy", stack12)
    frames = open_frames(tmp_path / "a.npy")
    same(frames, stack12)
    assert isinstance(frames._array, np.memmap)
    np.save(tmp_path / "one.npy", stack12[0])
    one = open_frames("one.npy", tmp_path)
    same(one, stack12[:1])
    assert one.name(0) == "one.npy"
    np.save(tmp_path / "none.npy", stack12[:0])
    with refused("none.npy"):
        open_frames("none.npy", tmp_path)


def test_npz(tmp_path, stack12, stack8):
    np.savez(tmp_path / "a.npz", flow=stack12, times=np.arange(4.0))
    same(open_frames(tmp_path / "a.npz"), stack12)
    np.savez_compressed(tmp_path / "b.npz", flow=stack12, ref=stack8)
    same(open_frames(f"{tmp_path}/b.npz:ref[1:]"), stack8[1:])
    for spec in ("b.npz", "b.npz:x"):
        with refused(spec):
            open_frames(spec, tmp_path)


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.h5"])
def test_truncated_arrays(tmp_path, stack12, name):
    if name == "a.h5":
        with h5py.File(tmp_path / name, "w") as file:
            file["x"] = stack12
    else:
        (np.save if name == "a.npy" else np.savez)(tmp_path / name, stack12)
    os.truncate(tmp_path / name, (tmp_path / name).stat().st_size - 100)
    with refused(name):
        open_frames(name, tmp_path)


def test_hdf5(tmp_path, stack12, stack8):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["cam1/flow"] = stack12
        file["cam1/flow"].attrs["bits"] = 12
        file["cam1/times"] = np.arange(N) * 0.5
        file["cam2/still"] = stack8[0]
        file["cam2/still"].attrs["times"] = 7.0
    frames = open_frames(f"{tmp_path}/a.h5:/cam1/flow[1::2]")
    same(frames, stack12[1::2])
    assert frames.bits == 12
    np.testing.assert_allclose(frames.times, [0.5, 1.5])
    one = open_frames("a.h5:cam2/still", tmp_path)
    same(one, stack8[:1])
    assert (one.times.tolist(), one.name(0)) == ([7.0], "a.h5:cam2/still")
    for spec in ("a.h5", "a.h5:cam3", "a.h5:cam1/times"):
        with refused(spec):
            open_frames(spec, tmp_path)


def test_hdf5_with_one_dataset_and_wrong_times(tmp_path, stack12):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["deep/in/it"] = stack12
    same(open_frames(tmp_path / "a.hdf5"), stack12)
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["deep/in/times"] = np.arange(3.0)
    with refused("a.hdf5"):
        open_frames("a.hdf5", tmp_path)


def test_hdf5_of_matlab_has_rows_and_columns_exchanged(tmp_path, stack12):
    """MATLAB's images(:, :, k), stored by columns: version 7.3 of its .mat marks it, h5write does not."""
    by_columns = stack12.transpose(0, 2, 1)
    with h5py.File(tmp_path / "v73.h5", "w", userblock_size=512) as file:
        file["images"] = by_columns
        file["images"].attrs["MATLAB_class"] = np.bytes_("uint16")
        file["times"] = np.arange(N, dtype=float)[:, None]
        file["times"].attrs["MATLAB_class"] = np.bytes_("double")
    with (tmp_path / "v73.h5").open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116))
    frames = open_frames("v73.h5:images", tmp_path)
    same(frames, stack12)
    assert frames.times.tolist() == list(range(N))
    with h5py.File(tmp_path / "h5write.h5", "w") as file:
        file["images"] = by_columns
    transpose = Crop(rotate=90, flip="vertical")
    np.testing.assert_array_equal([transpose(image) for image in open_frames("h5write.h5", tmp_path)], stack12)


# --- selections, laziness


@pytest.mark.parametrize(
    ("selection", "expected"),
    [("[1]", [1]), ("[-1]", [3]), ("[0:2]", [0, 1]), ("[::2]", [0, 2]), ("[::-1]", [3, 2, 1, 0]), ("[2:99]", [2, 3])],
)
def test_selection(tmp_path, stack12, selection, expected):
    header = write_photron(tmp_path, packed(stack12))
    frames = open_frames(f"{header}{selection}")
    same(frames, stack12[expected])
    np.testing.assert_allclose(frames.times, np.array(expected) / 20000)
    assert frames.name(0).endswith(f"rec.mraw frame {expected[0]}")
    write_images(tmp_path / "cam1", stack12)
    same(open_frames(f"cam1/ref_*.png{selection}", tmp_path), stack12[expected])
    same(open_frames(f"cam1{selection}", tmp_path), stack12[expected])


@pytest.mark.parametrize("selection", ["[4]", "[-5]", "[9:]", "[::0]"])
def test_empty_selection(tmp_path, stack8, selection):
    np.save(tmp_path / "a.npy", stack8)
    with refused(f"a.npy{selection}"):
        open_frames(f"a.npy{selection}", tmp_path)


def test_files_are_read_on_access(tmp_path, rng, monkeypatch):
    write_images(tmp_path / "cam1", rng.integers(0, 256, (30, H, W)).astype(np.uint8))
    reads = []
    load = image_files.FileFrames.load
    monkeypatch.setattr(image_files.FileFrames, "load", lambda self, i: (reads.append(i), load(self, i))[1])
    frames = open_frames(tmp_path / "cam1")
    assert (len(frames), reads) == (30, [])
    assert (frames.shape, len(reads)) == ((H, W), 5)
    frames[11]
    assert reads[5:] == [11]


# --- crops and pairs of sequences


@pytest.mark.parametrize("flip", ["", "horizontal", "vertical", "both"])
@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
def test_crop_then_rotation_then_flip(flip, rotate):
    image = np.arange(9 * 14, dtype=np.uint16).reshape(9, 14)
    expected = np.rot90(image[2:7, 3:11], rotate // 90)
    expected = np.fliplr(expected) if flip in ("horizontal", "both") else expected
    expected = np.flipud(expected) if flip in ("vertical", "both") else expected
    crop = Crop(2, 3, 5, 8, flip, rotate)
    np.testing.assert_array_equal(crop(image), expected)
    assert crop(image).flags.c_contiguous
    assert crop.shape_of(image.shape) == expected.shape


def test_crop_up_to_the_edge():
    image = np.arange(9 * 14).reshape(9, 14)
    np.testing.assert_array_equal(Crop()(image), image)
    np.testing.assert_array_equal(Crop(row=2, column=5, width=4)(image), image[2:, 5:9])
    assert Crop(rotate=90)(image)[0, 0] == image[0, -1]  # counter-clockwise


@pytest.mark.parametrize("crop", [Crop(5, 0, 5, 3), Crop(0, 12, 3, 3), Crop(9), Crop(0, 14)])
def test_crop_beyond_the_frame(crop):
    with refused("crop"):
        crop(np.zeros((9, 14)))


def test_reference_and_flow_have_one_size_and_depth(tmp_path, stack12, stack8):
    for name, array in (("ref", stack12), ("small", stack12[:, :5]), ("bytes", stack8)):
        np.save(tmp_path / f"{name}.npy", array)
    header = write_photron(tmp_path, packed(stack12))
    pairs = {"ref.npy": "ref.npy", f"{header}[:1]": f"{header}[1:]", str(header): "ref.npy"}  # 16 bit may be 12
    for reference, flow in pairs.items():
        View("a", tmp_path, {"reference": reference, "flow": flow}).check_alike()
    for flow in ("small.npy", "bytes.npy"):
        with refused("view 'a'"):
            View("a", tmp_path, {"reference": "ref.npy", "flow": flow}).check_alike()


# --- errors


@pytest.mark.parametrize(
    ("spec", "field", "remedy"),
    [
        ("cam1/ref_04.png", "cam1/ref_04.png", "did you mean 'cam1/ref_00[0-3].png'"),
        ("Cam2/ref_*.png", "Cam2/ref_*.png", "did you mean 'cam1'"),
        ("cam1/flow_*.tif", "cam1/flow_*.tif", "none"),
        ("zzz", "zzz", "folder$"),
        ("nowhere/at/all.tif", "nowhere/at/all.tif", "no such"),
        ("empty", "empty", "is it the right folder"),
        ("arrays", "arrays", "got 2 files ending in .npy; name one file, such as 'arrays/a.npy'"),
        (
            "films",
            "films",
            "got 3 files ending in .wmv, 1 file without ending, 1 folder; .* export other formats as TIFF",
        ),
        ("films/*.wmv", "films/*.wmv", "got 3 files ending in .wmv; .* TIFF"),
        ("notes.txt", "notes.txt", "'.txt'; export other formats as TIFF"),
        ("arrays/*.npy", "arrays/a.npy", "one recording"),
        ("flow.seq", "flow.seq", "got a file of Norpix StreamPix: export it there as a sequence of TIFF"),
        ("fits", "fits", "got 1 file ending in .fits; they are of FITS: open it in ImageJ"),
        ("fits/*.fits", "fits/*.fits", "they are of FITS: open it in ImageJ"),
        ("dark.sif", "dark.sif", "got a file of Andor Solis: export it there as TIFF"),
    ],
)
def test_missing_files(tmp_path, stack8, spec, field, remedy):
    write_images(tmp_path / "cam1", stack8)
    for name in ("empty", "arrays"):
        (tmp_path / name).mkdir()
    (tmp_path / "films" / "old").mkdir(parents=True)
    for name in ("1.wmv", "2.WMV", "3.wmv", "readme", ".hidden"):
        (tmp_path / "films" / name).touch()
    for name in "ab":
        np.save(tmp_path / "arrays" / f"{name}.npy", stack8)
    (tmp_path / "notes.txt").touch()
    (tmp_path / "flow.seq").touch()
    (tmp_path / "dark.sif").touch()
    (tmp_path / "fits").mkdir()
    (tmp_path / "fits" / "a.fits").touch()
    with pytest.raises(InputError, match=remedy) as error:
        open_frames(spec, tmp_path)
    assert error.value.field == field


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg", ".tif"])
def test_a_drawing_by_the_name_of_an_image_starts_no_ghostscript(tmp_path, monkeypatch, suffix):
    Image.new("L", (10, 7)).save(tmp_path / "a.eps")
    (tmp_path / "a.eps").rename(tmp_path / f"a{suffix}")
    starts = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_, **__: starts.append(1) or Image.new("L", (10, 7)))
    with refused(f"a{suffix}"):
        open_frames(f"a{suffix}", tmp_path)[0]
    assert not starts


@pytest.mark.parametrize("kind", ["storage", "link", "virtual"])
@pytest.mark.parametrize(("name", "read"), [("a.h5", open_frames), ("a.nc", read_volume), ("a.mat", read_matlab)])
def test_a_part_of_another_file_is_not_read(tmp_path, kind, name, read):
    (tmp_path / "outside").mkdir()
    other = tmp_path / "outside" / "secret"
    other.write_bytes(bytes(range(70)))
    with h5py.File(tmp_path / "outside" / "x.h5", "w") as file:
        file["x"] = np.zeros((H, W), np.uint8)
    with h5py.File(tmp_path / name, "w") as file:
        group = file.create_group("group")
        if kind == "storage":
            group.create_dataset("x", (H, W), np.uint8, external=[(str(other), 0, h5py.h5f.UNLIMITED)])
        elif kind == "link":
            group["x"] = h5py.ExternalLink("outside/x.h5", "x")
        else:
            layout = h5py.VirtualLayout((H, W), np.uint8)
            layout[:] = h5py.VirtualSource(tmp_path / "outside" / "x.h5", "x", (H, W))
            group.create_virtual_dataset("x", layout)
    with pytest.raises(InputError, match=r"'(group/)?x' is in another file; copy it into this one"):
        read(tmp_path / name)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg", ".tif", ".pgm", ".jp2", ".webp"])
@pytest.mark.parametrize("bad", [0, 2])
def test_truncated_images(tmp_path, rng, suffix, bad):
    write_images(tmp_path / "cam1", rng.integers(0, 256, (N, 40, 50)).astype(np.uint8), suffix)
    file = tmp_path / "cam1" / f"ref_{bad:03d}{suffix}"
    os.truncate(file, file.stat().st_size // 2)
    frames = open_frames("cam1", tmp_path)
    with refused(f"cam1/{file.name}"):
        frames[bad]
    good, errors = good_frames(frames)
    assert (good, list(errors)) == ([i for i in range(N) if i != bad], [f"cam1/{file.name}"])
    assert frames[1].shape == (40, 50)


def test_stack_that_breaks_off_between_pages(tmp_path, stack12, caplog):
    write_tiff(tmp_path / "s.tif", stack12[0], contiguous=False)
    for image in stack12[1:]:
        write_tiff(tmp_path / "s.tif", image, append=True)
    os.truncate(tmp_path / "s.tif", (tmp_path / "s.tif").stat().st_size - H * W * 2 - 300)
    good, errors = good_frames(open_frames("s.tif", tmp_path))
    assert (good, list(errors)) == ([0, 1], ["s.tif frame 2", "s.tif frame 3"])
    assert "the file ends after 3 frames" in errors["s.tif frame 3"]
    assert not caplog.records


def test_empty_files(tmp_path):
    for name in ("a.png", "b.tif", "c.jpg"):
        (tmp_path / name).touch()
    frames = open_frames(".", tmp_path)
    good, errors = good_frames(frames)
    assert (good, list(errors)) == ([], ["a.png", "b.tif", "c.jpg"])
    with refused("a.png"):
        _ = frames.shape


@pytest.mark.parametrize("i", [0, 1, 2])
def test_one_image_of_another_size_or_depth(tmp_path, stack8, stack12, i):
    write_images(tmp_path / "cam1", stack8)
    write_cv(tmp_path / "cam1" / f"ref_{i:03d}.png", stack12[2] if i == 2 else stack8[0, :5, :6])
    frames = open_frames("cam1", tmp_path)
    good, errors = good_frames(frames)
    assert (good, list(errors)) == ([k for k in range(N) if k != i], [f"cam1/ref_00{i}.png"])
    with refused(f"cam1/ref_00{i}.png"):
        frames[i]


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif"])
def test_images_of_one_bit(tmp_path, stack8, suffix):
    Image.fromarray(stack8[0] > 100).save(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match=rf"^a{suffix}: .*1-bit"):
        open_frames(f"a{suffix}", tmp_path)[0]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4"])
@pytest.mark.parametrize(("top", "bits"), [(1.0, 1), (4000.0, 16)])
def test_float_frames(tmp_path, rng, dtype, top, bits):
    stack = (rng.random((N, H, W)) * top).astype(dtype)
    np.save(tmp_path / "a.npy", stack)
    frames = open_frames(tmp_path / "a.npy")
    same(frames, stack.astype(np.float32))
    assert frames.bits == bits


RAMP = np.linspace(0, 1, H * W).reshape(H, W)


@pytest.mark.parametrize(
    "image",
    [np.ones((H, W), dtype) for dtype in (np.int32, np.int16, bool, np.uint32, np.complex64)]
    + [1.5 * RAMP - 0.5, 1.7 * RAMP, 7e4 * RAMP]
    + [np.where(RAMP > 0.5, value, RAMP) for value in (np.nan, np.inf)],
    ids=lambda image: f"{image.dtype} {image.flat[0]} to {image.flat[-1]}",
)
def test_invalid_values(tmp_path, image):
    np.save(tmp_path / "a.npy", image)
    with refused("a.npy"):
        open_frames("a.npy", tmp_path)[0]


@pytest.mark.parametrize("xml", [False, True])
def test_photron_films_of_every_nth_frame_have_their_own_times(tmp_path, stack12, xml):
    header = write_photron(tmp_path, stack12.astype("<u2").tobytes(), bit=16, rate=20000, xml=xml)
    line, tag = b"Save Step : 5\n", b"<skipFrame>5</skipFrame>"
    mark, more = (b"<totalFrame>", tag) if xml else (b"Image Width", line)
    header.write_bytes(header.read_bytes().replace(mark, more + mark))
    np.testing.assert_allclose(open_frames(header.name, tmp_path).times, np.arange(N) * 5 / 20000)


def imagej_stack(path: Path, stack: np.ndarray) -> None:
    """A stack as ImageJ writes it above 4 GB: one page, then the other images; big-endian."""
    text = f"ImageJ=1.53t\nimages={len(stack)}\nframes={len(stack)}\n".encode() + b"\0"
    height, width, start = *stack.shape[1:], 8 + 2 + 12 * 10 + 4
    data = start + len(text) + 7
    entries = {254: (4, 0), 256: (4, width), 257: (4, height), 258: (3, 16), 262: (3, 1), 270: (2, start)}
    entries |= {273: (4, data), 277: (3, 1), 278: (4, height), 279: (4, stack[0].nbytes)}
    tags = b""
    for code, (kind, value) in entries.items():
        packed_value = struct.pack(">HH", value, 0) if kind == 3 else struct.pack(">I", value)
        tags += struct.pack(">HHI", code, kind, len(text) if code == 270 else 1) + packed_value
    head = b"MM\0*" + struct.pack(">I", 8) + struct.pack(">H", len(entries)) + tags + struct.pack(">I", 0)
    path.write_bytes((head + text).ljust(data, b"\0") + stack.astype(">u2").tobytes())


def test_large_stacks_of_imagej_have_one_page(tmp_path, stack12):
    imagej_stack(tmp_path / "s.tif", stack12)
    same(open_frames(tmp_path / "s.tif"), stack12)
    data = (tmp_path / "s.tif").read_bytes()
    (tmp_path / "short.tif").write_bytes(data[:-9])
    good, errors = good_frames(open_frames(tmp_path / "short.tif"))
    assert good == [0, 1, 2]
    assert [name for name in errors if name.endswith("short.tif frame 3")]


def test_images_of_a_stack_that_imagej_saved_one_by_one(tmp_path, stack8):
    for i, image in enumerate(stack8):
        description = f"ImageJ=1.54f\nimages={len(stack8)}\nslices={len(stack8)}\nloop=false\n"
        write_tiff(tmp_path / f"s{i:04}.tif", image, photometric="minisblack", description=description, metadata=None)
    frames = open_frames(tmp_path)
    same(frames, stack8)
    assert frames.numbers.tolist() == list(range(len(stack8)))


CHANNELS = [
    ({"imagej": True, "metadata": {"axes": "TCYX"}}, (3, 2), "0::2"),
    ({"imagej": True, "metadata": {"axes": "TCYX"}}, (2, 3), "0::3"),
    ({"ome": True, "metadata": {"axes": "TCYX"}}, (3, 2), "0::2"),
    ({"ome": True, "metadata": {"axes": "CTYX"}}, (2, 3), "0:3"),
]


@pytest.mark.parametrize(("options", "shape", "selection"), CHANNELS)
def test_channels_of_one_stack_are_no_frames(tmp_path, rng, options, shape, selection):
    stack = rng.integers(0, 4000, (*shape, 7, 10), dtype=np.uint16)
    write_tiff(tmp_path / "two.tif", stack, photometric="minisblack", **options)
    with pytest.raises(InputError, match=f"got images of {shape[options['metadata']['axes'].index('C')]} ") as error:
        open_frames("two.tif", tmp_path)
    assert f"'two.tif[{selection}]'" in str(error.value)
    if shape[0] == 3:
        for i, image in enumerate(stack):
            apart = {**options, "metadata": {"axes": "CYX"}}
            write_tiff(tmp_path / f"one{i}.tif", image, photometric="minisblack", **apart)
        same(open_frames("one*.tif[1::2]", tmp_path), stack[:, 1])
        with pytest.raises(InputError, match=r"'one\*.tif\[0::2\]'"):
            open_frames("one*.tif", tmp_path)
    first = stack[:, 0] if selection.startswith("0::") else stack[0]
    same(open_frames(f"two.tif[{selection}]", tmp_path), first)


def test_films_of_imagej_and_ome_have_one_channel(tmp_path, rng):
    stack = rng.integers(0, 4000, (4, 7, 10), dtype=np.uint16)
    for axes in ("TYX", "ZYX"):
        for options in ({"imagej": True}, {"ome": True}):
            write_tiff(tmp_path / "s.tif", stack, photometric="minisblack", metadata={"axes": axes}, **options)
            same(open_frames(tmp_path / "s.tif"), stack)
    colours = rng.integers(0, 255, (2, 7, 10, 3), dtype=np.uint8)
    write_tiff(tmp_path / "rgb.tif", colours, photometric="rgb", ome=True, metadata={"axes": "TYXS"})
    assert len(open_frames(tmp_path / "rgb.tif")) == 2


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate", "packbits"])
def test_orientation_tags_are_ignored_by_every_reader(tmp_path, stack8, orientation, compression):
    path = tmp_path / "a.tif"
    Image.fromarray(stack8[0]).save(path, compression=compression, tiffinfo={274: orientation})
    np.testing.assert_array_equal(open_frames(path)[0], stack8[0])
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(stack8[0]).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(open_frames(tmp_path / "a.png")[0], stack8[0])


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("bits", [8, 16])
def test_min_is_white_is_inverted(tmp_path, stack8, bits, compression):
    image = stack8[0].astype(f"u{bits // 8}")
    top = 2**bits - 1
    write_tiff(tmp_path / "w.tif", top - image, photometric="miniswhite", compression=compression)
    np.testing.assert_array_equal(open_frames(tmp_path / "w.tif")[0], image)
    Image.fromarray(255 - stack8[0]).save(tmp_path / "l.tif", compression="tiff_lzw", tiffinfo={262: 0})
    np.testing.assert_array_equal(open_frames(tmp_path / "l.tif")[0], stack8[0])


def test_palettes_are_colours(tmp_path, stack8):
    grey = np.arange(256, dtype=np.uint8)[::-1]
    for compression in (None, "tiff_lzw"):
        image = Image.fromarray(stack8[0], mode="P")
        image.putpalette(np.repeat(grey, 3).tobytes())
        image.save(tmp_path / "p.tif", compression=compression)
        np.testing.assert_array_equal(open_frames(tmp_path / "p.tif")[0], grey[stack8[0]])


def test_thumbnails_are_no_frames(tmp_path, stack8):
    import tifffile

    with tifffile.TiffWriter(tmp_path / "t.tif") as file:
        for image in stack8:
            file.write(image, photometric="minisblack", metadata=None)
            file.write(image[::2, ::2], photometric="minisblack", subfiletype=1, metadata=None)
    same(open_frames(tmp_path / "t.tif"), stack8)


def test_an_image_in_two_formats_is_no_repeat(tmp_path, stack8):
    for image, name in zip(stack8, ("a.tif", "a.png", "b.tif", "b.png"), strict=True):
        Image.fromarray(image).save(tmp_path / name)
    with refused(tmp_path.as_posix()):
        open_frames(tmp_path)
    assert len(open_frames("*.tif", tmp_path)) == 2
