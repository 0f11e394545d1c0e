"""The calibration file: cameras as TOML that a person can read, and mend.

format = "nerif-calibration-1"
box = [[x, y, z], [x, y, z]]            # lower and upper corner of what to reconstruct, mm; may be left out
[[camera]]
name = "cam1"
projection = "perspective"              # or "telecentric"; may be left out
image_size = [200, 240]                 # height, width, px; may be left out
intrinsics = [[fx, s, cx], [0, fy, cy], [0, 0, 1]]    # px; fx, s, fy of a telecentric camera px/mm
distortion = [k1, k2, p1, p2, k3]       # may be left out
rotation = [[...], [...], [...]]        # world to camera
translation = [tx, ty, tz]              # mm
aperture_diameter = 6.25                # mm, of the entrance pupil; may be left out: thin rays
focus_distance = 1200.0                 # mm along the optical axis; may be left out: focused on the background
pose_sigma = [rx, ry, rz, cx, cy, cz]   # standard deviations of turn (rad) and centre (mm); may be left out
[camera.background]                     # normal . x = offset; may be left out
normal = [nx, ny, nz]
offset = -500.0                         # mm
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError, Matrix3
from nerif.common.files import check_known, read_toml, write_toml
from nerif.geometry import PERSPECTIVE, Box, Camera, Lens, Plane, Projection, projection_named

__all__ = [
    "FORMAT", "CalibratedCamera", "check_distortion", "check_model", "check_names", "checked", "five", "flat",
    "image_size", "numbers", "plane", "read_box", "read_cameras", "upright", "write_cameras",
]  # fmt: skip

FORMAT = "nerif-calibration-1"
KEYS = ("name", "projection", "image_size", "intrinsics", "distortion", "rotation", "translation", "background",
        "aperture_diameter", "focus_distance", "pose_sigma")  # fmt: skip
BROWN = ("brown", "opencv", "perspective", "pinhole", "plumb_bob", "radial", "simple_pinhole", "simple_radial")
"""Names that programs give to cameras that Brown's distortion (k1, k2, p1, p2, k3) describes."""
LIKE_DISTORTION = re.compile("(?<!un)dist(?!an)", re.IGNORECASE)  # no undistorted images, no distances


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera as a calibration knows it: its background plane and image size may be unknown.

    Parameters
    ----------
    name : of the view
    intrinsics : (3, 3) K, px; fx and fy of a telecentric camera in px/mm
    rotation : (3, 3) world to camera
    translation : (3,) world to camera, mm
    distortion : (5,) k1, k2, p1, p2, k3
    image_size : (height, width), px, or None
    background : Plane, world frame, mm, or None
    projection : perspective or telecentric
    lens : Lens, or None for thin rays
    pose_sigma : (6,) that of a Camera, or None
    """

    name: str
    intrinsics: Matrix3
    rotation: Matrix3
    translation: Float[Tensor, 3]
    distortion: Float[Tensor, 5]
    image_size: tuple[int, int] | None = None
    background: Plane | None = None
    projection: Projection = PERSPECTIVE
    lens: Lens | None = None
    pose_sigma: Float[Tensor, 6] | None = None

    def camera(self, image_size: tuple[int, int] | None = None, background: Plane | None = None) -> Camera:
        """Return the whole camera; without a background if none is known.

        Raises
        ------
        InputError
            If the image size is known neither here nor there.
        """
        image_size, background = image_size or self.image_size, background or self.background
        if image_size is None:
            raise InputError(f"view '{self.name}' has no image size in its calibration; give --image-size HEIGHT WIDTH")
        return Camera(
            self.intrinsics, self.rotation, self.translation, image_size, background, self.distortion, self.name,
            self.projection, self.lens, self.pose_sigma,
        )  # fmt: skip

    @classmethod
    def from_camera(cls, camera: Camera) -> CalibratedCamera:
        """Take over a whole camera."""
        return cls(
            camera.name, camera.intrinsics, camera.rotation, camera.translation, camera.distortion,
            camera.image_size, camera.background, camera.projection, camera.lens,
            camera.pose_sigma,
        )  # fmt: skip


def checked(camera: CalibratedCamera, source: str) -> CalibratedCamera:
    """Return the camera if it can be one, else raise an InputError that names the source."""
    try:
        whole = replace(camera, lens=None).camera(camera.image_size or (1, 1))  # a background may come, to focus it on
        if camera.image_size is not None:
            whole.check_distortion()
    except InputError as error:
        raise error.inside(source) from None
    return camera


def numbers(value: Any, shape: tuple[int, ...], what: str) -> Tensor:
    """Return an array of float64 of a given shape.

    Raises
    ------
    InputError
        If it is none; the message says what it should be.
    """
    expected = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
    try:
        array = torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"expected {expected}, got {value!r}", field=what) from None
    if tuple(array.shape) != shape:
        got = " x ".join(map(str, array.shape)) or "a single number"
        raise InputError(f"expected {expected}, got {got}", field=what)
    if not bool(torch.isfinite(array).all()):
        raise InputError(f"expected finite numbers, got {value!r}", field=what)
    return array


def flat(value: Any, what: str, group: int = 1) -> np.ndarray:
    """Return the numbers of an array of any shape one after the other, float64.

    Raises
    ------
    InputError
        If they are none, or not a multiple of `group`.
    """
    try:
        found = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise InputError(f"expected numbers, got {value!r}", field=what) from None
    if found.size % group:
        raise InputError(f"expected {group} numbers each, got {found.size} in all", field=what)
    return found


def image_size(value: Any, what: str) -> tuple[int, int]:
    """Return (height, width), px; InputError if they are not two positive whole numbers."""
    size = numbers(value, (2,), what)
    if not bool((size > 0).all()) or bool((size % 1 != 0).any()):
        raise InputError(f"expected height and width, whole numbers of px, got {value}", field=what)
    return int(size[0]), int(size[1])


def plane(normal: Any, offset: Any, where: str) -> Plane:
    """Return the plane normal . x = offset (mm), its normal brought to length one.

    Raises
    ------
    InputError
        If they are no numbers, or the normal is no direction.
    """
    direction = numbers(normal, (3,), f"{where}: normal")
    length = float(direction.norm())
    if not length > 0:
        raise InputError(f"normal: expected a direction, got {normal}", field=where)
    return Plane(direction / length, float(numbers(offset, (), f"{where}: offset")) / length)


def check_model(model: Any, where: str) -> None:
    """Refuse a camera model by its name in another program, unless Brown's distortion describes it.

    Raises
    ------
    InputError
        If it is another model: its coefficients would bend the rays wrongly.
    """
    if str(model).lower() not in BROWN:
        raise InputError(
            f"expected a perspective camera with Brown's distortion ({', '.join(BROWN)}), got '{model}'; "
            "calibrate again with one of those models, or undistort the images first",
            field=where,
        )


def check_distortion(given: Iterable[str], used: Collection[str], names: Sequence[str], where: str) -> None:
    """Refuse keys that look like distortion coefficients and are not read.

    Parameters
    ----------
    given : keys of a file
    used : those that are read
    names : what the coefficients may be called, with or without a number behind

    Raises
    ------
    InputError
        If there is one: without its coefficients the rays would be bent wrongly.
    """
    for key in given:
        if key not in used and (key.rstrip("0123456789") in names or LIKE_DISTORTION.search(key)):
            raise InputError(
                f"expected distortion coefficients as one of {', '.join(names)}, got '{key}', which is not "
                "read; rename it, or take it out of the file",
                field=where,
            )


def check_names(cameras: Sequence[CalibratedCamera], where: str) -> None:
    """Refuse two cameras of one name; InputError naming it and where they are from."""
    names = [camera.name for camera in cameras]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"expected cameras of different names, got {names.count(name)} named '{name}'; rename them", field=where
            )


def five(values: Any, where: str) -> Tensor:
    """Return OpenCV's five coefficients of 4 to 14; InputError if those beyond are not 0, or one is no number."""
    given = flat(values, where)
    if not np.isfinite(given).all():
        raise InputError(f"expected finite numbers as distortion coefficients, got {values!r}", field=where)
    if np.any(given[5:] != 0):
        raise InputError(
            f"expected at most 5 distortion coefficients (k1 k2 p1 p2 k3), got {len(given)}; calibrate again "
            "without the rational, thin-prism and tilted models",
            field=where,
        )
    return torch.from_numpy(np.concatenate([given[:5], np.zeros(max(0, 5 - len(given)))]))


def upright(matrix: Any, where: str) -> Tensor:
    """Return K as OpenCV writes it, transposed back if it is MATLAB's."""
    k = numbers(matrix, (3, 3), where)
    if bool(k[:2, 2].abs().max() == 0) and bool(k[2, :2].abs().max() > 0):
        k = k.T.contiguous()
    return k / k[2, 2] if float(k[2, 2]) not in (0.0, 1.0) else k


def write_cameras(
    path: str | os.PathLike[str], cameras: Sequence[CalibratedCamera], about: dict[str, Any] | None = None,
    box: Box | None = None,
) -> None:  # fmt: skip
    """Write cameras, the box, and what else is worth keeping under [about], atomically and in full precision."""
    tables = []
    for camera in cameras:
        table: dict[str, Any] = {"name": camera.name}
        if camera.projection != PERSPECTIVE:
            table["projection"] = camera.projection.name
        if camera.image_size is not None:
            table["image_size"] = list(camera.image_size)
        for name in ("intrinsics", "distortion", "rotation", "translation"):
            table[name] = getattr(camera, name).tolist()
        if camera.lens is not None:
            table["aperture_diameter"] = camera.lens.diameter
            if camera.lens.focus is not None:
                table["focus_distance"] = camera.lens.focus
        if camera.pose_sigma is not None:
            table["pose_sigma"] = camera.pose_sigma.tolist()
        if camera.background is not None:
            table["background"] = {"normal": camera.background.normal.tolist(), "offset": camera.background.offset}
        tables.append(table)
    corners = {"box": [list(box.lower), list(box.upper)]} if box else {}
    write_toml(path, {"format": FORMAT, **corners, "camera": tables, **({"about": about} if about else {})})


def read_box(path: str | os.PathLike[str]) -> Box | None:
    """Read the box of a calibration file, mm; None where it has none, or is another program's.

    Raises
    ------
    InputError
        If it is missing, no TOML, or the corners are those of no box.
    """
    table = read_toml(path, "file; expected a calibration")
    if table.get("format") != FORMAT or "box" not in table:
        return None
    corners = numbers(table["box"], (2, 3), f"{path}: box (lower and upper corner, mm)")
    lower, upper = ((float(x), float(y), float(z)) for x, y, z in corners)
    try:
        return Box(lower, upper)
    except InputError as error:
        raise error.inside(path) from None


def read_cameras(path: str | os.PathLike[str]) -> tuple[CalibratedCamera, ...]:
    """Read a calibration file.

    Raises
    ------
    InputError
        If it is missing, no TOML, of another format, or a camera in it cannot be one; names file, camera and key.
    """
    table = read_toml(path, "file; expected a calibration")
    if table.get("format") != FORMAT:
        raise InputError(f"expected format = '{FORMAT}', got {table.get('format')!r}", field=path)
    tables = table.get("camera", [])
    if not isinstance(tables, list) or not tables or not all(isinstance(t, dict) for t in tables):
        raise InputError("expected at least one table [[camera]], got none", field=path)
    cameras = tuple(_camera(t, i, str(path)) for i, t in enumerate(tables))
    check_names(cameras, str(path))
    return cameras


def _camera(table: dict[str, Any], index: int, path: str) -> CalibratedCamera:
    name = str(table.get("name", f"camera {index}"))
    where = f"{path}: camera '{name}'"
    check_known(table, KEYS, where)
    for key in ("name", "intrinsics", "rotation", "translation"):
        if key not in table:
            raise InputError(f"'{key}' is missing", field=where)
    given = table.get("background")
    if given is not None and (not isinstance(given, dict) or set(given) != {"normal", "offset"}):
        raise InputError(f"background: expected normal = [x, y, z] and offset = mm, got {given!r}", field=where)
    camera = CalibratedCamera(
        name=name,
        intrinsics=numbers(table["intrinsics"], (3, 3), f"{where}: intrinsics"),
        rotation=numbers(table["rotation"], (3, 3), f"{where}: rotation"),
        translation=numbers(table["translation"], (3,), f"{where}: translation"),
        distortion=numbers(table.get("distortion", [0.0] * 5), (5,), f"{where}: distortion"),
        image_size=image_size(table["image_size"], f"{where}: image_size") if "image_size" in table else None,
        background=None if given is None else plane(given["normal"], given["offset"], f"{where}: background"),
        projection=projection_named(table.get("projection", PERSPECTIVE.name), f"{where}: projection"),
        lens=_lens(table, where),
        pose_sigma=numbers(table["pose_sigma"], (6,), f"{where}: pose_sigma") if "pose_sigma" in table else None,
    )
    return checked(camera, path)


def _lens(table: dict[str, Any], where: str) -> Lens | None:
    """The lens of a camera; none where its aperture is not told."""
    if "aperture_diameter" not in table:
        if "focus_distance" in table:
            raise InputError("focus_distance: expected together with aperture_diameter, got it alone", field=where)
        return None
    diameter, focus = (
        None if key not in table else float(numbers(table[key], (), f"{where}: {key}"))
        for key in ("aperture_diameter", "focus_distance")
    )
    try:
        return Lens(diameter or 0.0, focus)
    except InputError as error:
        raise error.inside(where) from None
