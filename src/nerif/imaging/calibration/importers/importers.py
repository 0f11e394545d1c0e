"""Calibrations of any program, by the ending of the file.

All are converted to CalibratedCamera in the conventions of docs/conventions.md: OpenCV's camera axes, pixel (0, 0) the
centre of the first pixel, world to camera, mm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from nerif.common.conventions import InputError
from nerif.common.files import check_file, check_known, ending, read_toml
from nerif.data.cameras_file import CalibratedCamera, check_camera, check_names, interface_of, read_box
from nerif.data.kinds import ARRAYS, CALIBRATION, IMAGES, VECTORS, reading_as
from nerif.geometry import Box, Interface, Lens, Plane
from nerif.geometry.distortion import POWERS
from nerif.imaging.calibration.calibration_settings import ImportSettings
from nerif.imaging.calibration.importers.colmap import COLMAP, read_colmap
from nerif.imaging.calibration.importers.geometry_files import read_geometry
from nerif.imaging.calibration.importers.matlab import read_matlab
from nerif.imaging.calibration.importers.nerfstudio import read_transforms
from nerif.imaging.calibration.importers.openptv import ORI, read_openptv
from nerif.imaging.calibration.importers.tables import holds_points, read_csv, read_tables
from nerif.imaging.calibration.importers.yaml_files import ENDINGS as YAML
from nerif.imaging.calibration.importers.yaml_files import read_yaml_files
from nerif.imaging.readers.views import VIEWS

__all__ = ["box_to_reconstruct", "import_box", "import_cameras", "is_calibration", "read_interfaces"]

STANDARD = ImportSettings()
READERS = {".toml": read_tables, ".json": read_transforms}
ENDINGS = (".toml", ".csv", ".json", *YAML, ".mat", ".npz", ORI)


def is_calibration(path: Path) -> bool:
    """Distinguish a calibration, a file or a folder of such files, from a folder with images of an experiment."""
    if not path.is_dir():
        return True
    entries = list(path.iterdir())
    images = any(entry.is_dir() or entry.name.lower() == VIEWS for entry in entries)
    return not images and any(ending(entry) in (*YAML, ORI) or entry.name in COLMAP for entry in entries)


def import_cameras(
    path: Path,
    settings: ImportSettings = STANDARD,
    only: Sequence[str] = (),
    say: Callable[[str], None] = lambda line: None,
) -> tuple[CalibratedCamera, ...]:  # fmt: skip
    """Read the cameras of a file, or of a folder with one file per camera or with COLMAP's; errors name the file.

    Parameters
    ----------
    path : .toml; .csv (a row a camera, points of the world and the image, DLT coefficients); .yml, .yaml, .xml
        (OpenCV, ROS, kalibr, DaVis); .json (NeRF); .mat (MATLAB); .npz (ASTRA, TIGRE); .ori (OpenPTV); cameras.txt
        (COLMAP)
    only : names of the cameras to read; all if empty
    say : receives files read together, residuals of fitted cameras, and notes
    """
    path = Path(path)
    like = (ARRAYS, IMAGES, VECTORS) if holds_points(path) else (ARRAYS, IMAGES)  # kinds with the same endings or heads
    with reading_as(path, CALIBRATION, ignore=like):
        cameras, unit = _read(path, settings, say)
    if not cameras:
        raise InputError("holds no camera", field=path)
    check_names(cameras, str(path))
    names = [c.name for c in cameras]
    check_known(only, names, "views", "camera", f" of {', '.join(names)}")
    settings = replace(settings, scale_mm=settings.scale_mm or unit)
    interfaces = read_interfaces(settings.interfaces, names)
    completed = (_completed(c, settings) for c in cameras if not only or c.name in only)
    return tuple(
        check_camera(replace(c, interfaces=interfaces.get(c.name, c.interfaces)), str(path)) for c in completed
    )


def read_interfaces(path: Path | None, names: Sequence[str]) -> dict[str, tuple[Interface, ...]]:
    """Return the interfaces of cameras by name, in order from the camera."""
    result: dict[str, tuple[Interface, ...]] = {}
    if path is None:
        return result
    tables = read_toml(path, "file; expected tables [[interface]]").get("interface")
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise InputError("expected at least one table [[interface]], got none", field=path)
    for i, table in enumerate(tables):
        where, views = f"{path}: interface {i + 1}", table.get("views", list(names))
        if not isinstance(views, list):
            raise InputError(f"views: expected names of cameras in brackets, got {views!r}", field=where)
        check_known(map(str, views), names, f"{where}: views", "camera")
        plane = interface_of({key: value for key, value in table.items() if key != "views"}, where)
        for name in map(str, views):
            result[name] = (*result.get(name, ()), plane)
    return result


def _read(path: Path, settings: ImportSettings, say: Callable[[str], None]) -> tuple[Sequence[CalibratedCamera], float]:
    """Return the cameras of a file, and the unit of length by its format, mm."""
    if not path.is_dir():
        check_file(path, f"file; expected a calibration ({' '.join(ENDINGS)})")
    entries = {entry.name for entry in path.iterdir()} if path.is_dir() else {path.name}
    if entries & {*COLMAP}:
        if settings.scale_mm is None:
            say("note: COLMAP's unit of length is arbitrary; give the true one with --scale-mm")
        return read_colmap(path), 1.0
    if any(name.lower().endswith(ORI) for name in entries):
        return read_openptv(path), 1.0
    if path.is_dir() or ending(path) in YAML:
        return read_yaml_files(path, say)
    if ending(path) == ".csv":
        return read_csv(path, settings, say)
    readers = {".mat": lambda p: read_matlab(p, settings.pose), ".npz": lambda p: read_geometry(p, say), **READERS}
    if ending(path) in readers:
        return readers[ending(path)](path), 1.0
    raise InputError(
        f"expected a calibration ending in {' '.join(ENDINGS)}, or COLMAP's cameras.txt, got '{path.name}'", field=path
    )


def import_box(path: Path, settings: ImportSettings = STANDARD) -> Box | None:
    """Read the box of a calibration, mm; None if it has none."""
    box = read_box(path) if ending(path) == ".toml" else None
    if box is None or settings.scale_mm is None:
        return box
    (a, b, c), (d, e, f) = (torch.tensor([box.lower, box.upper], dtype=torch.float64) * settings.scale_mm).tolist()
    return Box((a, b, c), (d, e, f))


def box_to_reconstruct(box: Box | None, calibration: Path) -> Box:
    """Return the given box, else that of the calibration; InputError if there is neither."""
    box = box or import_box(calibration)
    if box is None:
        raise InputError(
            f"expected the corners of the box to reconstruct, since {calibration} has none; give --lower X Y Z and "
            "--upper X Y Z, mm",
            field="lower, upper",
        )
    return box


def _lens(lens: Lens | None, settings: ImportSettings) -> Lens | None:
    """Lens of a file in mm, overridden by the settings."""
    override, scale = settings.lens, settings.scale_mm or 1.0
    if lens is None or settings.aperture_diameter == 0:
        return override
    scaled = replace(lens, diameter=scale * lens.diameter, focus=None if lens.focus is None else scale * lens.focus)
    if override is None:
        return scaled
    return replace(scaled, diameter=override.diameter, focus=override.focus or scaled.focus)


def _completed(camera: CalibratedCamera, settings: ImportSettings) -> CalibratedCamera:
    """The camera in mm, completed from the settings."""
    plane, scale = camera.background, settings.scale_mm or 1.0
    if plane is not None:
        plane = Plane(plane.normal, scale * plane.offset)
    elif settings.background_distance is not None:
        plane = Plane(-camera.rotation[2], -settings.background_distance)  # its normal points to the camera
    intrinsics, distortion = camera.intrinsics.clone(), camera.distortion
    if not camera.projection.shows_depth:  # (x, y) are lengths in the unit of the file
        intrinsics[:2, :2] /= scale
        distortion = distortion / scale ** torch.tensor(POWERS)
    planes = tuple(replace(p, offset=scale * p.offset) for p in camera.interfaces)
    sigma = camera.pose_sigma
    if sigma is not None:
        sigma = torch.cat([sigma[:3], scale * sigma[3:]])
    if settings.pose_sigma is not None:
        shift, turn = settings.pose_sigma
        sigma = torch.tensor([math.radians(turn)] * 3 + [shift] * 3, dtype=torch.float64)
    return replace(
        camera, intrinsics=intrinsics, distortion=distortion, translation=scale * camera.translation,
        image_size=camera.image_size or settings.image_size, background=plane, lens=_lens(camera.lens, settings),
        pose_sigma=sigma, interfaces=planes,
    )  # fmt: skip
