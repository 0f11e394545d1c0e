"""The calibration file: cameras as TOML that can be read and edited by hand.

format = "nerif-calibration-1"
box = [[x, y, z], [x, y, z]]            # optional: lower and upper corner of the volume to reconstruct, mm
[[camera]]
name = "cam1"
projection = "perspective"              # optional; or "telecentric"
image_size = [200, 240]                 # optional: height, width, px
intrinsics = [[fx, s, cx], [0, fy, cy], [0, 0, 1]]    # px; fx, s, fy of a telecentric camera px/mm
distortion = [k1, k2, p1, p2, k3]       # optional
tilt = [tau_x, tau_y]                   # optional: of the sensor behind a Scheimpflug lens, rad
rotation = [[...], [...], [...]]        # world to camera
translation = [tx, ty, tz]              # mm
aperture_diameter = 6.25                # optional: diameter of the entrance pupil, mm; without it, thin rays
focus_distance = 1200.0                 # optional: mm along the optical axis; without it, focused on the background
pose_sigma = [rx, ry, rz, cx, cy, cz]   # optional: standard deviations of rotation (rad) and centre (mm)
[camera.background]                     # optional: normal . x = offset
normal = [nx, ny, nz]
offset = -500.0                         # mm
[[camera.interface]]                    # optional: up to three planes, in order from the camera
normal = [nx, ny, nz]                   # unit vector: normal . x = offset
offset = 300.0                          # mm
index = 1.52                            # refractive index behind the plane
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Matrix3
from nerif.common.conventions import InputError, check_name, within
from nerif.common.files import check_known, read_toml, write_toml
from nerif.geometry import PERSPECTIVE, Box, Camera, Interface, Lens, Plane, Projection, projection_named
from nerif.geometry.distortion import UPRIGHT

__all__ = [
    "FORMAT", "CalibratedCamera", "check_camera", "check_distortion", "check_model", "check_names",
    "check_program", "flat", "interface_of", "numbers", "read_box", "read_cameras", "write_cameras",
]  # fmt: skip

FORMAT = "nerif-calibration-1"
ARRAYS = ("intrinsics", "distortion", "rotation", "translation")
LENS = ("aperture_diameter", "focus_distance")
KEYS = ("name", "projection", "image_size", *ARRAYS, "tilt", "background", *LENS, "pose_sigma", "interface")
INTERFACE = ("normal", "offset", "index")
BROWN = (
    "brown", "opencv", "perspective", "pinhole", "plumb_bob", "radial", "radtan", "simple_pinhole", "simple_radial",
)  # fmt: skip
"""Names that programs give to camera models with Brown's distortion (k1, k2, p1, p2, k3)."""
UNREAD = {
    "MC-Calib": {"nb_camera"}, "OpenPose": {"CameraMatrix", "Intrinsics"}, "multical": {"cameras", "camera_poses"},
}  # fmt: skip
LIKE_DISTORTION = re.compile("(?<!un)dist(?!an)|^tau_?[xy]|tilt", re.IGNORECASE)  # not undistorted images, distances


@dataclass(frozen=True)
class CalibratedCamera:
    """A Camera (same fields) whose image size may still be unknown."""

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
    tilt: Float[Tensor, 2] = UPRIGHT
    interfaces: tuple[Interface, ...] = ()

    def camera(self, image_size: tuple[int, int] | None = None, background: Plane | None = None) -> Camera:
        """Return the Camera, with this image size (px) and background where they are given."""
        size = image_size or self.image_size
        if size is None:
            raise InputError(f"view '{self.name}' has no image size in its calibration; give --image-size HEIGHT WIDTH")
        return Camera(**{**vars(self), "image_size": size, "background": background or self.background})

    def binned(self) -> CalibratedCamera:
        """Return the camera of images whose pixels are cells of 2 x 2 px of those it was calibrated with.

        A position p in px becomes (p + 1/2) / 2 - 1/2: pixel (0, 0) is centred on the corner of four old ones.
        """
        halved = torch.tensor([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]], dtype=torch.float64)
        size = None if self.image_size is None else (self.image_size[0] // 2, self.image_size[1] // 2)
        return replace(self, intrinsics=halved @ self.intrinsics, image_size=size)

    @classmethod
    def from_camera(cls, camera: Camera) -> CalibratedCamera:
        """Return the same camera as one of a calibration."""
        return cls(**vars(camera))

    @classmethod
    def from_values(
        cls, where: str, name: str, intrinsics: Any, rotation: Any, translation: Any, distortion: Any = None,
        image_size: Any = None, background: tuple[Any, Any] | None = None, projection: Any = PERSPECTIVE.name,
        lens: Lens | None = None, pose_sigma: Any = None, tilt: Any = None, interfaces: tuple[Interface, ...] = (),
    ) -> CalibratedCamera:  # fmt: skip
        """Return a camera from the numbers of a file, after checking their shapes; errors start with `where`.

        Parameters
        ----------
        intrinsics : (3, 3) K, or its transpose (MATLAB)
        translation : 3 numbers in any arrangement
        distortion : up to 14 coefficients of OpenCV, of which the sixth to twelfth have to be 0; None for none
        image_size : height and width, px
        background : normal of any length, and offset, mm
        tilt : tau_x, tau_y, rad, the last two of 14 coefficients
        """
        coefficients, last = _coefficients(distortion, f"{where}: distortion")
        if tilt is not None and bool(last.any()):
            got = f"got {last.tolist()} in distortion too"
            raise InputError(f"expected it once, {got}; remove one", field=f"{where}: tilt")
        return cls(
            name=name,
            intrinsics=_upright(numbers(intrinsics, (3, 3), f"{where}: intrinsics")),
            rotation=numbers(rotation, (3, 3), f"{where}: rotation"),
            translation=numbers(flat(translation, f"{where}: translation"), (3,), f"{where}: translation"),
            distortion=coefficients,
            image_size=None if image_size is None else _size(image_size, f"{where}: image_size"),
            background=None if background is None else _plane(*background, f"{where}: background"),
            projection=projection_named(projection, f"{where}: projection"),
            lens=lens,
            pose_sigma=None if pose_sigma is None else numbers(pose_sigma, (6,), f"{where}: pose_sigma"),
            tilt=last if tilt is None else numbers(tilt, (2,), f"{where}: tilt"),
            interfaces=interfaces,
        )


def interface_of(table: Any, where: str) -> Interface:
    """Return the interface of a table with normal, offset (mm) and index, after checking it."""
    if not isinstance(table, dict) or set(table) != set(INTERFACE):
        got = sorted(table) if isinstance(table, dict) else table
        raise InputError(f"expected normal = [x, y, z], offset = mm and index, got {got}", field=where)
    offset, index = (float(numbers(table[key], (), f"{where}: {key}")) for key in INTERFACE[1:])
    with within(where):
        return Interface(numbers(table["normal"], (3,), f"{where}: normal"), offset, index)


def check_camera(camera: CalibratedCamera, source: str) -> CalibratedCamera:
    """Return the camera if it is a valid one, else raise an InputError that names the source."""
    with within(source):
        # without the lens: its focus may depend on a background that is still to come
        whole = replace(camera, lens=None).camera(camera.image_size or (1, 1))
        if camera.image_size is not None:
            whole.check_distortion()
    return camera


def numbers(value: Any, shape: tuple[int, ...], name: str) -> Tensor:
    """Return finite numbers of a shape, float64."""
    expected, text = f"{' x '.join(map(str, shape))} numbers" if shape else "a number", " ".join(repr(value).split())
    try:
        array = torch.as_tensor(value.tolist() if isinstance(value, np.ndarray) else value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"expected {expected}, got {text}", field=name) from None
    if tuple(array.shape) != shape:
        got = " x ".join(map(str, array.shape)) or "a single number"
        raise InputError(f"expected {expected}, got {got}", field=name)
    if not bool(torch.isfinite(array).all()):
        raise InputError(f"expected finite numbers, got {text}", field=name)
    return array


def flat(value: Any, name: str, group: int = 1) -> np.ndarray:
    """Return the numbers of an array of any shape as a float64 vector whose length is a multiple of `group`."""
    try:
        vector = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise InputError(f"expected numbers, got {' '.join(repr(value).split())}", field=name) from None
    if vector.size % group:
        raise InputError(f"expected a multiple of {group} numbers, got {vector.size}", field=name)
    return vector


def _size(value: Any, name: str) -> tuple[int, int]:
    size = numbers(value, (2,), name)
    if not bool(((size > 0) & (size % 1 == 0)).all()):
        raise InputError(f"expected height and width, whole numbers of px, got {value}", field=name)
    return int(size[0]), int(size[1])


def _plane(normal: Any, offset: Any, name: str) -> Plane:
    direction = numbers(normal, (3,), f"{name}: normal")
    length = float(direction.norm())
    if not length > 0:
        raise InputError(f"expected a direction, got {direction.tolist()}", field=f"{name}: normal")
    return Plane(direction / length, float(numbers(offset, (), f"{name}: offset")) / length)


def _coefficients(coefficients: Any, name: str) -> tuple[Tensor, Tensor]:
    """The first five of OpenCV's coefficients, and the last two of all 14."""
    vector = flat([] if coefficients is None else coefficients, name)
    if not np.isfinite(vector).all():
        raise InputError(f"expected finite numbers as distortion coefficients, got {vector.tolist()}", field=name)
    whole = np.concatenate([vector, np.zeros(max(0, 14 - len(vector)))])
    if whole[5:12].any() or whole[14:].any():
        raise InputError(
            "expected at most 5 distortion coefficients (k1 k2 p1 p2 k3) and, as the last of 14, the tilt tau_x tau_y, "
            f"got {len(vector)} with others that are not 0; calibrate again without the rational and thin-prism models",
            field=name,
        )
    return torch.from_numpy(whole[:5]), torch.from_numpy(whole[12:14].copy())


def _upright(k: Tensor) -> Tensor:
    """K as OpenCV writes it, transposed if it is MATLAB's."""
    if bool(k[:2, 2].abs().max() == 0) and bool(k[2, :2].abs().max() > 0):
        k = k.T.contiguous()
    return k / k[2, 2] if float(k[2, 2]) not in (0.0, 1.0) else k


def check_model(model: Any, where: str) -> None:
    """Refuse a camera model, by its name in another program, that has other than Brown's distortion."""
    if str(model).lower() not in BROWN:
        raise InputError(
            f"expected a perspective camera with Brown's distortion ({', '.join(BROWN)}), got '{model}'; "
            "calibrate again with one of those models, or undistort the images first",
            field=where,
        )


def check_program(keys: Iterable[str], where: str) -> None:
    """Refuse the files of programs that nerif does not read, recognised by their keys."""
    for program, marks in UNREAD.items():
        if marks <= {*keys}:
            raise InputError(
                f"a calibration of {program}, which nerif does not read; write its cameras as tables [cam1] with K, R "
                "(3 x 3) and t, x_cam = R x_world + t in mm, and distortion k1 k2 p1 p2 k3 into a .toml",
                field=where,
            )


def check_distortion(keys: Iterable[str], read: Collection[str], names: Sequence[str], where: str) -> None:
    """Refuse keys of a file that look like distortion coefficients but are not read: rays would be wrong without them.

    Parameters
    ----------
    read : keys that are read
    names : possible keys of the coefficients, with or without a number appended
    """
    for key in keys:
        if key not in read and (key.rstrip("0123456789") in names or LIKE_DISTORTION.search(key)):
            raise InputError(
                f"expected distortion coefficients as one of {', '.join(names)}, got '{key}', which is not "
                "read; rename it, or remove it from the file",
                field=where,
            )


def check_names(cameras: Sequence[CalibratedCamera], where: str) -> None:
    """Refuse two cameras of one name, and names with control characters."""
    for name, count in Counter(camera.name for camera in cameras).items():
        check_name(name, f"{where}: camera")
        if count > 1:
            raise InputError(f"expected cameras of different names, got {count} named '{name}'; rename", field=where)


def write_cameras(
    path: str | os.PathLike[str], cameras: Sequence[CalibratedCamera], about: dict[str, Any] | None = None,
    box: Box | None = None,
) -> None:  # fmt: skip
    """Write cameras and box, with further entries under [about], atomically and in full precision."""
    tables = []
    for camera in cameras:
        table: dict[str, Any] = {"name": camera.name}
        if camera.projection != PERSPECTIVE:
            table["projection"] = camera.projection.name
        if camera.image_size is not None:
            table["image_size"] = list(camera.image_size)
        table |= {name: getattr(camera, name).tolist() for name in ARRAYS}
        if bool(camera.tilt.any()):
            table["tilt"] = camera.tilt.tolist()
        if camera.lens is not None:
            table["aperture_diameter"] = camera.lens.diameter
            if camera.lens.focus is not None:
                table["focus_distance"] = camera.lens.focus
        if camera.pose_sigma is not None:
            table["pose_sigma"] = camera.pose_sigma.tolist()
        if camera.background is not None:
            table["background"] = {"normal": camera.background.normal.tolist(), "offset": camera.background.offset}
        if camera.interfaces:
            planes = camera.interfaces
            table["interface"] = [{"normal": p.normal.tolist(), "offset": p.offset, "index": p.index} for p in planes]
        tables.append(table)
    corners = {"box": [list(box.lower), list(box.upper)]} if box else {}
    write_toml(path, {"format": FORMAT, **corners, "camera": tables, **({"about": about} if about else {})})


def read_box(path: str | os.PathLike[str]) -> Box | None:
    """Read the box of a calibration file, mm; None if it has none or is of another format."""
    table = read_toml(path, "file; expected a calibration")
    if table.get("format") != FORMAT or "box" not in table:
        return None
    corners = numbers(table["box"], (2, 3), f"{path}: box (lower and upper corner, mm)")
    lower, upper = ((float(x), float(y), float(z)) for x, y, z in corners)
    with within(path):
        return Box(lower, upper)


def read_cameras(path: str | os.PathLike[str]) -> tuple[CalibratedCamera, ...]:
    """Read the cameras of a calibration file; errors name file, camera and key."""
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
    where = f"{path}: camera '{table.get('name', f'camera {index}')}'"
    check_known(table, KEYS, where)
    for key in ("name", "intrinsics", "rotation", "translation"):
        if key not in table:
            raise InputError(f"'{key}' is missing", field=where)
    values = {key: table[key] for key in table if key not in (*LENS, "interface")}
    values |= {"name": str(table["name"]), "lens": _lens(table, where)}
    plane = table.get("background")
    if plane is not None:
        if not isinstance(plane, dict) or set(plane) != {"normal", "offset"}:
            raise InputError(f"background: expected normal = [x, y, z] and offset = mm, got {plane!r}", field=where)
        values["background"] = plane["normal"], plane["offset"]
    planes = table.get("interface", [])
    if not isinstance(planes, list):
        raise InputError(f"interface: expected tables [[camera.interface]], got {planes!r}", field=where)
    values["interfaces"] = tuple(interface_of(p, f"{where}: interface {i + 1}") for i, p in enumerate(planes))
    return check_camera(CalibratedCamera.from_values(where, **values), path)


def _lens(table: dict[str, Any], where: str) -> Lens | None:
    diameter, focus = (float(numbers(table[key], (), f"{where}: {key}")) if key in table else None for key in LENS)
    if diameter is None:
        if focus is not None:
            raise InputError("focus_distance: expected together with aperture_diameter, got it alone", field=where)
        return None
    with within(where):
        return Lens(diameter, focus)
