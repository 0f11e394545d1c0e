"""Images written as cameras and their programs write them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from nerif.imaging.readers.frames import Frames

N, H, W = 4, 7, 10
LUMINANCE = [0.299, 0.587, 0.114]


def same(frames: Frames, stack: np.ndarray) -> None:
    """Check that frames, read backwards and forwards, are those of a stack."""
    assert len(frames) == len(stack)
    assert frames.shape == stack.shape[1:]
    for i in [*range(len(stack))[::-1], *range(len(stack))]:
        assert frames[i].dtype == stack.dtype
        np.testing.assert_array_equal(frames[i], stack[i])


def dots(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """Random dots of 3 px, 0 to 1."""
    from scipy.ndimage import gaussian_filter

    spread = gaussian_filter((np.random.default_rng(seed).random(shape) < 0.06).astype(float), 1.2)
    return np.clip(spread / np.percentile(spread, 99), 0, 1)


def write_tiff(path: Path, image: np.ndarray, **options) -> None:
    import tifffile

    tifffile.imwrite(path, image, **options)


def write_cv(path: Path, image: np.ndarray) -> None:
    import cv2

    assert cv2.imwrite(str(path), image)


def write_images(folder: Path, stack: np.ndarray, suffix: str = ".png", stem: str = "ref_") -> None:
    folder.mkdir(exist_ok=True)
    for i, image in enumerate(stack):
        write_cv(folder / f"{stem}{i:03d}{suffix}", image)


def packed(values: np.ndarray, bits: int = 12) -> bytes:
    """Values of `bits` each, one after the other, the highest bit first, filled up to whole bytes."""
    text = "".join(f"{v:0{bits}b}" for v in values.ravel())
    return bytes(int(text[i : i + 8].ljust(8, "0"), 2) for i in range(0, len(text), 8))


def write_packed_tiff(path: Path, images: np.ndarray, bits: int, rows: int, fill: int = 1, order: str = "<") -> None:
    """Pages of packed values, in strips of `rows` rows, the bits of whose bytes are in the fill order."""
    out, link = bytearray((b"II*\0" if order == "<" else b"MM\0*") + bytes(4)), 4
    height, width = images.shape[1:]
    for image in images:
        places: list[tuple[int, int]] = []
        for k in range(0, height, rows):
            data = b"".join(packed(row, bits) for row in image[k : k + rows])
            places.append((len(out), len(data)))
            out += data if fill == 1 else bytes(int(f"{byte:08b}"[::-1], 2) for byte in data)
        tables = []
        for table in zip(*places, strict=True):
            tables.append(table[0] if len(table) == 1 else len(out))
            out += struct.pack(f"{order}{len(table)}I", *table) if len(table) > 1 else b""
        entries = dict(zip((256, 257, 258, 259, 262, 266), (width, height, bits, 1, 1, fill), strict=True))
        entries |= {273: tables[0], 277: 1, 278: rows, 279: tables[1]}
        struct.pack_into(f"{order}I", out, link, len(out))
        out += struct.pack(f"{order}H", len(entries))
        for tag, value in entries.items():
            out += struct.pack(f"{order}HHII", tag, 4, len(places) if tag in (273, 279) else 1, value)
        link = len(out)
        out += bytes(4)
    path.write_bytes(out)


def write_b16(path: Path, image: np.ndarray, comment: bytes = b"", extended: bool = False) -> None:
    """An image of PCO's Camware."""
    rest = (struct.pack("<27i", -1, *range(26)) if extended else struct.pack("<i", 0)) + comment
    height, width = image.shape
    head = struct.pack("<4s4i", b"PCO-", 20 + len(rest) + image.nbytes, 20 + len(rest), width, height)
    path.write_bytes(head + rest + image.astype("<u2").tobytes())


def stamped(image: np.ndarray, shift: int = 0) -> np.ndarray:
    """An image with a time stamp of PCO in its first pixels, image 31 of 2024-05-03 12:34:56.789012."""
    digits = "0000003120240503123456789012"
    image = image.copy()
    image[0, :14] = [int(digits[k : k + 2], 16) << shift for k in range(0, 28, 2)]
    return image


def write_dng(path: Path, mosaic: np.ndarray, codes: bytes, black: int, white: int) -> None:
    """A raw image of a camera, with the codes (R 0, G 1, B 2) of the colours of its pattern."""
    identity = tuple(number for k in range(9) for number in (int(k % 4 == 0), 1))
    tags = [(50706, "B", 4, (1, 4, 0, 0)), (50708, "s", 0, "Camera"), (33421, "H", 2, (2, 2)), (33422, "B", 4, codes),
            (50713, "H", 2, (2, 2)), (50714, "H", 4, (black,) * 4), (50717, "H", 1, white), (50721, "2i", 9, identity),
            (50728, "2I", 3, (1, 1) * 3), (50778, "H", 1, 21)]  # fmt: skip
    write_tiff(path, mosaic, photometric="cfa", extratags=[(*tag, True) for tag in tags], metadata=None)


CIH = """#Camera Information Header
Date : 2024/5/3
Camera Type : FASTCAM SA-Z
Record Rate(fps) : {rate}
Shutter Speed(s) : 1/40000
Total Frame : {n}
Original Total Frame : {n}
Image Width : {w}
Image Height : {h}
Color Type : Mono
Color Bit : {bit}
File Format : {kind}
EffectiveBit Depth : {depth}
EffectiveBit Side : {side}
Comment Text :
"""

CIHX = """<?xml version="1.0" encoding="utf-8"?>
<cih>
 <fileInfo><date>2024/5/3</date></fileInfo>
 <basicInfo><comment>x</comment></basicInfo>
 <deviceInfo><deviceName>FASTCAM Nova</deviceName></deviceInfo>
 <recordInfo><recordRate>{rate}</recordRate><shutterSpeed>40000</shutterSpeed></recordInfo>
 <frameInfo><totalFrame>{n}</totalFrame><recordedFrame>{n}</recordedFrame></frameInfo>
 <imageFileInfo><fileFormat>{kind}</fileFormat></imageFileInfo>
 <imageDataInfo>
  <resolution><width>{w}</width><height>{h}</height></resolution>
  <colorInfo><bit>{bit}</bit></colorInfo>
  <effectiveBit><depth>{depth}</depth><side>{side}</side></effectiveBit>
 </imageDataInfo>
</cih>
"""


def write_photron(
    folder, data: bytes, n=N, h=H, w=W, bit=12, depth=12, side="Lower", rate=20000, kind="MRaw", xml=False
):
    (folder / "rec.mraw").write_bytes(data)
    header = folder / ("rec.cihx" if xml else "rec.cih")
    text = (CIHX if xml else CIH).format(rate=rate, n=n, h=h, w=w, bit=bit, depth=depth, side=side, kind=kind)
    # what precedes the XML in real files is not text
    header.write_bytes((b"\xff\xfe\x00head\n" if xml else b"") + text.encode())
    return header


def write_cine(
    path: Path, frames: list[bytes], h=H, w=W, depth=16, bits=12, packing=0, compression=0, cfa=0, rate=1000,
    times=(), first=-40, flip=0, annotation=b"event",
):  # fmt: skip
    """A film of Phantom's software: header, BITMAPINFOHEADER, SETUP, tagged blocks, positions, frames."""
    setup = bytearray(0x1B00)
    struct.pack_into("<2sH", setup, 140, b"ST", len(setup))
    for offset, value in ((756, flip), (768, rate), (808, cfa), (896, bits)):
        struct.pack_into("<I", setup, offset, value)
    stamps = [1_600_000_000 * 2**32 + round(t * 2**32) for t in times]
    blocks = struct.pack("<IHH", 8 + 4 * len(frames), 1003, 0) + bytes(4 * len(frames))  # exposures
    blocks += struct.pack(f"<IHH{len(stamps)}Q", 8 + 8 * len(stamps), 1002, 0, *stamps) if stamps else b""
    table = 44 + 40 + len(setup) + len(blocks)
    head = struct.pack("<2s3HiIiI3I8x", b"CI", 44, compression, 1, -5000, 9000, first, len(frames), 44, 84, table)
    size = len(frames[0])
    head += struct.pack("<IiiHHIIiiII", 40, w, h, 1, depth, packing, size, 0, 0, 0, 0) + setup + blocks
    step = 8 + len(annotation)
    begin = table + 8 * len(frames)
    positions = [begin + k * (step + size) for k in range(len(frames))]
    body = b"".join(struct.pack("<I", step) + annotation + struct.pack("<I", len(data)) + data for data in frames)
    path.write_bytes(head + struct.pack(f"<{len(frames)}q", *positions) + body)
