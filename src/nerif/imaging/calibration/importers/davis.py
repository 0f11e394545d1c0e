"""Cameras of LaVision's DaVis 10 and 11: Calibration.xml, with models PinholeOpenCV and Polynomial3rdOrder; in mm.

PinholeOpenCV, in spite of the name FocalLengthPixel with lengths in mm:

    x_cam = Rz Ry Rx x_world + TranslationMm,     f = FocalLengthPixel / SensorPixelSizeMm,     k1 k2 p1 p2 of OpenCV

Polynomial3rdOrder, one of each calibrated plane z = ZPosition / PixelPerMmFactor, from the corrected image to the raw:

    x' = (X - OffsetMm) / FactorMmPerPixel,     s = 2 (x' - s_o) / nx,     x = x' - dx(s, t)
    dx = a_o + a_s s + a_s2 s^2 + a_s3 s^3 + a_t t + a_t2 t^2 + a_t3 t^3 + a_st s t + a_s2t s^2 t + a_st2 s t^2

and y, t, dy with Y, t_o, ny, b in the same way. A camera is fitted to these mappings on all planes; between them DaVis
interpolates. Pixels count from 0.

Sources: readers of these files in PIV_GUI (SPC3MN), FtpSolver (A. Semati) and PIVTOOLs; LaVision publishes no format.
Not tried on a file of DaVis itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera
from nerif.imaging.calibration.importers.point_fit import fit_camera

__all__ = ["davis_root", "read_davis"]

MAPPER = "CoordinateMapper"
POSITIVE = ("NormalisationFactor", "OriginalImageSize", "PixelPerMmFactor", "SensorPixelSizeMm")
CORRECTION = "correction field"
TERMS = {"o": (0, 0), "s": (1, 0), "s2": (2, 0), "s3": (3, 0), "t": (0, 1), "t2": (0, 2), "t3": (0, 3), "st": (1, 1)}
TERMS |= {"s2t": (2, 1), "st2": (1, 2)}
"""Powers of s and t of the coefficients."""
GRID, REACH = 31, 1.5  # points along an edge of a plane; |s|, |t| at its edges, beyond the image of a tilted camera
MIN_ON_PLANE = 50  # of these, within the image
MAX_DIFFERENCE = 1.0  # px, between a polynomial and the camera
FOCAL_LENGTHS = (0.2, 1000.0)  # over the image width, least and largest
RECALIBRATE = "calibrate in DaVis with its pinhole model"


def davis_root(path: Path) -> Element | None:
    """Return the root of a calibration of DaVis; None for any other file."""
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError, LookupError):  # none of XML, or of an unknown encoding
        return None
    return root if root.tag == "Calibration" or root.find(f".//{MAPPER}") is not None else None


def read_davis(
    files: Mapping[Path, dict[str, Any]], beside: Callable[[], object], say: Callable[[str], None]
) -> list[CalibratedCamera]:
    """Read the cameras, named cam1, cam2, ... by their identifiers; report how well cameras fit polynomials."""
    cameras: list[CalibratedCamera] = []
    for path, content in files.items():
        mappers: dict[str, CalibratedCamera] = {}
        for mapper in content["root"].iter(MAPPER):
            name, kind = f"cam{mapper.get('CameraIdentifier')}", mapper.get("Type")
            if name in mappers:
                raise InputError(
                    f"expected one view, got several of {name}; give a copy of the file with one CoordinateSystem",
                    field=path,
                )
            if kind not in MODELS:
                expected = " or ".join(MODELS)
                raise InputError(f"expected {expected} of DaVis 10 or 11, got '{kind}'; {RECALIBRATE}", field=path)
            mappers[name] = MODELS[kind](mapper, name, path, say)
        if not mappers:
            raise InputError(f"expected elements {MAPPER} as of DaVis 10 and 11, got none", field=path)
        cameras += mappers.values()
    return cameras


def _pinhole(mapper: Element, name: str, path: Path, say: Callable[[str], None]) -> CalibratedCamera:
    from scipy.spatial.transform import Rotation

    where, size = f"{path}: {name}", _size(mapper, f"{path}: {name}")
    pitch = _number(mapper, "SensorPixelSizeMm", "Value", where)
    fx, fy = (_number(mapper, "FocalLengthPixel", axis, where) / pitch for axis in "xy")
    least, largest = (share * size[1] for share in FOCAL_LENGTHS)
    if not least <= min(fx, fy) <= max(fx, fy) <= largest:
        raise InputError(
            f"expected focal lengths of {least:g} to {largest:g} px (FocalLengthPixel in mm / SensorPixelSizeMm), got "
            f"{fx:.4g} and {fy:.4g}; {RECALIBRATE} from several positions of the plate",
            field=where,
        )
    cx, cy = (_number(mapper, "PrincipalPoint", axis, where) for axis in "xy")
    k1, k2, p1, p2 = (
        _number(mapper, f"{kind}Distortion", f"{kind.lower()}DistortionCoefficient{i}", where, 0.0)
        for kind in ("Radial", "Tangential") for i in (1, 2)
    )  # fmt: skip
    angles = [_number(mapper, "RotationAngles", f"R{axis}", where) for axis in "xyz"]
    shift = [_number(mapper, "TranslationMm", f"T{axis}", where) for axis in "xyz"]
    rotation = Rotation.from_euler("xyz", angles).as_matrix()  # Rz Ry Rx
    k = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    return CalibratedCamera.from_values(where, name, k, rotation, shift, [k1, k2, p1, p2], size)


def _polynomial(mapper: Element, name: str, path: Path, say: Callable[[str], None]) -> CalibratedCamera:
    where, size = f"{path}: {name}", _size(mapper, f"{path}: {name}")
    if any(entry.is_dir() and entry.name.lower() == CORRECTION for entry in path.parent.iterdir()):
        raise InputError(
            f"expected the whole mapping in the file, got a folder '{CORRECTION}' of a self-calibration beside it, "
            f"which is not read; give the calibration before it, or {RECALIBRATE}",
            field=where,
        )
    planes = [_plane(mapper, plane, size, where) for plane in mapper.iter("PolynomialMapping")]
    if len({float(points[0, 2]) for points, _ in planes}) < 2:
        raise InputError(
            f"expected polynomials on two planes z or more, got {len(planes)}; one has no depth: calibrate in DaVis "
            "with a plate of two levels or in several positions",
            field=where,
        )
    points, pixels = (np.concatenate(arrays) for arrays in zip(*planes, strict=True))
    fit = fit_camera(points, pixels, where, name, size)
    say(f"{path.name}: {name}: camera fitted to polynomials on {len(planes)} planes: {fit.words}")
    if not fit.errors.max() <= MAX_DIFFERENCE:
        raise InputError(
            f"expected polynomials that a camera with distortion matches within {MAX_DIFFERENCE:g} px, got a "
            f"difference of {fit.errors.max():.2g} px; {RECALIBRATE}",
            field=where,
        )
    return fit.camera


MODELS = {"PinholeOpenCV": _pinhole, "Polynomial3rdOrder": _polynomial}


def _plane(
    mapper: Element, plane: Element, size: tuple[int, int], where: str
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]]:
    """Return points of a calibrated plane that are in the image, mm, and their pixels."""
    z = _number(plane, "ZPosition", "Value", where) / _number(mapper, "PixelPerMmFactor", "Value", where)
    normalised = np.stack(np.meshgrid(*(np.linspace(-REACH, REACH, GRID),) * 2), axis=-1).reshape(-1, 2)
    scaled = mapper if plane.find(".//NormalisationFactor") is None else plane
    world, raw = [], []
    for i, (axis, edge, origin, letter) in enumerate((("X", "nx", "s_o", "a"), ("Y", "ny", "t_o", "b"))):
        half = _number(scaled, "NormalisationFactor", edge, where) / 2
        corrected = _number(plane, "Origin", origin, where) + half * normalised[:, i]
        offset, factor = (_number(mapper, f"LinearScale{axis}", key, where) for key in ("OffsetMm", "FactorMmPerPixel"))
        world.append(offset + factor * corrected)
        coefficients = f"Coefficients{letter.upper()}"
        raw.append(corrected - sum(
            _number(plane, coefficients, f"{letter}_{term}", where) * normalised[:, 0] ** m * normalised[:, 1] ** n
            for term, (m, n) in TERMS.items()
        ))  # fmt: skip
    points, pixels = np.stack([*world, np.full(len(normalised), z)], axis=-1), np.stack(raw, axis=-1)
    inside = ((pixels >= 0) & (pixels <= (size[1] - 1, size[0] - 1))).all(axis=-1)
    if inside.sum() < MIN_ON_PLANE:
        raise InputError(f"expected a plane z = {z:g} mm in the image, got polynomials that map it beside", field=where)
    return points[inside], pixels[inside]


def _size(mapper: Element, where: str) -> tuple[int, int]:
    """Height and width of the raw images, px."""
    height, width = (int(_number(mapper, "OriginalImageSize", key, where)) for key in ("Height", "Width"))
    return height, width


def _number(element: Element, tag: str, attribute: str, where: str, default: float | None = None) -> float:
    """Return the number in an attribute of the first element of this name."""
    child = element.find(f".//{tag}")
    text = None if child is None else child.get(attribute)
    if text is None and default is not None:
        return default
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or (tag in POSITIVE and number <= 0):
        expected = "a number above 0" if tag in POSITIVE else "a number"
        got = "none" if text is None else f"'{text}'"
        raise InputError(f"expected {expected} in <{tag} {attribute}=...>, got {got}", field=where)
    return number
