"""Images written as cameras and their programs write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

N, H, W = 4, 7, 10


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
