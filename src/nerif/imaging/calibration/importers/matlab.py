"""MATLAB's calibrations: structs of its Computer Vision Toolbox, Bouguet's toolbox, plain K, R, t.

The toolbox counts pixels from 1. Its structs (cameraParameters and stereoParameters by toStruct) hold

    K                             [fx s cx; 0 fy cy; 0 0 1], since R2022b
    IntrinsicMatrix               its transpose, before
    RotationVectors               (image, 3): x_cam = R x_world + t with R by Rodrigues' formula, as OpenCV's
    TranslationVectors            (image, 3), in WorldUnits
    RadialDistortion              k1 k2, or k1 k2 k3;       TangentialDistortion  p1 p2;       ImageSize  rows, columns
    RotationOfCamera2             of row vectors, x_2 = x_1 R + t: the transpose of OpenCV's; so are RotationMatrices

Bouguet's toolbox counts pixels from 0 and follows OpenCV in everything else.

Source: MathWorks, Computer Vision Toolbox: cameraParameters, stereoParameters and rotvec2mat3d (since R2022b),
cameraMatrix and rotationVectorToMatrix (before).
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import reading
from nerif.common.hdf5 import open_hdf5
from nerif.common.memory import check_memory
from nerif.data.cameras_file import CalibratedCamera, check_distortion, check_model, flat, numbers
from nerif.imaging.calibration.importers.names import UNNAMED

__all__ = ["WORLD_UNITS", "read_matlab"]

EXPORT = "in MATLAB run  s = toStruct(params); save('plain.mat', '-struct', 's')  and give plain.mat"
PIVLAB = ("cam_K_opencv", "cam_selected_target_images", "cam_use_tilted_model")
"""Plain arrays beside the object cameraParams in camera_calibration.mat of PIVlab, without a pose."""
TOOLBOX = ("IntrinsicMatrix", "RadialDistortion", "RotationVectors", "RotationMatrices")
"""Fields that distinguish a struct of the toolbox from plain arrays."""
DISTORTION = ("distortion", "dist", "dist_coeffs", "distCoeffs", "kc", "D")
"""Names of the coefficients beside plain K, R, t."""
STACKED = {"K": 2, "R": 2, "t": 1, "T": 1, **dict.fromkeys(DISTORTION, 1), "image_size": 1}
"""Dimensions of plain arrays of one camera; with one more, the last axis counts cameras."""
WORLD_UNITS = {"millimeters": 1.0, "mm": 1.0, "centimeters": 10.0, "cm": 10.0, "meters": 1e3, "m": 1e3, "inches": 25.4}
WORLD_UNITS |= {"in": 25.4, "micrometers": 1e-3, "um": 1e-3, "feet": 304.8}
"""Units of lengths, mm."""
READABLE = (b"double", b"single", b"cell", b"char", b"struct", b"logical", b"int", b"uint")


def read_matlab(path: Path, pose: int = 1) -> list[CalibratedCamera]:
    """Read the cameras of a .mat file of version 5 or 7.3; target image number `pose` is the world frame."""
    import h5py
    import pymatreader

    with reading("not a readable MATLAB file", path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # unreadable objects are reported below
        if h5py.is_hdf5(path):  # pymatreader opens the file itself, and reads all of it
            with open_hdf5(path) as file:
                file.visititems(lambda name, item: check_memory(getattr(item, "nbytes", 0), path, f"{path}: {name}"))
        content = pymatreader.read_mat(str(path))
    objects = _objects(path, content)
    if "__function_workspace__" in content and not objects:
        objects = ["params"]
    content = {k: v for k, v in content.items() if not k.startswith(("__", "#")) and k not in objects}
    cameras = _cameras(content, path.stem, path, pose)
    if cameras:
        return cameras
    pivlab = any(name in content for name in PIVLAB)
    if pivlab or objects:
        program, name = ("PIVlab's", "cameraParams") if pivlab else ("a MATLAB", objects[0])
        export = EXPORT.replace("params", name)
        raise InputError(f"holds {program} object '{name}', which only MATLAB can read; {export}", field=path)
    raise InputError(
        f"expected fc, cc, kc (Bouguet's toolbox), K or IntrinsicMatrix with RotationVectors "
        f"(cameraParameters by toStruct), or K, R, t, got {', '.join(content) or 'nothing'}",
        field=path,
    )


def _objects(path: Path, content: dict[str, Any]) -> list[str]:
    """Names of the objects in the file that only MATLAB can read."""
    names = [k for k, v in content.items() if type(v).__name__ == "MatlabOpaque"]
    try:
        import scipy.io

        names += [name for name, _, kind in scipy.io.whosmat(str(path)) if kind in ("opaque", "object")]
    except (NotImplementedError, ValueError, TypeError):  # version 7.3, or missing names
        import h5py

        if h5py.is_hdf5(path):
            with open_hdf5(path) as file:
                kinds = {name: bytes(item.attrs.get("MATLAB_class", b"double")) for name, item in file.items()}
            names += [name for name, kind in kinds.items() if not (name.startswith("#") or kind.startswith(READABLE))]
    return sorted({n for n in names if n and n != "None" and not n.startswith("__")})


def _cameras(content: dict[str, Any], name: str, path: Path, pose: int) -> list[CalibratedCamera]:
    """Cameras of the variables of a file or the fields of a struct."""
    if "fc" in content and "cc" in content:
        return [_bouguet(content, path, pose)]
    if "CameraParameters1" in content and "CameraParameters2" in content:
        return _stereo(content, f"{path}: {name}", pose)
    if "MappingCoefficients" in content or "MappingCoefficients" in str(content.get("Intrinsics", "")):
        check_model("fisheyeParameters", f"{path}: {name}")
    if any(field in content for field in TOOLBOX):
        return [_toolbox(content, name, f"{path}: {name}", pose)]
    if "K" in content:
        return _plain_cameras(content, name, path)
    structs = {k: _cameras(v, k, path, pose) for k, v in content.items() if isinstance(v, dict)}
    names = [camera.name for group in structs.values() for camera in group]
    cameras = [
        replace(camera, name=f"{key}_{camera.name}") if names.count(camera.name) > 1 else camera
        for key, group in structs.items()
        for camera in group
    ]
    worlds = [c.name for c in cameras if c.name not in names and not bool(c.translation.any())]
    if len(worlds) > 1:
        raise InputError(
            f"expected cameras in one world frame, got {', '.join(worlds)}, each the origin of its own frame; give "
            "stereoParameters with the poses of target images, the same for all",
            field=path,
        )
    return cameras


def _toolbox(
    content: dict[str, Any], name: str, where: str, pose: int, fixed: tuple[Any, Any] | None = None
) -> CalibratedCamera:
    """One cameraParameters struct; `fixed` is the rotation and translation to use instead of those of its images."""
    k = next((content[key] for key in ("IntrinsicMatrix", "K") if key in content), None)
    if k is None:
        raise InputError(f"expected K or IntrinsicMatrix, got {', '.join(content)}", field=where)
    kinds = ("RadialDistortion", "TangentialDistortion")
    radial, tangential = (flat(content.get(key, []), f"{where}: {key}") for key in kinds)
    if radial.size > 3 or tangential.size > 2:
        raise InputError(
            f"expected at most 3 radial and 2 tangential coefficients, got {radial.size} and {tangential.size}",
            field=where,
        )
    k1, k2, k3 = np.pad(radial, (0, 3 - radial.size))
    p1, p2 = np.pad(tangential, (0, 2 - tangential.size))
    rotation, translation = fixed or _pose(content, where, pose)
    translation = np.asarray(translation, dtype=np.float64) * _mm_per_unit(content, where)
    size = _size(content, "ImageSize")
    camera = CalibratedCamera.from_values(where, name, k, rotation, translation, [k1, k2, p1, p2, k3], size)
    camera.intrinsics[:2, 2] -= 1  # pixels count from 1
    return camera


def _mm_per_unit(content: dict[str, Any], where: str) -> float:
    """WorldUnits in mm, the default of the toolbox."""
    unit = str(content.get("WorldUnits") or "mm").strip().lower()
    if unit not in WORLD_UNITS:
        raise InputError(f"expected one of {', '.join(WORLD_UNITS)}, got '{unit}'", field=f"{where}: WorldUnits")
    return WORLD_UNITS[unit]


def _pose(content: dict[str, Any], where: str, pose: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation, world to camera, of one target image."""
    import cv2

    def rows(key: str, count: int) -> np.ndarray:
        return flat(content.get(key, []), f"{where}: {key}", count)

    translations = rows("TranslationVectors", 3).reshape(-1, 3)
    if "RotationVectors" in content:
        rotations = [cv2.Rodrigues(v)[0] for v in rows("RotationVectors", 3).reshape(-1, 3)]
    else:
        rotations = list(rows("RotationMatrices", 9).reshape(3, 3, -1).transpose(2, 1, 0))
    if not 1 <= pose <= min(len(rotations), len(translations)):
        raise InputError(
            f"expected the pose of image {pose} in RotationVectors and TranslationVectors, got "
            f"{len(rotations)} and {len(translations)} poses",
            field=where,
        )
    return rotations[pose - 1], translations[pose - 1]


def _stereo(content: dict[str, Any], where: str, pose: int) -> list[CalibratedCamera]:
    """A stereoParameters struct; without target images the first camera is the world."""
    first, second = content["CameraParameters1"], content["CameraParameters2"]
    if not (isinstance(first, dict) and isinstance(second, dict)):
        raise InputError(f"expected CameraParameters1 and CameraParameters2 as structs; {EXPORT}", field=where)
    fixed: tuple[Any, Any] = (None, None)
    if not np.size(first.get("RotationVectors", [])):
        if "RotationOfCamera2" not in content or "TranslationOfCamera2" not in content:
            fields = ", ".join(content)
            raise InputError(f"expected RotationOfCamera2 and TranslationOfCamera2, got {fields}", field=where)
        pair = np.asarray(content["RotationOfCamera2"]).T, content["TranslationOfCamera2"]
        fixed = ((np.eye(3), np.zeros(3)), pair)
    return [
        _toolbox(struct, f"cam{i}", f"{where}: camera {i}", pose, fixed[i - 1])
        for i, struct in ((1, first), (2, second))
    ]


def _size(content: dict[str, Any], key: str) -> Any:
    """(rows, columns), where there are any: the toolbox leaves them empty if unknown."""
    return np.ravel(content[key]) if np.size(content.get(key, [])) else None


def _bouguet(content: dict[str, Any], path: Path, pose: int) -> CalibratedCamera:
    """fc, cc, alpha_c, kc, and the pose of one image."""
    # poses of images that were not used are NaN
    poses = sorted(k for k in content if k.startswith("Rc_") and np.isfinite(flat(content[k], f"{path}: {k}")).all())
    if f"Rc_{pose}" not in poses or f"Tc_{pose}" not in content:
        raise InputError(
            f"expected the pose of image {pose} (Rc_{pose}, Tc_{pose}), got {', '.join(poses) or 'no pose'}; "
            "give the number of another --pose, or save the extrinsic parameters in one world frame",
            field=path,
        )
    (fx, fy), (cx, cy) = (numbers(np.ravel(content[k]), (2,), f"{path}: {k}").tolist() for k in ("fc", "cc"))
    skew = float(numbers(np.ravel(content.get("alpha_c", 0.0)), (1,), f"{path}: alpha_c")) * fx
    size = (content["ny"], content["nx"]) if {"nx", "ny"} <= content.keys() else None
    k, kc = [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], content.get("kc")
    return CalibratedCamera.from_values(str(path), path.stem, k, content[f"Rc_{pose}"], content[f"Tc_{pose}"], kc, size)


def _plain_cameras(content: dict[str, Any], name: str, path: Path) -> list[CalibratedCamera]:
    """K, R, t of one camera, or stacked along the last axis for several."""
    rotation = np.asarray(content.get("R", np.zeros((3, 3))))
    if rotation.ndim == 2:
        return [_plain(content, name, path)]
    count = rotation.shape[-1]
    cameras = []
    for i in range(count):
        entries = {}
        for key, value in content.items():
            array = np.asarray(value)
            stacked = key in STACKED and array.ndim == STACKED[key] + 1 and array.shape[-1] == count
            entries[key] = array[..., i] if stacked else value
        cameras.append(_plain(entries, f"{UNNAMED}{i + 1}", path))
    return cameras


def _plain(content: dict[str, Any], name: str, path: Path) -> CalibratedCamera:
    where = f"{path}: {name}"
    translation = content.get("t", content.get("T"))
    if "R" not in content or translation is None:
        raise InputError(f"expected R and t beside K, got {', '.join(content)}", field=where)
    key = next((key for key in DISTORTION if key in content), "")
    check_distortion(content, (key,), DISTORTION, where)
    size = _size(content, "image_size")
    return CalibratedCamera.from_values(where, name, content["K"], content["R"], translation, content.get(key), size)
