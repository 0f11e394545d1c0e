"""Calibrations of any program, by the ending of the file.

Everything ends as CalibratedCamera in the conventions of docs/conventions.md: OpenCV cameras, pixel (0, 0) the centre
of the first pixel, world to camera, mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from nerif.common.conventions import InputError
from nerif.geometry import Box, Lens, Plane
from nerif.geometry.camera import POWERS
from nerif.imaging.calibration.cameras_file import CalibratedCamera, check_names, checked, read_box
from nerif.imaging.calibration.importers.matlab import read_matlab
from nerif.imaging.calibration.importers.nerfstudio import read_transforms
from nerif.imaging.calibration.importers.opencv import ENDINGS as OPENCV
from nerif.imaging.calibration.importers.opencv import read_opencv, read_opencv_folder
from nerif.imaging.calibration.importers.tables import read_csv, read_tables

__all__ = ["ImportSettings", "import_box", "import_cameras", "is_calibration"]

READERS = {".toml": read_tables, ".csv": read_csv, ".json": read_transforms, **dict.fromkeys(OPENCV, read_opencv)}
ENDINGS = (*READERS, ".mat")


@dataclass(frozen=True)
class ImportSettings:
    """What the file of another program does not say."""

    scale_mm: float = 1.0
    """Millimetres in a unit of length of the file that is taken over."""
    pose: int = 1
    """Number of the target image that is the world frame, where a file of MATLAB's keeps a pose for each image."""
    background_distance: float | None = None
    """Where planes are not known: background across the optical axis, this far behind the origin, mm; from target
    images too, and with --simple, of which the origin is on the axis of the flow."""
    image_size: tuple[int, int] | None = None
    """Height and width of the images where the file does not say, px."""
    aperture_diameter: float | None = None
    """Of the entrance pupils (focal length over f-number), mm, through all of which a pixel then sees; 0 for thin rays,
    whatever the file says; of telecentric lenses of the cone where it passes z_cam = 0, which calibration has at the
    origin. From target images too."""
    focus_distance: float | None = None
    """Where the lenses are focused, mm along the optical axis; default: as the file says, or on the background."""
    pose_sigma_mm: float | None = None
    """How far a camera may stand from where its calibration has it, mm (standard deviation; reconstruct --refine goes
    by it); of target images beside their noise, 0.05 by default; 1 with --simple."""
    pose_sigma_deg: float | None = None
    """How far a camera may be turned from how its calibration has it, degrees; of target images 0.005 by default;
    0.5 with --simple."""

    def __post_init__(self) -> None:
        if self.focus_distance is not None and self.aperture_diameter is None:
            raise InputError("expected together with aperture_diameter, got it alone", field="focus_distance")
        _ = self.lens
        for name in ("pose_sigma_mm", "pose_sigma_deg"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < math.inf:
                raise InputError(f"expected a standard deviation of 0 or more, got {value}", field=name)
        if (self.pose_sigma_mm is None) != (self.pose_sigma_deg is None):
            raise InputError("expected both or neither", field="pose_sigma_mm, pose_sigma_deg")
        if not self.scale_mm > 0:
            raise InputError(f"expected a positive number, got {self.scale_mm}", field="scale_mm")

    @property
    def pose_sigma(self) -> tuple[float, float] | None:
        """The standard deviations of where cameras stand and how they are turned, mm and degrees; None if not said."""
        if self.pose_sigma_mm is None or self.pose_sigma_deg is None:
            return None
        return self.pose_sigma_mm, self.pose_sigma_deg

    @property
    def lens(self) -> Lens | None:
        """The lens that is given, of every camera; None for none, or thin rays."""
        lens = Lens(self.aperture_diameter or 0.0, self.focus_distance)
        return lens if lens.diameter else None


def is_calibration(path: Path) -> bool:
    """Tell a calibration, in a file or a folder of OpenCV files, from a folder with the images of an experiment."""
    if not path.is_dir():
        return True
    entries = list(path.iterdir())
    images = any(entry.is_dir() or entry.name == "views.toml" for entry in entries)
    return not images and any(entry.suffix in OPENCV for entry in entries)


def import_cameras(
    path: Path, settings: ImportSettings = ImportSettings(), only: Sequence[str] = ()
) -> tuple[CalibratedCamera, ...]:
    """Read the cameras of a file, or of a folder with one OpenCV file a camera.

    Parameters
    ----------
    path : .toml, .csv, .yml, .yaml, .xml (OpenCV), .json (NeRF), .mat (MATLAB)
    settings : what the file does not say
    only : names of the cameras wanted; all if empty

    Raises
    ------
    InputError
        If it cannot be read, two cameras have one name, or `only` names a camera that is not there; names the file,
        what was expected and what came.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"no such file; expected a calibration ({' '.join(ENDINGS)})", field=path)
    if path.is_dir():
        cameras = read_opencv_folder(path)
    elif path.suffix == ".mat":
        cameras = read_matlab(path, settings.pose)
    elif path.suffix in READERS:
        cameras = READERS[path.suffix](path)
    else:
        raise InputError(f"expected a calibration ending in {' '.join(ENDINGS)}, got '{path.suffix}'", field=path)
    if not cameras:
        raise InputError("holds no camera", field=path)
    check_names(cameras, str(path))
    for name in only:
        if name not in [c.name for c in cameras]:
            raise InputError(f"expected some of {', '.join(c.name for c in cameras)}, got '{name}'", field="views")
    return tuple(checked(_completed(c, settings), str(path)) for c in cameras if not only or c.name in only)


def import_box(path: Path, settings: ImportSettings = ImportSettings()) -> Box | None:
    """Read the box of a calibration, mm; None if it holds none.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    box = read_box(path) if Path(path).suffix == ".toml" else None
    if box is None or settings.scale_mm == 1:
        return box
    (a, b, c), (d, e, f) = (torch.tensor([box.lower, box.upper], dtype=torch.float64) * settings.scale_mm).tolist()
    return Box((a, b, c), (d, e, f))


def _lens(lens: Lens | None, settings: ImportSettings) -> Lens | None:
    """The lens of a file in mm; what is given wins, the rest stays."""
    given, scale = settings.lens, settings.scale_mm
    if lens is None or settings.aperture_diameter == 0:
        return given
    own = replace(lens, diameter=scale * lens.diameter, focus=None if lens.focus is None else scale * lens.focus)
    if given is None:
        return own
    return replace(own, diameter=given.diameter, focus=own.focus if given.focus is None else given.focus)


def _completed(camera: CalibratedCamera, settings: ImportSettings) -> CalibratedCamera:
    """The camera in mm, with what the file does not say."""
    plane, scale = camera.background, settings.scale_mm
    if plane is not None:
        plane = Plane(plane.normal, scale * plane.offset)
    elif settings.background_distance is not None:
        plane = Plane(-camera.rotation[2], -settings.background_distance)  # its normal points to the camera
    intrinsics, distortion = camera.intrinsics.clone(), camera.distortion
    if not camera.projection.shows_depth:  # (x, y) are lengths of the file's unit
        intrinsics[:2, :2] /= scale
        distortion = distortion / scale ** torch.tensor(POWERS)
    sigma = camera.pose_sigma
    if sigma is not None:
        sigma = torch.cat([sigma[:3], scale * sigma[3:]])
    if settings.pose_sigma is not None:
        shift, turn = settings.pose_sigma
        sigma = torch.tensor([math.radians(turn)] * 3 + [shift] * 3, dtype=torch.float64)
    return replace(
        camera,
        intrinsics=intrinsics,
        distortion=distortion,
        translation=scale * camera.translation,
        image_size=camera.image_size or settings.image_size,
        background=plane,
        lens=_lens(camera.lens, settings),
        pose_sigma=sigma,
    )
