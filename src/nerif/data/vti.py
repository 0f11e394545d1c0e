"""VTK XML files, what ParaView opens: images (.vti) of volumes, polygons (.vtp) of surfaces, films of them (.pvd)."""

from __future__ import annotations

import base64
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from nerif.common.conventions import InputError, within
from nerif.common.files import atomic, reading
from nerif.common.memory import check_memory
from nerif.geometry import Box, Grid

__all__ = ["read_vti", "write_pvd", "write_vti", "write_vtp"]

BLOCK_BYTES = 1 << 20
BYTES_OF_WORD = 32  # of a short word of a text once it is split, for each of its characters
ZLIB_LEVEL = 1  # half the time of level 5 for 1 % more bytes


def write_vti(
    path: str | os.PathLike[str], arrays: dict[str, Tensor], grid: Grid, attributes: dict[str, float | str]
) -> None:
    """Write (z, y, x) arrays, and (3, z, y, x) vectors, as point data of a VTK image, lengths in mm, atomically.

    Source: VTK XML file formats, docs.vtk.org (ImageData; appended raw data in blocks compressed by zlib).
    """
    nz, ny, nx = grid.shape
    extent = f"0 {nx - 1} 0 {ny - 1} 0 {nz - 1}"
    corner = [grid.axis(a)[0] for a in "xyz"]
    origin, spacing = (" ".join(repr(float(x)) for x in numbers) for numbers in (corner, grid.spacing))
    document = _Document("ImageData", attributes, WholeExtent=extent, Origin=origin, Spacing=spacing)
    piece = ElementTree.SubElement(document.content, "Piece", Extent=extent)
    document.add_arrays(piece, arrays)
    document.write(path)


def write_vtp(
    path: str | os.PathLike[str], vertices: Tensor, faces: Tensor, arrays: dict[str, Tensor],
    attributes: dict[str, float | str],
) -> None:  # fmt: skip
    """Write triangles with arrays of their vertices as VTK polygons, lengths in mm, atomically.

    Source: VTK XML file formats, docs.vtk.org (PolyData).

    Parameters
    ----------
    vertices : (n, 3) mm
    faces : (m, 3) vertices of each triangle
    arrays : (n,) by name
    """
    document = _Document("PolyData", attributes)
    counts = {"NumberOfPoints": str(len(vertices)), "NumberOfPolys": str(len(faces))}
    piece = ElementTree.SubElement(document.content, "Piece", counts)
    document.add_arrays(piece, arrays)
    points = ElementTree.SubElement(piece, "Points")
    document.add(points, "DataArray", "Float64", "Points", _bytes(vertices, "<f8"), NumberOfComponents="3")
    polygons = ElementTree.SubElement(piece, "Polys")
    document.add(polygons, "DataArray", "Int64", "connectivity", _bytes(faces, "<i8"))
    document.add(polygons, "DataArray", "Int64", "offsets", np.arange(3, 3 * len(faces) + 1, 3).astype("<i8").tobytes())
    document.write(path)


def write_pvd(path: str | os.PathLike[str], times: Mapping[str, float]) -> None:
    """Write a list of VTK files and their times in s, atomically.

    Source: ParaView's wiki, Data formats, PVD file format.

    Parameters
    ----------
    times : s, by file, relative to the folder of the list, with forward slashes
    """
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ElementTree.SubElement(root, "Collection")
    for file, time in times.items():
        ElementTree.SubElement(collection, "DataSet", timestep=repr(time), group="", part="0", file=file)
    ElementTree.indent(root)
    with atomic(path) as part:
        part.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


def _bytes(values: Tensor, kind: str) -> bytes:
    return values.cpu().contiguous().numpy().astype(kind).tobytes()


class _Document:
    """A VTK XML file under construction: its element of a kind such as ImageData, and the data appended to it."""

    def __init__(self, kind: str, attributes: dict[str, float | str], **extent: str) -> None:
        self.root = ElementTree.Element(
            "VTKFile", type=kind, version="1.0", byte_order="LittleEndian", header_type="UInt64",
            compressor="vtkZLibDataCompressor",
        )  # fmt: skip
        self.content = ElementTree.SubElement(self.root, kind, extent)
        self.appended: list[bytes] = []
        about = ElementTree.SubElement(self.content, "FieldData")
        for name, value in attributes.items():
            if isinstance(value, str):
                self.add(about, "Array", "String", name, value.encode() + b"\0", NumberOfTuples="1")
            else:
                self.add(about, "DataArray", "Float64", name, np.array(value, "<f8").tobytes(), NumberOfTuples="1")

    def add(self, parent: ElementTree.Element, tag: str, kind: str, name: str, content: bytes, **more: str) -> None:
        """Add an array of a type such as Float64."""
        offset = str(sum(map(len, self.appended)))
        ElementTree.SubElement(
            parent, tag, {"type": kind, "Name": name, **more, "format": "appended", "offset": offset}
        )
        self.appended.append(_compress(content))

    def add_arrays(self, piece: ElementTree.Element, arrays: dict[str, Tensor]) -> None:
        """Add an element with arrays of points, the first of which is shown."""
        points = ElementTree.SubElement(
            piece, "PointData", Scalars=next(name for name, a in arrays.items() if a.ndim < 4)
        )
        for name, values in arrays.items():
            size, more = values.element_size(), {}
            if values.ndim == 4:
                values, more = values.movedim(0, -1), {"NumberOfComponents": "3"}
            self.add(points, "DataArray", {4: "Float32", 8: "Float64"}[size], name, _bytes(values, f"<f{size}"), **more)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the file atomically."""
        ElementTree.SubElement(self.root, "AppendedData", encoding="raw").text = "_"
        before, after = ElementTree.tostring(self.root).split(b"_</AppendedData>")
        with atomic(path) as part, part.open("wb") as file:
            file.writelines([before + b"_", *self.appended, b"</AppendedData>" + after])


def _compress(content: bytes) -> bytes:
    """Compress in blocks after VTK's header: number of blocks, size of each and of the last, compressed sizes."""
    blocks = [content[at : at + BLOCK_BYTES] for at in range(0, len(content), BLOCK_BYTES)]
    compressed = [zlib.compress(block, ZLIB_LEVEL) for block in blocks]
    header = [len(blocks), BLOCK_BYTES, len(content) % BLOCK_BYTES, *map(len, compressed)]
    return np.array(header, "<u8").tobytes() + b"".join(compressed)


def read_vti(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], Grid, dict[str, float | str]]:
    """Read the point data of a VTK image as (z, y, x) arrays, their grid and the field data.

    The reader of VTK itself ends the process on a damaged file.

    Source: VTK XML file formats, docs.vtk.org (ImageData; ascii, base64 and raw data, plain or compressed by zlib).
    """
    content = Path(path).read_bytes()
    with reading("not a VTK image file (.vti), or truncated", path), within(path):
        return _Image(content, Path(path)).read()


TYPES = {"Float32": "f4", "Float64": "f8", "String": "u1"}
TYPES |= {f"{sign}Int{8 * n}": f"{code}{n}" for sign, code in (("", "i"), ("U", "u")) for n in (1, 2, 4, 8)}


class _Image:
    """The XML of a file, and the data appended to it."""

    def __init__(self, content: bytes, path: Path) -> None:
        self.path = path
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
        self.order = ">" if self.root.get("byte_order") == "BigEndian" else "<"
        self.word = np.dtype(self.order + TYPES[self.root.get("header_type", "UInt32")])
        self.compressor = self.root.get("compressor")
        if self.compressor not in (None, "vtkZLibDataCompressor"):
            raise InputError(f"expected data without compression or by zlib, got {self.compressor}; save it again")

    def read(self) -> tuple[dict[str, Tensor], Grid, dict[str, float | str]]:
        image = self.root[0]
        pieces = image.findall("Piece")
        extent = _numbers(image, "WholeExtent", 6)
        if len(pieces) != 1 or _numbers(pieces[0], "Extent", 6) != extent:
            raise InputError(f"expected an image in one piece, got {len(pieces)}")
        if _numbers(image, "Direction", 9, "1 0 0 0 1 0 0 0 1") != [1, 0, 0, 0, 1, 0, 0, 0, 1]:
            raise InputError("expected an image along the axes x, y, z, got a rotated one")
        origin, spacing = _numbers(image, "Origin", 3, "0 0 0"), _numbers(image, "Spacing", 3, "1 1 1")
        nx, ny, nz = (int(last - first) + 1 for first, last in zip(extent[::2], extent[1::2], strict=True))
        x, y, z = (o + s * (e - 0.5) for o, s, e in zip(origin, spacing, extent[::2], strict=True))
        upper = (x + spacing[0] * nx, y + spacing[1] * ny, z + spacing[2] * nz)
        grid = Grid(Box((x, y, z), upper), (nz, ny, nx))
        arrays, attributes = {}, dict[str, float | str]()
        for element in pieces[0].findall("PointData/DataArray"):
            if int(element.get("NumberOfComponents", "1")) == 1:
                kind = self.kind(element)
                size = nx * ny * nz * kind.itemsize
                check_memory(size, self.path)
                values = np.frombuffer(self.data(element, size), kind).astype(kind.newbyteorder("="))
                name = str(element.get("Name"))
                if values.size != nx * ny * nz:
                    raise InputError(f"expected {nx} x {ny} x {nz} numbers, got {values.size}", field=f"array '{name}'")
                if values.dtype.kind != "f":
                    values = values.astype(np.float64)
                arrays[name] = torch.from_numpy(values.reshape(nz, ny, nx))
        for element in image.findall("FieldData/*") + self.root.findall("FieldData/*"):
            name, data = str(element.get("Name")), self.data(element, BLOCK_BYTES)
            if element.get("type") == "String":
                attributes[name] = data.rstrip(b"\0").decode()
            elif len(data) == self.kind(element).itemsize:
                attributes[name] = float(np.frombuffer(data, self.kind(element))[0])
        return arrays, grid, attributes

    def kind(self, element: ElementTree.Element) -> np.dtype:
        return np.dtype(self.order + TYPES[element.get("type", "")])

    def data(self, element: ElementTree.Element, most: int) -> bytes:
        """Return the bytes of an array, at most as many as expected of it."""
        form, text = element.get("format", "ascii"), (element.text or "").strip()
        if form == "ascii":
            check_memory(BYTES_OF_WORD * min(most, len(text)), None)
            return np.array(text.split(maxsplit=most), dtype=np.float64).astype(self.kind(element)).tobytes()
        if form == "binary":
            return self._decode(text.encode(), False, most)
        offset = int(element.get("offset", "0"))
        if not 0 <= offset < len(self.appended):
            raise ValueError(f"data at {offset} are beyond the end")
        return self._decode(self.appended[offset:], self.raw, most)

    def _decode(self, source: bytes, raw: bool, most: int) -> bytes:
        """Return the data after a header: the number of bytes, or number and sizes of compressed blocks.

        In base64, header and compressed data are separate groups of 4 characters for 3 bytes.
        """
        size = self.word.itemsize

        def part(count: int, start: int = 0) -> bytes:
            """Return `count` bytes after a group of `start` bytes."""
            if raw:
                return source[start : start + count]
            return base64.b64decode(source[_base64_length(start) :][: _base64_length(count)])[:count]

        def words(count: int) -> list[int]:
            return np.frombuffer(part(count * size), self.word, count).tolist()

        if self.compressor is None:  # header and data are one group
            (length,) = words(1)
            content = part(size + length)[size:]
            if len(content) != length:
                raise ValueError("an array is truncated")
            return content
        blocks, block_size, _ = words(3)
        block_size = min(block_size, most + 1)
        if (blocks - 1) * block_size > most:
            raise ValueError(f"an array has {blocks} blocks of {block_size} bytes for {most} bytes")
        lengths = words(3 + blocks)[3:]
        compressed = part(sum(lengths), (3 + blocks) * size)
        contents, at = [], 0
        for length in lengths:
            contents.append(zlib.decompressobj().decompress(compressed[at : at + length], block_size))
            at += length
        return b"".join(contents)


def _base64_length(count: int) -> int:
    return -(-count // 3) * 4


def _numbers(element: ElementTree.Element, name: str, count: int, default: str = "") -> list[float]:
    numbers = [float(word) for word in element.get(name, default).split()]
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{name}: expected {count} numbers, got '{element.get(name)}'")
    return numbers
