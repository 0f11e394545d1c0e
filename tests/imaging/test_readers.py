"""Images come back as written, lazily and in order; what is wrong with a file is said with its name."""

from __future__ import annotations

import io
import os
import struct
import sys
import types
import zlib
from pathlib import Path

import numpy as np
import pytest

from imaging_files import packed, write_cv, write_images, write_photron, write_tiff
from nerif.common.conventions import InputError
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.frames import Frames, read_each
from nerif.imaging.readers.open import open_frames
from nerif.imaging.readers.views import View
from refusals import refused

N, H, W = 4, 7, 10


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


@pytest.fixture
def stack8(rng) -> np.ndarray:
    return rng.integers(0, 256, (N, H, W)).astype(np.uint8)


@pytest.fixture
def stack12(rng) -> np.ndarray:
    return rng.integers(3000, 4096, (N, H, W)).astype(np.uint16)


def same(frames: Frames, stack: np.ndarray) -> None:
    assert len(frames) == len(stack)
    assert frames.shape == stack.shape[1:]
    for i, expected in enumerate(stack):
        assert frames[i].dtype == expected.dtype
        np.testing.assert_array_equal(frames[i], expected)


def good_frames(frames: Frames) -> tuple[list[int], list[str]]:
    """Numbers of the frames that can be read, and what is said of the others."""
    found = dict(read_each(frames, range(len(frames))))
    wrong = {i: str(x) for i, x in found.items() if isinstance(x, InputError)}
    return [i for i in found if i not in wrong], [*wrong.values()]


# --- images


@pytest.mark.parametrize(
    "options", [{}, {"compression": "zlib"}, {"bigtiff": True}, {"byteorder": ">"}, {"imagej": True}]
)
def test_tiff_stack(tmp_path, stack12, options):
    write_tiff(tmp_path / "stack.tif", stack12, photometric="minisblack", **options)
    frames = open_frames(tmp_path / "stack.tif")
    same(frames, stack12)
    assert frames.bits == 16
    assert frames.times is None
    assert open_frames("stack.tif", tmp_path).name(2) == "stack.tif frame 2"


def test_several_tiffs_of_several_pages(tmp_path, stack12):
    write_tiff(tmp_path / "a1.tif", stack12[:3], photometric="minisblack")
    write_tiff(tmp_path / "a2.TIFF", stack12[3])
    frames = open_frames(".", tmp_path)
    same(frames, stack12)
    assert [frames.name(i) for i in (2, 3)] == ["a1.tif frame 2", "a2.TIFF"]


def test_tiff_compressed_by_lzw(tmp_path, stack8):
    from PIL import Image

    first, *others = [Image.fromarray(image) for image in stack8]
    first.save(tmp_path / "lzw.tif", compression="tiff_lzw", save_all=True, append_images=others)
    same(open_frames(tmp_path / "lzw.tif"), stack8)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_tiff_with_packed_bits(tmp_path, rng, bits):
    image = rng.integers(0, 2**bits, (7, 12)).astype(np.uint16)  # rows of whole bytes
    data = b"".join(packed(row, bits) for row in image)
    data += bytes(len(data) % 2)
    tags = [(256, 12), (257, 7), (258, bits), (259, 1), (262, 1), (273, 8), (277, 1), (278, 7), (279, len(data))]
    ifd = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", k, 4, 1, v) for k, v in tags) + bytes(4)
    (tmp_path / "p.tif").write_bytes(b"II*\0" + struct.pack("<I", 8 + len(data)) + data + ifd)
    frames = open_frames(tmp_path / "p.tif")
    same(frames, image[None])
    assert frames.bits == bits


def test_bits_of_tiff_metadata(tmp_path, stack12):
    write_tiff(tmp_path / "max.tif", stack12[0], extratags=[(281, "H", 1, 4095, True)])
    assert open_frames(tmp_path / "max.tif").bits == 12
    write_tiff(tmp_path / "x.ome.tif", stack12[0], metadata={"axes": "YX", "SignificantBits": 14})
    assert open_frames(tmp_path / "x.ome.tif").bits == 14


@pytest.mark.parametrize("suffix", [".png", ".bmp"])
def test_images_of_8_bit(tmp_path, stack8, suffix):
    write_images(tmp_path / "cam1", stack8, suffix)
    frames = open_frames("cam1", tmp_path)
    same(frames, stack8)
    assert frames.bits == 8
    assert frames.name(3) == f"cam1/ref_003{suffix}"


def test_png_of_16_bit(tmp_path, stack12):
    write_images(tmp_path / "cam1", stack12)
    same(open_frames(tmp_path / "cam1" / "ref_*.png"), stack12)


def test_png_written_by_imageio(tmp_path, stack8):
    from imageio import v3

    v3.imwrite(tmp_path / "a.png", stack8[0])
    same(open_frames(tmp_path / "a.png"), stack8[:1])


def test_png_says_its_significant_bits(tmp_path, stack12):
    write_cv(tmp_path / "a.png", stack12[0] << 4)
    data = (tmp_path / "a.png").read_bytes()
    chunk = b"sBIT\x0c"
    chunk = struct.pack(">I", 1) + chunk + struct.pack(">I", zlib.crc32(chunk))
    (tmp_path / "a.png").write_bytes(data[:33] + chunk + data[33:])  # behind the signature and IHDR
    frames = open_frames(tmp_path / "a.png")
    same(frames, stack12[:1])
    assert frames.bits == 12


def test_jpeg(tmp_path):
    smooth = (np.add.outer(np.arange(16), 2 * np.arange(24)) * 3).astype(np.uint8)
    write_cv(tmp_path / "a.jpg", smooth)
    image = open_frames(tmp_path / "a.jpg")[0]
    assert image.shape == (16, 24)
    assert np.abs(image.astype(int) - smooth).max() < 12


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif"])
def test_colours_become_luminance(tmp_path, rng, suffix):
    rgb = rng.integers(0, 256, (H, W, 3)).astype(np.uint8)
    path = tmp_path / f"a{suffix}"
    write_tiff(path, rgb, photometric="rgb") if suffix == ".tif" else write_cv(path, rgb[..., ::-1])
    expected = np.rint(rgb @ [0.299, 0.587, 0.114]).astype(np.uint8)
    same(open_frames(path), expected[None])


def test_colour_planes_of_tiff(tmp_path, rng):
    rgb = rng.integers(0, 256, (H, W, 3)).astype(np.uint8)
    write_tiff(tmp_path / "a.tif", np.moveaxis(rgb, -1, 0), photometric="rgb", planarconfig="separate")
    same(open_frames(tmp_path / "a.tif"), np.rint(rgb @ [0.299, 0.587, 0.114]).astype(np.uint8)[None])


def test_equal_channels_and_alpha_change_nothing(tmp_path, stack12, rng):
    alpha = rng.integers(0, 65536, (H, W)).astype(np.uint16)
    write_cv(tmp_path / "a.png", np.dstack([stack12[0]] * 3 + [alpha]))
    same(open_frames(tmp_path / "a.png"), stack12[:1])


def test_natural_order(tmp_path, stack8):
    for i, name in enumerate(("img1", "img2", "img10", "Img11")):
        write_cv(tmp_path / f"{name}.png", stack8[i])
    (tmp_path / "._img3.png").write_bytes(b"left by another system")
    (tmp_path / "notes.txt").write_text("x")
    same(open_frames(tmp_path), stack8)
    same(open_frames(tmp_path / "*"), stack8)
    same(open_frames(tmp_path / "img?.png"), stack8[:2])


def test_brackets_in_a_folder_name_mean_themselves(tmp_path, stack8):
    write_images(tmp_path / "run[3]", stack8)
    same(open_frames(tmp_path / "run[3]"), stack8)
    same(open_frames(f"{tmp_path}/run[3]/*.png[1:]"), stack8[1:])


# --- Photron


@pytest.mark.parametrize("xml", [False, True])
@pytest.mark.parametrize(("h", "w"), [(7, 10), (7, 9), (1, 3)], ids=["even", "odd", "tiny"])
def test_photron_packed_12_bit(tmp_path, rng, xml, h, w):
    stack = rng.integers(0, 4096, (5, h, w)).astype(np.uint16)
    header = write_photron(tmp_path, packed(stack), 5, h, w, xml=xml)
    frames = open_frames(header)
    same(frames, stack)
    same(open_frames(tmp_path / "rec.mraw"), stack)
    assert frames.bits == 12
    np.testing.assert_allclose(frames.times, np.arange(5) / 20000)
    assert open_frames(header.name, tmp_path).name(3) == "rec.mraw frame 3"


@pytest.mark.parametrize(("bit", "dtype"), [(8, np.uint8), (16, np.uint16)])
def test_photron_whole_bytes(tmp_path, rng, bit, dtype):
    stack = rng.integers(0, 255, (N, H, W)).astype(dtype)
    write_photron(tmp_path, stack.tobytes(), bit=bit, depth={8: 8, 16: 12}[bit], rate=500)
    frames = open_frames(tmp_path / "rec.cih")
    same(frames, stack)
    assert frames.bits == {8: 8, 16: 12}[bit]
    np.testing.assert_allclose(frames.times, np.arange(N) / 500)


def test_photron_upper_side_is_shifted_down(tmp_path, stack12):
    header = write_photron(tmp_path, (stack12 << 4).astype("<u2").tobytes(), bit=16, side="Higher")
    same(open_frames(header), stack12)


def test_relative_photron_path(tmp_path, stack12, monkeypatch):
    write_photron(tmp_path, packed(stack12))
    monkeypatch.chdir(tmp_path)
    same(open_frames("rec.cih"), stack12)


def test_photron_reads_one_frame_of_a_long_recording(tmp_path):
    n, h, w = 2000, 1024, 1000  # 3 GB that are not there
    header = write_photron(tmp_path, b"", n, h, w)
    with (tmp_path / "rec.mraw").open("r+b") as file:
        file.truncate(n * h * w * 3 // 2)
        file.seek(777 * h * w * 3 // 2)
        file.write(b"\x12\x34\x56")
    frames = open_frames(header)
    assert len(frames) == n
    assert frames[777][0, :3].tolist() == [0x123, 0x456, 0]


def test_photron_file_that_ends_too_early(tmp_path, stack12):
    header = write_photron(tmp_path, packed(stack12)[: 2 * H * W * 3 // 2 + 20])
    frames = open_frames(header.name, tmp_path)
    with refused("rec.mraw frame 2"):
        frames[2]
    good, lines = good_frames(frames)
    assert good == [0, 1]
    assert [line.split(":")[0] for line in lines] == ["rec.mraw frame 2", "rec.mraw frame 3"]
    np.testing.assert_array_equal(frames[1], stack12[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bit": 36}, "rec.cih: expected a monochrome MRaw recording .* of 36 bit"),
        ({"kind": "Tiff"}, "got Tiff of 12 bit"),
        ({"n": 0}, "Total Frame"),
        ({"h": "none"}, "rec.cih: cannot be read as a Photron header"),
    ],
)
def test_photron_header_that_cannot_be(tmp_path, change, message):
    write_photron(tmp_path, b"", **change)
    with refused("rec.cih"):
        open_frames("rec.cih", tmp_path)


def test_photron_partner_missing(tmp_path):
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


# --- LaVision


@pytest.fixture
def lavision(monkeypatch):
    """A module with the parts of lvpyio 1.5 that are used; file contents are NumPy arrays."""
    reads = []

    class Buffer:
        def __init__(self, frames):
            self.frames, self.attributes = frames, {}

        def __len__(self):
            return len(self.frames)

        def __getitem__(self, index):
            return self.frames[index]

    def read_buffer(path):
        assert isinstance(path, str)
        reads.append(path)
        try:
            stack = np.load(io.BytesIO(Path(path).read_bytes()))
        except ValueError:
            raise RuntimeError("Can't read buffers with different frame sizes yet!") from None
        key = "PIXEL" if path.endswith(".im7") else "U0"
        return Buffer([types.SimpleNamespace(components={key: types.SimpleNamespace(planes=[a])}) for a in stack])

    monkeypatch.setitem(sys.modules, "lvpyio", types.SimpleNamespace(read_buffer=read_buffer, reads=reads))
    return reads


def write_lavision(path: Path, stack: np.ndarray) -> None:
    with path.open("wb") as file:
        np.save(file, stack)


def test_lavision_images(tmp_path, stack12, lavision):
    write_lavision(tmp_path / "B00001.im7", stack12[:2])
    write_lavision(tmp_path / "B00002.im7", stack12[2:])
    frames = open_frames(".", tmp_path)
    assert len(lavision) == 1  # how many are in the first is taken for all
    same(frames, stack12)
    assert frames.name(3) == "B00002.im7 frame 1"
    same(open_frames(tmp_path / "B00002.im7[1]"), stack12[3:])


def test_lavision_files_that_hold_something_else(tmp_path, stack12, lavision):
    write_lavision(tmp_path / "a.vc7", stack12)
    with pytest.raises(InputError, match=r"a.vc7: expected images, got vectors"):
        open_frames("a.vc7", tmp_path)[0]
    write_lavision(tmp_path / "B1.im7", stack12[:2])
    write_lavision(tmp_path / "B2.im7", stack12[:1])
    (tmp_path / "B3.im7").write_bytes(b"damaged")
    good, lines = good_frames(open_frames("*.im7", tmp_path))
    assert good == [0, 1, 2]
    assert "B2.im7 frame 1: expected at least 2 images" in lines[0]
    assert "B3.im7 frame 0: cannot be read" in lines[1]
    assert "different frame sizes" in lines[1]


@pytest.mark.parametrize("suffix", ["im7", "vc7"])
def test_lavision_without_its_package(tmp_path, monkeypatch, suffix):
    monkeypatch.setitem(sys.modules, "lvpyio", None)
    (tmp_path / f"a.{suffix}").touch()
    with pytest.raises(InputError, match=r"pip install 'nerif-bost\[lavision\]'.*LaVision's own terms"):
        open_frames(tmp_path / f"a.{suffix}")


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


def test_npz(tmp_path, stack12, stack8):
    np.savez(tmp_path / "a.npz", flow=stack12, times=np.arange(4.0))
    same(open_frames(tmp_path / "a.npz"), stack12)
    np.savez_compressed(tmp_path / "b.npz", flow=stack12, ref=stack8)
    same(open_frames(f"{tmp_path}/b.npz:ref[1:]"), stack8[1:])
    with refused("b.npz"):
        open_frames("b.npz", tmp_path)
    with refused("b.npz:x"):
        open_frames("b.npz:x", tmp_path)


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.h5"])
def test_truncated_arrays(tmp_path, stack12, name):
    import h5py

    if name == "a.h5":
        with h5py.File(tmp_path / name, "w") as file:
            file["x"] = stack12
    else:
        (np.save if name == "a.npy" else np.savez)(tmp_path / name, stack12)
    os.truncate(tmp_path / name, (tmp_path / name).stat().st_size - 100)
    with pytest.raises(InputError, match=f"{name}: cannot be read"):
        open_frames(name, tmp_path)


def test_empty_array(tmp_path, stack12):
    np.save(tmp_path / "a.npy", stack12[:0])
    with pytest.raises(InputError, match=r"a.npy: expected one frame at least"):
        open_frames(tmp_path / "a.npy")


def test_hdf5(tmp_path, stack12, stack8):
    import h5py

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
    assert one.times.tolist() == [7.0]
    assert one.name(0) == "a.h5:cam2/still"
    for spec, message in (
        ("a.h5", "expected one dataset of 2 or 3 dims, got 2"),
        ("a.h5:cam3", "a.h5:cam3: no such dataset"),
        ("a.h5:cam1/times", "expected 2 or 3 dims"),
    ):
        with pytest.raises(InputError, match=message):
            open_frames(spec, tmp_path)


def test_hdf5_with_one_dataset_and_wrong_times(tmp_path, stack12):
    import h5py

    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["deep/in/it"] = stack12
    same(open_frames(tmp_path / "a.hdf5"), stack12)
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["deep/in/times"] = np.arange(3.0)
    with refused("a.hdf5"):
        open_frames("a.hdf5", tmp_path)


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


def test_selection_of_files_and_pages(tmp_path, stack12):
    write_images(tmp_path / "cam1", stack12)
    same(open_frames("cam1/ref_*.png[1:3]", tmp_path), stack12[1:3])
    same(open_frames("cam1[2]", tmp_path), stack12[2:3])
    write_tiff(tmp_path / "s.tif", stack12, photometric="minisblack")
    same(open_frames("s.tif[::3]", tmp_path), stack12[::3])


@pytest.mark.parametrize(
    ("selection", "message"),
    [("[4]", "expected a frame from 0 to 3"), ("[-5]", "from 0 to 3"), ("[9:]", "none of the 4"), ("[::0]", "step")],
)
def test_selection_of_nothing(tmp_path, stack8, selection, message):
    np.save(tmp_path / "a.npy", stack8)
    with pytest.raises(InputError, match=message):
        open_frames(f"a.npy{selection}", tmp_path)


def test_frames_are_a_sequence(tmp_path, stack8):
    np.save(tmp_path / "a.npy", stack8)
    frames = open_frames(tmp_path / "a.npy")
    np.testing.assert_array_equal(frames[-1], stack8[-1])
    np.testing.assert_array_equal(np.stack(list(frames)), stack8)
    with pytest.raises(IndexError):
        frames[N]


def test_files_are_read_when_asked_for(tmp_path, rng, monkeypatch):
    from nerif.imaging.readers import image_files

    write_images(tmp_path / "cam1", rng.integers(0, 256, (30, H, W)).astype(np.uint8))
    read = []
    real = image_files.FileFrames.load
    monkeypatch.setattr(image_files.FileFrames, "load", lambda self, i: (read.append(i), real(self, i))[1])
    frames = open_frames(tmp_path / "cam1")
    assert len(frames) == 30
    assert read == []
    assert frames.shape == (H, W)
    assert len(read) == 5
    frames[11]
    assert read[5:] == [11]


# --- crops and sequences


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
    turned = Crop(rotate=90)(image)
    assert turned[0, 0] == image[0, -1]  # counter-clockwise: the upper right corner comes to the upper left


@pytest.mark.parametrize("crop", [Crop(5, 0, 5, 3), Crop(0, 12, 3, 3), Crop(9), Crop(0, 14)])
def test_crop_beyond_the_frame(crop):
    with refused("crop"):
        crop(np.zeros((9, 14)))


@pytest.mark.parametrize("change", [{"row": -1}, {"width": -2}, {"flip": "left"}, {"rotate": 45}])
def test_crop_that_cannot_be(change):
    with refused("crop"):
        Crop(**change)


def test_reference_and_flow_must_be_alike(tmp_path, stack12, stack8):
    for name, array in (("ref", stack12), ("small", stack12[:, :5]), ("bytes", stack8)):
        np.save(tmp_path / f"{name}.npy", array)

    def check(flow: str, crop: Crop | None = None) -> None:
        View("a", tmp_path, {"reference": "ref.npy", "flow": flow}, crop).check_alike()

    check("ref.npy")
    with refused("view 'a'"):
        check("small.npy")
    with refused("view 'a'"):
        check("bytes.npy")


def test_depth_that_the_files_tell_counts(tmp_path, stack12):
    header = write_photron(tmp_path, packed(stack12))
    np.save(tmp_path / "flow.npy", stack12)
    sources = {"reference": f"{header}[:1]", "flow": f"{header}[1:]"}
    View("a", tmp_path, sources).check_alike()
    View("a", tmp_path, {**sources, "flow": "flow.npy"}).check_alike()  # 16 bit as read, and may well be 12


# --- what can be wrong


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("cam1/ref_04.png", "^cam1/ref_04.png: no such file or folder; did you mean 'cam1/ref_00[0-3].png'"),
        ("Cam2/ref_*.png", "^Cam2/ref_.*: expected files of this pattern, got none; did you mean 'cam1'"),
        ("cam1/flow_*.tif", "^cam1/flow_.*: expected files of this pattern, got none"),
        ("zzz", "^zzz: no such file or folder$"),
        ("nowhere/at/all.tif", "no such file"),
        ("empty", r"^empty: expected images .*got none; is it the right folder"),
        ("held", r"^held: expected images .*got none; name the file, such as 'held/a.npy'"),
        ("notes.txt", r"^notes.txt: expected one of .tif .*, got '.txt'"),
        ("held/*.npy", r"^held/a.npy: one of 2 files of a pattern"),
    ],
)
def test_files_that_are_not_there(tmp_path, stack8, spec, message):
    write_images(tmp_path / "cam1", stack8)
    (tmp_path / "empty").mkdir()
    (tmp_path / "held").mkdir()
    np.save(tmp_path / "held" / "a.npy", stack8)
    np.save(tmp_path / "held" / "b.npy", stack8)
    (tmp_path / "notes.txt").touch()
    with pytest.raises(InputError, match=message):
        open_frames(spec, tmp_path)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg", ".tif"])
@pytest.mark.parametrize("bad", [0, 2])
def test_truncated_images(tmp_path, rng, suffix, bad):
    stack = rng.integers(0, 256, (N, 40, 50)).astype(np.uint8)
    write_images(tmp_path / "cam1", stack, suffix)
    file = tmp_path / "cam1" / f"ref_{bad:03d}{suffix}"
    os.truncate(file, file.stat().st_size // 2)
    frames = open_frames("cam1", tmp_path)
    with pytest.raises(InputError, match=f"cam1/ref_{bad:03d}{suffix}: cannot be read, truncated or damaged"):
        frames[bad]
    good, lines = good_frames(frames)
    assert good == [i for i in range(N) if i != bad]
    assert len(lines) == 1
    assert frames[1].shape == (40, 50)


def test_stack_that_breaks_off_between_pages(tmp_path, stack12, caplog):
    write_tiff(tmp_path / "s.tif", stack12[0], contiguous=False)
    for image in stack12[1:]:
        write_tiff(tmp_path / "s.tif", image, append=True)
    os.truncate(tmp_path / "s.tif", (tmp_path / "s.tif").stat().st_size - H * W * 2 - 300)
    good, lines = good_frames(open_frames("s.tif", tmp_path))
    assert good == [0, 1]
    assert [line.split(",")[0] for line in lines] == [f"s.tif frame {i}: cannot be read" for i in (2, 3)]
    assert "the file ends after 3 frames" in lines[1]
    assert not caplog.records


def test_files_of_nothing(tmp_path, stack8):
    for name in ("a.png", "b.tif", "c.jpg"):
        (tmp_path / name).touch()
    frames = open_frames(".", tmp_path)
    good, lines = good_frames(frames)
    assert good == []
    assert [line.split(":")[0] for line in lines] == ["a.png", "b.tif", "c.jpg"]
    with pytest.raises(InputError, match=r"a.png: cannot be read"):
        _ = frames.shape


@pytest.mark.parametrize("odd", [0, 1])
def test_one_image_of_another_size(tmp_path, stack8, odd):
    write_images(tmp_path / "cam1", stack8)
    write_cv(tmp_path / "cam1" / f"ref_{odd:03d}.png", stack8[0, :5, :6])
    frames = open_frames("cam1", tmp_path)
    with pytest.raises(InputError, match=rf"cam1/ref_00{odd}.png: expected 7 x 10 px .* as in .*, got 5 x 6 px"):
        frames[odd]
    assert good_frames(frames)[0] == [i for i in range(N) if i != odd]


def test_one_image_of_another_depth(tmp_path, stack8, stack12):
    write_images(tmp_path / "cam1", stack8)
    write_cv(tmp_path / "cam1" / "ref_002.png", stack12[2])
    good, lines = good_frames(open_frames("cam1", tmp_path))
    assert good == [0, 1, 3]
    assert "cam1/ref_002.png: expected 7 x 10 px (height x width) of uint8 as in" in lines[0]
    assert "of uint16" in lines[0]


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif"])
def test_images_of_one_bit(tmp_path, stack8, suffix):
    from PIL import Image

    Image.fromarray(stack8[0] > 100).save(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match=rf"a{suffix}: expected grey values of 8 to 16 bit, got a? ?1-bit"):
        open_frames(f"a{suffix}", tmp_path)[0]


@pytest.mark.parametrize("dtype", [np.int32, np.int16, bool, np.uint32, np.complex64])
def test_arrays_of_other_types(tmp_path, dtype):
    np.save(tmp_path / "a.npy", np.ones((H, W), dtype))
    with refused("a.npy"):
        open_frames("a.npy", tmp_path)[0]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4"])
@pytest.mark.parametrize(("top", "bits"), [(1.0, 1), (4000.0, 16)])
def test_float_frames(tmp_path, rng, dtype, top, bits):
    stack = (rng.random((N, H, W)) * top).astype(dtype)
    np.save(tmp_path / "a.npy", stack)
    frames = open_frames(tmp_path / "a.npy")
    same(frames, stack.astype(np.float32))
    assert frames.bits == bits


@pytest.mark.parametrize(("low", "high"), [(-0.5, 1.0), (0.0, 1.7), (0.0, 70000.0)])
def test_float_frames_of_unclear_range(tmp_path, low, high):
    np.save(tmp_path / "a.npy", np.linspace(low, high, H * W).reshape(H, W))
    with refused("a.npy"):
        open_frames("a.npy", tmp_path)[0]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_not_a_number(tmp_path, rng, value):
    stack = rng.random((N, H, W)).astype(np.float32)
    stack[1, 2, 3:5] = value
    np.save(tmp_path / "a.npy", stack)
    good, lines = good_frames(open_frames("a.npy", tmp_path))
    assert good == [0, 2, 3]
    assert lines == ["a.npy frame 1: expected numbers in all pixels, got NaN or infinity in 2 of 70"]
