"""MATLAB calibrations: Bouguet's toolbox, cameraParameters exported as plain arrays, plain K, R, t.

MATLAB's own toolbox counts pixels from 1 and multiplies row vectors, so its matrices are transposed; Bouguet's counts
from 0 and is OpenCV's in everything else.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerif.conventions import InputError
from nerif.imaging.cameras_file import CalibratedCamera, five, numbers, upright

__all__ = ["read_matlab"]

EXPORT = "in MATLAB run  s = toStruct(params); save('plain.mat', '-struct', 's')  and give plain.mat"


def read_matlab(path: Path, pose: int = 1) -> list[CalibratedCamera]:
    """Read the cameras of a .mat file of version 5 or 7.3; `pose` is the target picture that is the world.

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
        raise InputError(f"{path}: not a readable MATLAB file ({reason})") from None
    content = {k: v for k, v in content.items() if not k.startswith("__") or k == "__function_workspace__"}
    objects = _opaque(path, content)
    content = {k: v for k, v in content.items() if not k.startswith(("__", "#")) and k not in objects}
    if "fc" in content and "cc" in content:
        return [_bouguet(content, path, pose)]
    if "IntrinsicMatrix" in content or ("K" in content and "RotationMatrices" in content):
        return [_parameters(content, path.stem, path, pose)]
    structs = {k: v for k, v in content.items() if isinstance(v, dict) and ("IntrinsicMatrix" in v or "K" in v)}
    if structs:
        return [_parameters(v, k, path, pose) if _has_poses(v) else _plain(v, k, path) for k, v in structs.items()]
    if {"K", "R", "t"} <= set(content) or {"K", "R", "T"} <= set(content):
        return _stacked(content, path)
    if objects or "__function_workspace__" in content:
        name = objects[0] if objects else "params"
        raise InputError(f"{path}: holds a MATLAB object '{name}', which only MATLAB can read; {EXPORT}")
    raise InputError(
        f"{path}: expected fc, cc, kc (Bouguet's toolbox), IntrinsicMatrix and RotationMatrices (cameraParameters), or "
        f"K, R, t, got {', '.join(content) or 'nothing'}"
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


def _bouguet(content: dict[str, Any], path: Path, pose: int) -> CalibratedCamera:
    """fc, cc, alpha_c, kc, and the pose of one picture."""
    rotation, translation = content.get(f"Rc_{pose}"), content.get(f"Tc_{pose}")
    if rotation is None or translation is None or not np.all(np.isfinite(rotation)):
        there = sorted(k for k in content if k.startswith("Rc_"))
        raise InputError(
            f"{path}: expected the pose of picture {pose} (Rc_{pose}, Tc_{pose}), got {', '.join(there) or 'no pose'}; "
            "save the extrinsic parameters in one world frame"
        )
    fc, cc = (numbers(np.ravel(content[k]).tolist(), (2,), f"{path}: {k}") for k in ("fc", "cc"))
    skew = float(np.ravel(content.get("alpha_c", 0.0))[0]) * float(fc[0])
    k = torch.tensor([[fc[0], skew, cc[0]], [0, fc[1], cc[1]], [0, 0, 1]], dtype=torch.float64)
    size = (int(content["ny"]), int(content["nx"])) if "nx" in content and "ny" in content else None
    return CalibratedCamera(
        name=path.stem,
        intrinsics=k,
        rotation=numbers(np.asarray(rotation).tolist(), (3, 3), f"{path}: Rc_{pose}"),
        translation=numbers(np.ravel(translation).tolist(), (3,), f"{path}: Tc_{pose}"),
        distortion=five(content.get("kc", []), f"{path}: kc"),
        image_size=size,
    )


def _has_poses(content: dict[str, Any]) -> bool:
    return "RotationMatrices" in content or "IntrinsicMatrix" in content


def _parameters(content: dict[str, Any], name: str, path: Path, pose: int) -> CalibratedCamera:
    """cameraParameters as a struct: row vectors and pixels from 1."""
    where = f"{path}: {name}"
    given = content["IntrinsicMatrix"] if "IntrinsicMatrix" in content else content["K"]
    k = upright(np.asarray(given).tolist(), f"{where}: IntrinsicMatrix").clone()
    k[:2, 2] -= 1
    rotations = np.asarray(content.get("RotationMatrices", np.zeros((3, 3, 0))), dtype=np.float64)
    translations = np.asarray(content.get("TranslationVectors", np.zeros((0, 3))), dtype=np.float64).reshape(-1, 3)
    rotations = rotations.reshape(3, 3, -1)
    if not 1 <= pose <= rotations.shape[2] or len(translations) < pose:
        raise InputError(
            f"{where}: expected the pose of picture {pose} in RotationMatrices and TranslationVectors, got "
            f"{rotations.shape[2]} and {len(translations)} poses"
        )
    radial = np.ravel(content.get("RadialDistortion", [0.0, 0.0]))
    tangential = np.ravel(content.get("TangentialDistortion", [0.0, 0.0]))
    radial = np.concatenate([radial, np.zeros(3 - len(radial))])
    size = np.ravel(content["ImageSize"]) if np.size(content.get("ImageSize", [])) == 2 else None
    return CalibratedCamera(
        name=name,
        intrinsics=k,
        rotation=torch.from_numpy(rotations[:, :, pose - 1].T.copy()),
        translation=torch.from_numpy(translations[pose - 1].copy()),
        distortion=five([radial[0], radial[1], tangential[0], tangential[1], radial[2]], where),
        image_size=None if size is None else (int(size[0]), int(size[1])),
    )


def _plain(content: dict[str, Any], name: str, path: Path) -> CalibratedCamera:
    """K, R, t as they are."""
    where = f"{path}: {name}"
    translation = content.get("t", content.get("T"))
    if "R" not in content or translation is None:
        raise InputError(f"{where}: expected R and t beside K, got {', '.join(content)}")
    size = np.ravel(content["image_size"]) if np.size(content.get("image_size", [])) == 2 else None
    return CalibratedCamera(
        name=name,
        intrinsics=upright(np.asarray(content["K"]).tolist(), f"{where}: K"),
        rotation=numbers(np.asarray(content["R"]).tolist(), (3, 3), f"{where}: R"),
        translation=numbers(np.ravel(translation).tolist(), (3,), f"{where}: t"),
        distortion=five(content.get("distortion", content.get("D", [])), f"{where}: distortion"),
        image_size=None if size is None else (int(size[0]), int(size[1])),
    )


def _stacked(content: dict[str, Any], path: Path) -> list[CalibratedCamera]:
    """Plain arrays of one camera, or stacked along the last axis for several."""
    rotation = np.asarray(content["R"])
    if rotation.ndim == 2:
        return [_plain(content, path.stem, path)]
    count = rotation.shape[-1]
    single = {"K": 2, "R": 2, "t": 1, "T": 1, "distortion": 1, "D": 1, "image_size": 1}
    cameras = []
    for i in range(count):
        own = {}
        for key, value in content.items():
            array = np.asarray(value)
            stacked = key in single and array.ndim == single[key] + 1 and array.shape[-1] == count
            own[key] = array[..., i] if stacked else value
        cameras.append(_plain(own, f"cam{i + 1}", path))
    return cameras
