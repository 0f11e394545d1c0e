"""MATLAB's calibrations: structs of its Computer Vision Toolbox, Bouguet's toolbox, plain K, R, t.

The toolbox counts pixels from 1. Its structs (cameraParameters and stereoParameters by toStruct) hold

    K                             [fx s cx; 0 fy cy; 0 0 1], since R2022b
    IntrinsicMatrix               its transpose, before
    RotationVectors               (image, 3): x_cam = R x_world + t with R by Rodrigues' formula, as OpenCV's
    TranslationVectors            (image, 3), in WorldUnits
    RadialDistortion              k1 k2, or k1 k2 k3;       TangentialDistortion  p1 p2;       ImageSize  rows, columns
    RotationOfCamera2             of row vectors, x_2 = x_1 R + t: the transpose of OpenCV's; so are RotationMatrices

Bouguet's toolbox counts from 0 and is OpenCV's in everything else.

Source: MathWorks, Computer Vision Toolbox: cameraParameters, stereoParameters and rotvec2mat3d (since R2022b),
cameraMatrix and rotationVectorToMatrix (before).
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerif.common.conventions import InputError
from nerif.imaging.calibration.cameras_file import (
    CalibratedCamera,
    check_distortion,
    check_model,
    five,
    flat,
    image_size,
    numbers,
    upright,
)

__all__ = ["read_matlab"]

EXPORT = "in MATLAB run  s = toStruct(params); save('plain.mat', '-struct', 's')  and give plain.mat"
TOOLBOX = ("IntrinsicMatrix", "RadialDistortion", "RotationVectors", "RotationMatrices")
"""Fields that tell a struct of the toolbox from plain arrays."""
DISTORTION = ("distortion", "dist", "dist_coeffs", "distCoeffs", "kc", "D")
"""What the coefficients beside plain K, R, t may be called."""


def read_matlab(path: Path, pose: int = 1) -> list[CalibratedCamera]:
    """Read the cameras of a .mat file of version 5 or 7.3; `pose` is the target image that is the world.

    Raises
    ------
    InputError
        If it cannot be read, holds an object that only MATLAB can read, or nothing known.
    """
    import pymatreader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what it cannot read is told below
            content = pymatreader.read_mat(str(path))
    except Exception as error:  # of SciPy and h5py, of many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"not a readable MATLAB file ({reason})", field=path) from None
    objects = _opaque(path, content)
    if "__function_workspace__" in content and not objects:
        objects = ["params"]
    content = {k: v for k, v in content.items() if not k.startswith(("__", "#")) and k not in objects}
    cameras = _cameras(content, path.stem, path, pose)
    if cameras:
        return cameras
    if objects:
        raise InputError(f"holds a MATLAB object '{objects[0]}', which only MATLAB can read; {EXPORT}", field=path)
    raise InputError(
        f"expected fc, cc, kc (Bouguet's toolbox), K or IntrinsicMatrix with RotationVectors "
        f"(cameraParameters by toStruct), or K, R, t, got {', '.join(content) or 'nothing'}",
        field=path,
    )


def _opaque(path: Path, content: dict[str, Any]) -> list[str]:
    """Names of objects in the file whose insides a reader does not see."""
    found = [k for k, v in content.items() if type(v).__name__ == "MatlabOpaque"]
    try:
        import scipy.io

        for name, _, kind in scipy.io.whosmat(str(path)):
            if kind in ("opaque", "object"):
                found.append(name)
    except (NotImplementedError, ValueError, TypeError):  # version 7.3, or names that are not there
        import h5py

        if h5py.is_hdf5(path):
            with h5py.File(path) as file:
                known = (b"double", b"single", b"cell", b"char", b"struct", b"logical", b"int", b"uint")
                for name, item in file.items():
                    kind = item.attrs.get("MATLAB_class", b"double")
                    if not name.startswith("#") and not bytes(kind).startswith(known):
                        found.append(name)
    return sorted({n for n in found if n and n != "None" and not n.startswith("__")})


def _cameras(content: dict[str, Any], name: str, path: Path, pose: int) -> list[CalibratedCamera]:
    """All cameras of the variables of a file or the fields of a struct."""
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
    names = [camera.name for own in structs.values() for camera in own]
    cameras = [
        replace(camera, name=f"{key}_{camera.name}") if names.count(camera.name) > 1 else camera
        for key, own in structs.items()
        for camera in own
    ]
    worlds = [c.name for c in cameras if c.name not in names and not bool(c.translation.any())]
    if len(worlds) > 1:
        raise InputError(
            f"expected cameras in one world frame, got {', '.join(worlds)}, each the origin of its own; give "
            "stereoParameters with the poses of target images, the same for all",
            field=path,
        )
    return cameras


# -- MATLAB's own toolbox ------------------------------------------------------------------------------------------


def _toolbox(
    content: dict[str, Any], name: str, where: str, pose: int, known: tuple[np.ndarray, np.ndarray] | None = None
) -> CalibratedCamera:
    """cameraParameters as a struct; `known` is its rotation and translation where those of the images don't count."""
    given = next((content[k] for k in ("IntrinsicMatrix", "K") if k in content), None)
    if given is None:
        raise InputError(f"expected K or IntrinsicMatrix, got {', '.join(content)}", field=where)
    k = upright(np.asarray(given).tolist(), f"{where}: intrinsics").clone()
    k[:2, 2] -= 1
    rotation, translation = known or _pose(content, where, pose)
    radial, tangential = (
        flat(content.get(f"{kind}Distortion", []), f"{where}: {kind}Distortion") for kind in ("Radial", "Tangential")
    )
    if radial.size > 3 or tangential.size > 2:
        raise InputError(
            f"expected at most 3 radial and 2 tangential coefficients, got {radial.size} and {tangential.size}",
            field=where,
        )
    k1, k2, k3 = np.concatenate([radial, np.zeros(3)])[:3]
    p1, p2 = np.concatenate([tangential, np.zeros(2)])[:2]
    return CalibratedCamera(
        name=name,
        intrinsics=k,
        rotation=numbers(rotation.tolist(), (3, 3), f"{where}: rotation"),
        translation=numbers(translation.tolist(), (3,), f"{where}: translation"),
        distortion=five([k1, k2, p1, p2, k3], where),
        image_size=_size(content, "ImageSize", where),
    )


def _pose(content: dict[str, Any], where: str, pose: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation, world to camera, of one target image."""
    import cv2

    def each(key: str, count: int) -> np.ndarray:
        return flat(content.get(key, []), f"{where}: {key}", count)

    translations = each("TranslationVectors", 3).reshape(-1, 3)
    if "RotationVectors" in content:
        rotations = [cv2.Rodrigues(v)[0] for v in each("RotationVectors", 3).reshape(-1, 3)]
    else:
        rotations = list(each("RotationMatrices", 9).reshape(3, 3, -1).transpose(2, 1, 0))
    if not 1 <= pose <= min(len(rotations), len(translations)):
        raise InputError(
            f"expected the pose of image {pose} in RotationVectors and TranslationVectors, got "
            f"{len(rotations)} and {len(translations)} poses",
            field=where,
        )
    return rotations[pose - 1], translations[pose - 1]


def _stereo(content: dict[str, Any], where: str, pose: int) -> list[CalibratedCamera]:
    """stereoParameters as a struct; without target images the first camera is the world."""
    first, second = content["CameraParameters1"], content["CameraParameters2"]
    if not (isinstance(first, dict) and isinstance(second, dict)):
        raise InputError(f"expected CameraParameters1 and CameraParameters2 as structs; {EXPORT}", field=where)
    if np.size(first.get("RotationVectors", [])):
        return [_toolbox(own, f"cam{i}", f"{where}: camera {i}", pose) for i, own in ((1, first), (2, second))]
    if "RotationOfCamera2" not in content or "TranslationOfCamera2" not in content:
        raise InputError(f"expected RotationOfCamera2 and TranslationOfCamera2, got {', '.join(content)}", field=where)
    turn, shift = np.asarray(content["RotationOfCamera2"]).T, np.ravel(content["TranslationOfCamera2"])
    return [
        _toolbox(first, "cam1", f"{where}: camera 1", pose, (np.eye(3), np.zeros(3))),
        _toolbox(second, "cam2", f"{where}: camera 2", pose, (turn, shift)),
    ]


def _size(content: dict[str, Any], key: str, where: str) -> tuple[int, int] | None:
    """(rows, columns), where they are told; the toolbox leaves them empty where they are not."""
    return image_size(np.ravel(content[key]).tolist(), f"{where}: {key}") if np.size(content.get(key, [])) else None


# -- Bouguet's, and plain arrays -----------------------------------------------------------------------------------


def _bouguet(content: dict[str, Any], path: Path, pose: int) -> CalibratedCamera:
    """fc, cc, alpha_c, kc, and the pose of one image."""
    rotation, translation = content.get(f"Rc_{pose}"), content.get(f"Tc_{pose}")
    # of an image that was not used they are NaN
    there = sorted(k for k in content if k.startswith("Rc_") and np.isfinite(flat(content[k], f"{path}: {k}")).all())
    if f"Rc_{pose}" not in there or translation is None:
        raise InputError(
            f"expected the pose of image {pose} (Rc_{pose}, Tc_{pose}), got {', '.join(there) or 'no pose'}; "
            "give the number of another --pose, or save the extrinsic parameters in one world frame",
            field=path,
        )
    fc, cc = (numbers(np.ravel(content[k]).tolist(), (2,), f"{path}: {k}") for k in ("fc", "cc"))
    size = image_size([content["ny"], content["nx"]], f"{path}: ny, nx") if {"nx", "ny"} <= set(content) else None
    skew = float(numbers(np.ravel(content.get("alpha_c", 0.0)).tolist(), (1,), f"{path}: alpha_c") * fc[0])
    return CalibratedCamera(
        name=path.stem,
        intrinsics=torch.tensor([[fc[0], skew, cc[0]], [0, fc[1], cc[1]], [0, 0, 1]], dtype=torch.float64),
        rotation=numbers(np.asarray(rotation).tolist(), (3, 3), f"{path}: Rc_{pose}"),
        translation=numbers(np.ravel(translation).tolist(), (3,), f"{path}: Tc_{pose}"),
        distortion=five(content.get("kc", []), f"{path}: kc"),
        image_size=size,
    )


def _plain_cameras(content: dict[str, Any], name: str, path: Path) -> list[CalibratedCamera]:
    """K, R, t of one camera, or stacked along the last axis for several."""
    rotation = np.asarray(content.get("R", np.zeros((3, 3))))
    if rotation.ndim == 2:
        return [_plain(content, name, path)]
    count = rotation.shape[-1]
    single = {"K": 2, "R": 2, "t": 1, "T": 1, **dict.fromkeys(DISTORTION, 1), "image_size": 1}
    cameras = []
    for i in range(count):
        own = {}
        for key, value in content.items():
            array = np.asarray(value)
            stacked = key in single and array.ndim == single[key] + 1 and array.shape[-1] == count
            own[key] = array[..., i] if stacked else value
        cameras.append(_plain(own, f"cam{i + 1}", path))
    return cameras


def _plain(content: dict[str, Any], name: str, path: Path) -> CalibratedCamera:
    """K, R, t as they are."""
    where = f"{path}: {name}"
    translation = content.get("t", content.get("T"))
    if "R" not in content or translation is None:
        raise InputError(f"expected R and t beside K, got {', '.join(content)}", field=where)
    known = next((key for key in DISTORTION if key in content), "")
    check_distortion(content, (known,), DISTORTION, where)
    return CalibratedCamera(
        name=name,
        intrinsics=upright(np.asarray(content["K"]).tolist(), f"{where}: K"),
        rotation=numbers(np.asarray(content["R"]).tolist(), (3, 3), f"{where}: R"),
        translation=numbers(np.ravel(translation).tolist(), (3,), f"{where}: t"),
        distortion=five(content.get(known, []), f"{where}: {known or 'distortion'}"),
        image_size=_size(content, "image_size", where),
    )
