"""nerif calibrate: from target pictures, or from another program's file, to calibrated cameras."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from nerif.commands.output import check_file, say
from nerif.commands.settings import Settings, read_settings
from nerif.conventions import InputError
from nerif.geometry import Box, Camera, Plane
from nerif.imaging.cameras_file import CalibratedCamera, write_cameras
from nerif.imaging.targets import Target
from nerif.measurement import Measurement

if TYPE_CHECKING:
    from nerif.imaging.calibration import Calibration

__all__ = ["Calibrate", "main", "run"]


@dataclass(frozen=True)
class Calibrate(Settings):
    """Calibrate cameras from target pictures, or take over a calibration; both draw the rig in 3-D.

    SOURCE is a folder with a folder for each view (VIEW/target/*.tif: the target free in space, one pose under one
    number in all views; VIEW/background/*.tif: the target laid on the view's background), or with a views.toml; or the
    calibration of another program (.mat, .yml, .xml, transforms.json, .csv, .toml). With --check only the rig is drawn.
    """

    source: tyro.conf.Positional[Path]
    """Folder of pictures, or a file with a calibration, or (with --check) a measurement."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("calibration.toml")
    """Calibration to write, NAME.toml; NAME.rig.png and NAME.errors.png come with it."""
    check: bool = False
    """Only draw cameras, box and background planes of SOURCE to NAME.rig.png: mirrored axes show there."""
    target: Target = field(default_factory=Target)
    background_scale: float = 1.0
    """The target laid on the backgrounds is the same one printed this many times larger."""
    views: tuple[str, ...] = ()
    """Only these views."""
    distortion: tuple[str, ...] = ("k1", "k2", "p1", "p2")
    """Coefficients to find, out of k1 k2 p1 p2 k3."""
    world: str = ""
    """Number of the target pose that is the world frame; the one that most cameras see if not given."""
    axes: tuple[str, str, str] = ("x+", "z+", "y-")
    """World x, y, z along axes of the target there (x right, y down, z into the page): z is up by default."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Middle of the target there, in world coordinates, mm."""
    max_error: float = 1.0
    """Largest rms reprojection error to accept, px."""
    scale_mm: float = 1.0
    """Millimetres in a unit of length of the file that is taken over."""
    background_distance: float | None = None
    """Where planes are not known: background across the optical axis, this far behind the origin, mm."""
    image_size: tuple[int, int] | None = None
    """Height and width of the pictures where the file does not say, px."""
    lower: tuple[float, float, float] | None = None
    """Lower corner of the box to draw, mm."""
    upper: tuple[float, float, float] | None = None
    """Upper corner of the box to draw, mm."""
    force: bool = False
    """Overwrite existing files."""


def run(settings: Calibrate) -> None:
    """Write the calibration and its pictures."""
    if settings.out.suffix != ".toml":
        raise InputError(f"out: expected a name ending in .toml, got '{settings.out.name}'")
    box = _box(settings)
    rig = settings.out.with_suffix(".rig.png")
    if settings.check:
        check_file(rig, settings.force)
        cameras, found = _existing(settings)
        _draw(rig, cameras, box or found)
        return
    errors = settings.out.with_suffix(".errors.png")
    if settings.source.is_dir() and _has_pictures(settings.source):
        check_file(settings.out, settings.force, rig, errors)
        calibration = _calibrate(settings)
        cameras = _cameras(calibration)
        write_cameras(settings.out, cameras, _about(calibration))
        _tell(calibration)
        from nerif.report.calibration_figure import save_errors

        save_errors(errors, calibration)
        say(f"{settings.out}: {len(cameras)} cameras; {errors}: reprojection errors")
    else:
        check_file(settings.out, settings.force, rig)
        cameras = _imported(settings)
        write_cameras(settings.out, cameras, {"source": str(settings.source)})
        say(f"{settings.out}: {len(cameras)} cameras taken over from {settings.source}")
    _draw(rig, cameras, box)


def _box(settings: Calibrate) -> Box | None:
    if (settings.lower is None) != (settings.upper is None):
        raise InputError("lower, upper: expected both corners of the box or neither")
    return None if settings.lower is None or settings.upper is None else Box(settings.lower, settings.upper)


def _has_pictures(folder: Path) -> bool:
    from nerif.imaging.views import find_views

    try:
        return bool(find_views(folder))
    except InputError as error:
        if "no view found" not in str(error):
            raise
        if not any(p.suffix in (".yml", ".yaml", ".xml") for p in folder.iterdir()):
            raise
        return False


def _calibrate(settings: Calibrate) -> Calibration:
    from rich.console import Console
    from rich.progress import Progress

    from nerif.imaging.calibration import CalibrationSettings, calibrate
    from nerif.imaging.views import find_targets, find_views

    chosen = CalibrationSettings(
        settings.distortion, settings.world, settings.axes, settings.origin, settings.max_error
    )
    laid = settings.target.scaled(settings.background_scale)
    views = find_views(settings.source, settings.views)
    for view in views:
        view.open("target")  # what is missing is said before the long work
    pictures = sum(len(view.open(s)) for view in views for s in ("target", "background") if s in view.sources)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("looking for targets", total=pictures)
        found = [find_targets(view, settings.target, say, lambda: bar.advance(task), laid) for view in views]
        bar.update(task, description="adjusting", total=None)
        return calibrate(found, chosen)


def _cameras(calibration: Calibration) -> tuple[CalibratedCamera, ...]:
    import torch

    cameras = []
    for i, name in enumerate(calibration.names):
        fx, fy, cx, cy = (float(v) for v in calibration.intrinsics[i, :4])
        plane = calibration.backgrounds[i]
        cameras.append(
            CalibratedCamera(
                name=name,
                intrinsics=torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64),
                rotation=torch.from_numpy(calibration.poses[i].rotation.copy()),
                translation=torch.from_numpy(calibration.poses[i].translation.copy()),
                distortion=torch.from_numpy(calibration.intrinsics[i, 4:].copy()),
                image_size=calibration.sizes[i],
                background=None
                if plane is None
                else Plane(torch.tensor(plane.normal, dtype=torch.float64), plane.offset),
            )
        )
    return tuple(cameras)


def _about(calibration: Calibration) -> dict[str, Any]:
    return {
        "date": datetime.date.today().isoformat(),
        "rms_px": calibration.rms(),
        "camera_rms_px": {name: calibration.rms(name) for name in calibration.names},
        "sigma_rotation_deg": dict(zip(calibration.names, calibration.sigma_rotation.tolist(), strict=True)),
        "sigma_translation_mm": dict(zip(calibration.names, calibration.sigma_translation.tolist(), strict=True)),
        "notes": list(calibration.notes),
    }


def _tell(calibration: Calibration) -> None:
    say(
        f"{'camera':<12}{'pictures':>9}{'rms [px]':>10}{'f [px]':>10}{'+-':>8}{'rotation +-':>13}{'position +-':>13}"
        f"{'background rms':>16}"
    )
    for i, name in enumerate(calibration.names):
        own = [e for e in calibration.errors if e.camera == name]
        plane = calibration.backgrounds[i]
        used = f"{sum(e.used for e in own)}/{len(own)}"
        say(
            f"{name:<12}{used:>9}{calibration.rms(name):>10.3f}{calibration.intrinsics[i, 0]:>10.1f}"
            f"{calibration.sigma_focal[i]:>8.2%}{calibration.sigma_rotation[i]:>9.4f} deg"
            f"{calibration.sigma_translation[i]:>10.3f} mm" + (f"{plane.rms:>13.3f} mm" if plane else f"{'none':>16}")
        )
    for note in calibration.notes:
        say(f"note: {note}")


def _imported(settings: Calibrate) -> tuple[CalibratedCamera, ...]:
    from nerif.imaging.importers import import_cameras

    cameras = import_cameras(settings.source, scale_mm=settings.scale_mm)
    for name in settings.views:
        if name not in [c.name for c in cameras]:
            raise InputError(f"views: expected some of {', '.join(c.name for c in cameras)}, got '{name}'")
    return tuple(_completed(c, settings) for c in cameras if not settings.views or c.name in settings.views)


def _completed(camera: CalibratedCamera, settings: Calibrate) -> CalibratedCamera:
    """Put in what the file does not say."""
    if camera.image_size is None and settings.image_size is not None:
        camera = replace(camera, image_size=settings.image_size)
    if camera.background is None and settings.background_distance is not None:
        towards = -camera.rotation[2]  # from the background to the camera
        camera = replace(camera, background=Plane(towards, -settings.background_distance))
    return camera


def _existing(settings: Calibrate) -> tuple[Sequence[CalibratedCamera] | Sequence[Camera], Box | None]:
    if settings.source.suffix == ".nc":
        measurement = Measurement.read(settings.source)
        return measurement.cameras, measurement.box
    return _imported(settings), None


def _draw(path: Path, cameras: Sequence[CalibratedCamera] | Sequence[Camera], box: Box | None) -> None:
    from nerif.report.rig_figure import save_rig

    whole: list[Camera] = []
    for camera in cameras:
        if isinstance(camera, Camera):
            whole.append(camera)
            continue
        try:
            whole.append(camera.camera())
        except InputError as error:
            say(f"note: not drawn: {error}")
    if not whole:
        say(f"note: {path} was not drawn; --background-distance and --image-size tell what is missing")
        return
    save_rig(path, whole, box)
    say(f"{path}: the rig; look whether cameras and axes stand where they do in the laboratory")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Calibrate(source=tyro.MISSING), arguments, "calibrate"))
