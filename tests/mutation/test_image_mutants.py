"""Ten thousand damaged image files: each is refused in one line, or gives finite images, soon and in little memory."""

from __future__ import annotations

import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from imaging_files import CIHX, packed, write_b16, write_cine, write_cv, write_dng, write_packed_tiff
from mutation.mutators import spoil_bytes, spoil_text
from nerif.common.conventions import InputError
from nerif.imaging.readers.frames import Frames
from nerif.imaging.readers.open import open_frames
from nerif.reconstruction.device import peak_memory

STACK = np.random.default_rng(3).integers(0, 4096, (3, 24, 33)).astype(np.uint16)
QUICK = 12
"""Mutants of each kind in `make test`."""
ALL = 10_000
"""Mutants of all kinds in `make test-all`."""
LONGEST = 20.0
"""Seconds for a file that takes milliseconds: these machines are shared."""
MOST_MEMORY = 2**31
"""Growth of the process over all mutants of a kind, bytes: a damaged size must not be allocated."""


def tiff(**options: object) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import tifffile

        tifffile.imwrite(path, STACK, **options)

    return write


def lzw(path: Path) -> None:
    from PIL import Image

    images = [Image.fromarray((image >> 4).astype(np.uint8)) for image in STACK]
    images[0].save(path, save_all=True, append_images=images[1:], compression="tiff_lzw")


def one_image(path: Path) -> None:
    write_cv(path, (STACK[0] >> 4).astype(np.uint8))


def photron(path: Path) -> None:
    n, height, width = STACK.shape
    settings = {"rate": 2000, "bit": 12, "depth": 12, "side": "Lower", "kind": "MRaw"}
    path.write_text(CIHX.format(n=n, h=height, w=width, **settings))
    path.with_suffix(".mraw").write_bytes(packed(STACK))


def cine(path: Path) -> None:
    frames = [packed(image, 10) for image in STACK >> 2]
    write_cine(path, frames, *STACK.shape[1:], bits=10, packing=256, times=(0.0, 0.001, 0.002))


def hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["images"] = STACK
        file["time"] = np.arange(3) / 2000


def video(codec: str, pixels: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        av = pytest.importorskip("av", reason="pip install '.[video]'")
        with av.open(str(path), "w") as file:
            stream = file.add_stream(codec, rate=30)
            stream.height, stream.width, stream.pix_fmt = 32, 48, pixels
            for image in np.random.default_rng(4).integers(0, 256, (3, 32, 48)).astype(np.uint8):
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray").reformat(format=pixels)))
            file.mux(stream.encode())

    return write


def dng(path: Path) -> None:
    pytest.importorskip("rawpy", reason="pip install '.[raw]'")
    write_dng(path, np.random.default_rng(5).integers(0, 4096, (48, 64)).astype(np.uint16), b"\0\1\1\2", 64, 4095)


KINDS: dict[str, Callable[[Path], None]] = {
    "plain.tif": tiff(photometric="minisblack"),
    "imagej.tif": tiff(imagej=True),
    "deflate.tif": tiff(compression="zlib", photometric="miniswhite"),
    "lzw.tif": lzw,
    "grey.png": one_image,
    "grey.bmp": one_image,
    "grey.jpg": one_image,
    "film.cihx": photron,
    "packed.tif": lambda path: write_packed_tiff(path, STACK >> 2, 10, 5),
    "film.cine": cine,
    "film.avi": video("rawvideo", "gray"),
    "film.mp4": video("libx264", "yuv420p"),
    "image.b16": lambda path: write_b16(path, STACK[0]),
    "image.dng": dng,
    "stack.npy": lambda path: np.save(path, STACK),
    "stack.npz": lambda path: np.savez(path, images=STACK),
    "stack.h5": hdf5,
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an undamaged file of each kind."""
    folder = tmp_path_factory.mktemp("good")
    for name, write in KINDS.items():
        write(folder / name)
        assert len(open_frames(folder / name)) in (1, 3)
    return folder


def mutant(good: Path, kind: str, number: int, folder: Path) -> tuple[Path, str]:
    """Copy the good file with one to three mistakes; half of them in the first 200 bytes, where headers are."""
    rng = random.Random(f"{kind} {number}")
    for file in good.glob(Path(kind).stem + ".*"):
        if file.name == kind or file.suffix == ".mraw":
            shutil.copy(file, folder / file.name)
    path, done = folder / kind, []
    for _ in range(rng.choice((1, 1, 2, 3))):
        if rng.random() < 0.5:
            content = bytearray(path.read_bytes())
            if content:
                at = rng.randrange(min(200, len(content)))
                content[at] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
                path.write_bytes(content)
                done.append(f"byte {at} is {content[at]}")
        elif path.suffix in (".cihx", ".cih"):
            done.append(spoil_text(path, rng))
        else:
            done.append(spoil_bytes(path, rng))
    return path, ", ".join(done)


def read_all(path: Path) -> int:
    """Read up to four images of a file, and check them; return how many were good."""
    frames: Frames = open_frames(path)
    errors: list[InputError] = []
    good = 0
    for i in range(min(4, len(frames))):
        try:
            image = frames[i]
        except InputError as error:
            errors.append(error)
            continue
        assert image.ndim == 2
        assert image.dtype in (np.uint8, np.uint16, np.float32)
        assert np.isfinite(image).all()
        good += 1
    if errors and not good:
        raise errors[0]
    return good


def problem(path: Path) -> str:
    """What is wrong with the way a file was treated."""
    start = time.perf_counter()
    wrong = ""
    try:
        read_all(path)
    except InputError as error:
        lines = str(error).splitlines()
        wrong = "" if len(lines) == 1 and lines[0].strip() else f"refused in {len(lines)} lines"
    except Exception as error:  # anything else is what this test looks for
        wrong = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - start
    return wrong or (f"took {seconds:.0f} s" if seconds > LONGEST else "")


def problems(good: Path, kind: str, numbers: range, folder: Path) -> list[str]:
    """A line about each mutant that was not treated well."""
    lines: list[str] = []
    memory = peak_memory(torch.device("cpu"))
    for number in numbers:
        path, done = mutant(good, kind, number, folder)
        wrong = problem(path)
        lines += [f"{kind} mutant {number} ({done}): {wrong}"] if wrong else []
    grown = peak_memory(torch.device("cpu")) - memory
    return lines + ([f"{kind}: {grown / 2**30:.1f} GiB more memory"] if grown > MOST_MEMORY else [])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_images_are_refused_in_one_line_or_give_images(good, kind, tmp_path, capfd):
    lines = problems(good, kind, range(QUICK), tmp_path)
    assert not lines, "\n".join(lines)
    if not kind.endswith(".dng"):  # LibRaw cannot be kept from it
        assert capfd.readouterr().err == ""  # no library prints messages of its own


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", KINDS)
def test_ten_thousand_damaged_images(good, kind, tmp_path):
    lines = problems(good, kind, range(-(-ALL // len(KINDS))), tmp_path)
    assert not lines, "\n".join(lines)
