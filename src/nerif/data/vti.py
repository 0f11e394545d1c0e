"""VTK image data files (.vti): what ParaView opens."""

from __future__ import annotations

import base64
import os
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.files import atomic
from nerif.geometry import Box, Grid

__all__ = ["read_vti", "write_vti"]

BLOCK = 1 << 20  # bytes that are compressed at a time
LEVEL = 5  # of zlib, that of VTK


def write_vti(
    path: str | os.PathLike[str], arrays: dict[str, Tensor], grid: Grid, attributes: dict[str, float | str]
) -> None:
    """Write (z, y, x) arrays as point data of a VTK image, x fastest, atomically; lengths in mm.

    Source: VTK XML file formats, docs.vtk.org (ImageData, appended raw data in blocks packed by zlib).
    """
    nz, ny, nx = grid.shape
    extent = f"0 {nx - 1} 0 {ny - 1} 0 {nz - 1}"
    root = ElementTree.Element(
        "VTKFile", type="ImageData", version="1.0", byte_order="LittleEndian", header_type="UInt64",
        compressor="vtkZLibDataCompressor",
    )  # fmt: skip
    first = [grid.axis(a)[0] for a in "xyz"]
    origin, spacing = (" ".join(repr(float(x)) for x in numbers) for numbers in (first, grid.spacing))
    image = ElementTree.SubElement(root, "ImageData", WholeExtent=extent, Origin=origin, Spacing=spacing)
    packed: list[bytes] = []

    def add(parent: ElementTree.Element, tag: str, kind: str, name: str, content: bytes, **more: str) -> None:
        where = {"type": kind, "Name": name, **more, "format": "appended", "offset": str(sum(map(len, packed)))}
        ElementTree.SubElement(parent, tag, where)
        packed.append(_pack(content))

    about = ElementTree.SubElement(image, "FieldData")
    for name, value in attributes.items():
        if isinstance(value, str):
            add(about, "Array", "String", name, value.encode() + b"\0", NumberOfTuples="1")
        else:
            add(about, "DataArray", "Float64", name, np.array(value, "<f8").tobytes(), NumberOfTuples="1")
    piece = ElementTree.SubElement(image, "Piece", Extent=extent)
    points = ElementTree.SubElement(piece, "PointData", Scalars=next(iter(arrays)))
    for quantity, values in arrays.items():
        numbers = values.cpu().contiguous().numpy()
        kind = {"f4": "Float32", "f8": "Float64"}[numbers.dtype.str[1:]]
        add(points, "DataArray", kind, quantity, numbers.astype(f"<{numbers.dtype.str[1:]}").tobytes())
    ElementTree.SubElement(root, "AppendedData", encoding="raw").text = "_"
    before, after = ElementTree.tostring(root).split(b"_</AppendedData>")
    with atomic(path) as part, part.open("wb") as file:
        file.write(before + b"_")
        for content in packed:
            file.write(content)
        file.write(b"</AppendedData>" + after)


def _pack(content: bytes) -> bytes:
    """Compress by zlib in blocks, behind the header of VTK: number of blocks, size of each and of the last, sizes."""
    blocks = [content[at : at + BLOCK] for at in range(0, len(content), BLOCK)]
    packed = [zlib.compress(block, LEVEL) for block in blocks]
    header = [len(blocks), BLOCK, len(content) % BLOCK, *map(len, packed)]
    return np.array(header, "<u8").tobytes() + b"".join(packed)


def read_vti(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], Grid, dict[str, float | str]]:
    """Read the point data of a VTK image as (z, y, x) arrays, their grid and the field data.

    VTK's own reader ends the process on a damaged file, so it is not used.

    Raises
    ------
    InputError
        If the file is no VTK image, is in several pieces, or is turned out of the axes.

    Source: VTK XML file formats, docs.vtk.org (ImageData; ascii, base64 and raw data, plain or by zlib).
    """
    content = Path(path).read_bytes()
    try:
        return _Image(content).read()
    except InputError as error:
        raise error.inside(path) from None
    except (ElementTree.ParseError, ArithmeticError, LookupError, ValueError, TypeError, zlib.error) as error:
        raise InputError(f"not a VTK image file (.vti), or truncated ({error})", field=path) from None


TYPES = {"Float32": "f4", "Float64": "f8", "String": "u1"}
TYPES |= {f"{sign}Int{8 * n}": f"{code}{n}" for sign, code in (("", "i"), ("U", "u")) for n in (1, 2, 4, 8)}


class _Image:
    """The content of a file, taken apart: XML first, then the data behind it, if they stand there."""

    def __init__(self, content: bytes) -> None:
        at = content.find(b"<AppendedData")
        self.appended = b""
        if at >= 0:
            tag_end = content.index(b">", at)
            self.appended = content[content.index(b"_", tag_end) + 1 :]
            if b"base64" in content[at:tag_end]:
                self.appended = self.appended[: self.appended.index(b"<")]
            self.raw = b"raw" in content[at:tag_end]
            content = content[:at] + b"</VTKFile>"
        self.root = ElementTree.fromstring(content)
        if self.root.tag != "VTKFile" or self.root.get("type") != "ImageData":
            raise ValueError("no ImageData in it")
        order = ">" if self.root.get("byte_order") == "BigEndian" else "<"
        self.order, self.word = order, np.dtype(order + TYPES[self.root.get("header_type", "UInt32")])
        self.compressor = self.root.get("compressor")
        if self.compressor not in (None, "vtkZLibDataCompressor"):
            raise InputError(f"expected data that are not compressed, or by zlib, got {self.compressor}; save it anew")

    def read(self) -> tuple[dict[str, Tensor], Grid, dict[str, float | str]]:
        image = self.root[0]
        pieces = image.findall("Piece")
        extent = _numbers(image, "WholeExtent", 6)
        if len(pieces) != 1 or _numbers(pieces[0], "Extent", 6) != extent:
            raise InputError(f"expected an image in one piece, got {len(pieces)}")
        if _numbers(image, "Direction", 9, "1 0 0 0 1 0 0 0 1") != [1, 0, 0, 0, 1, 0, 0, 0, 1]:
            raise InputError("expected an image along the axes x, y, z, got a turned one")
        origin, spacing = _numbers(image, "Origin", 3, "0 0 0"), _numbers(image, "Spacing", 3, "1 1 1")
        nx, ny, nz = (int(last - first) + 1 for first, last in zip(extent[::2], extent[1::2], strict=True))
        x, y, z = (o + s * (e - 0.5) for o, s, e in zip(origin, spacing, extent[::2], strict=True))
        upper = (x + spacing[0] * nx, y + spacing[1] * ny, z + spacing[2] * nz)
        grid = Grid(Box((x, y, z), upper), (nz, ny, nx))
        arrays, attributes = {}, dict[str, float | str]()
        for element in pieces[0].findall("PointData/DataArray"):
            if int(element.get("NumberOfComponents", "1")) == 1:
                kind = self.kind(element)
                values = np.frombuffer(self.data(element), kind).astype(kind.newbyteorder("="))
                name = str(element.get("Name"))
                if values.size != nx * ny * nz:
                    raise InputError(f"expected {nx} x {ny} x {nz} numbers, got {values.size}", field=f"array '{name}'")
                if values.dtype.kind != "f":
                    values = values.astype(np.float64)
                arrays[name] = torch.from_numpy(values.reshape(nz, ny, nx))
        for element in image.findall("FieldData/*") + self.root.findall("FieldData/*"):
            name, data = str(element.get("Name")), self.data(element)
            if element.get("type") == "String":
                attributes[name] = data.rstrip(b"\0").decode()
            elif len(data) == self.kind(element).itemsize:
                attributes[name] = float(np.frombuffer(data, self.kind(element))[0])
        return arrays, grid, attributes

    def kind(self, element: ElementTree.Element) -> np.dtype:
        return np.dtype(self.order + TYPES[element.get("type", "")])

    def data(self, element: ElementTree.Element) -> bytes:
        """The bytes of an array, wherever they stand."""
        form, text = element.get("format", "ascii"), (element.text or "").strip()
        if form == "ascii":
            return np.array(text.split(), dtype=np.float64).astype(self.kind(element)).tobytes()
        if form == "binary":
            return self._unpack(text.encode(), False)
        offset = int(element.get("offset", "0"))
        if not 0 <= offset < len(self.appended):
            raise ValueError(f"data at {offset} are beyond the end")
        return self._unpack(self.appended[offset:], self.raw)

    def _unpack(self, source: bytes, raw: bool) -> bytes:
        """Data behind their header: the number of bytes, or numbers and sizes of compressed blocks."""
        size = self.word.itemsize

        def words(count: int) -> list[int]:
            part = source[: count * size] if raw else base64.b64decode(source[: -(-count * size // 3) * 4])
            return np.frombuffer(part, self.word, count).tolist()

        if self.compressor is None:
            (length,) = words(1)
            if raw:
                whole = source[size : size + length]
            else:
                whole = base64.b64decode(source[: -(-(size + length) // 3) * 4])[size : size + length]
            if len(whole) != length:
                raise ValueError("an array is cut short")
            return whole
        count, block, _ = words(3)
        header = words(3 + count)
        packed = (
            source[len(header) * size :]
            if raw
            else base64.b64decode(source[-(-len(header) * size // 3) * 4 :][: -(-sum(header[3:]) // 3) * 4])
        )
        parts, at = [], 0
        for length in header[3:]:
            parts.append(zlib.decompressobj().decompress(packed[at : at + length], block))
            at += length
        return b"".join(parts)


def _numbers(element: ElementTree.Element, name: str, count: int, default: str = "") -> list[float]:
    numbers = [float(word) for word in element.get(name, default).split()]
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{name}: expected {count} numbers, got '{element.get(name)}'")
    return numbers
