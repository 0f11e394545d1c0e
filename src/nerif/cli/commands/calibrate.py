"""nerif calibrate: from target images, another program's file, or what a ruler tells, to calibrated cameras."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

from nerif.cli.commands.output import check_file, counting_bar, say
from nerif.cli.commands.settings import Flat, Settings, read_settings
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Box, Camera
from nerif.imaging.calibration.calibrate import CalibrationSettings, calibrate_views, target_images
from nerif.imaging.calibration.cameras_file import CalibratedCamera, write_cameras
from nerif.imaging.calibration.importers.importers import ImportSettings, import_box, import_cameras, is_calibration
from nerif.imaging.calibration.result import MOUNT, Calibration
from nerif.imaging.calibration.simple_rig import SimpleRig, box_about_axis, find_image, simple_camera
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.readers.views import find_views

__all__ = ["Calibrate", "main", "run"]


@dataclass(frozen=True)
class Calibrate(Settings):
    """Calibrate cameras from target images, take them over, or one from a ruler; all draw the rig in 3-D.

    SOURCE is a folder with a folder for each view (VIEW/target/*.tif: the target free in space, one pose under one
    number in all views; VIEW/background/*.tif: the target laid on the view's background), or with a views.toml; or the
    calibration of another program (.mat, .yml, .xml, transforms.json, .csv, .toml). With --check only the rig is drawn.

    With --simple SOURCE is the folder of an experiment of one view (VIEW/reference) or an image, and one camera that
    looks across the axis of a flow comes from --distance, --background-distance and --mm-per-px.
    """

    source: tyro.conf.Positional[Path]
    """Folder of images, or a file with a calibration, or (with --check) a measurement, (with --simple) an image."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("calibration.toml")
    """Calibration to write, NAME.toml; NAME.rig.png and NAME.errors.png come with it."""
    check: bool = False
    """Only draw cameras, box and background planes of SOURCE to NAME.rig.png: mirrored axes show there."""
    target: CalibrationTarget = field(default_factory=CalibrationTarget)
    background_scale: float = 1.0
    """The target laid on the backgrounds is the same one printed this many times larger."""
    views: tuple[str, ...] = ()
    """Only these views; with --simple and an image, what its view is called (default: camera)."""
    leave_out: tuple[str, ...] = ()
    """Target images that are not used: cam1/target/7 is pose 7 of view cam1, cam1/background/2 one that lies on its
    background. NAME.toml tells their errors under these names."""
    simple: bool = False
    """One camera from distances, no target: its frame has z along the axis of the flow, y away from the camera."""
    rig: Annotated[SimpleRig, Flat] = field(default_factory=SimpleRig)
    method: Annotated[CalibrationSettings, Flat] = field(default_factory=CalibrationSettings)
    taken_over: Annotated[ImportSettings, Flat] = field(default_factory=ImportSettings)
    lower: tuple[float, float, float] | None = None
    """Lower corner of the box to draw and to keep with the cameras, mm; with --simple by default all that is seen."""
    upper: tuple[float, float, float] | None = None
    """Upper corner of the box, mm."""
    force: bool = False
    """Overwrite existing files."""


def run(settings: Calibrate) -> None:
    """Write the calibration and its images."""
    if settings.out.suffix != ".toml":
        raise InputError(f"expected a name ending in .toml, got '{settings.out.name}'", field="out")
    box = Box.between(settings.lower, settings.upper)
    if settings.simple and not settings.method.kind.shows_depth:
        raise InputError(f"expected perspective with --simple, got {settings.method.projection}", field="projection")
    if not settings.simple and settings.rig.entries:
        raise InputError(
            "expected together with --simple; add it, or leave them out", field=", ".join(settings.rig.entries)
        )
    rig, errors = settings.out.with_suffix(".rig.png"), settings.out.with_suffix(".errors.png")
    if settings.check:
        check_file(rig, settings.force)
        _draw(rig, *_existing(settings, box))
        return
    cameras: Sequence[CalibratedCamera]
    if settings.simple:
        check_file(settings.out, settings.force, rig)
        camera, box = _simple(settings, box)
        cameras = (camera,)
        write_cameras(settings.out, cameras, {"source": str(settings.source), "simple": settings.rig.entries}, box)
        _tell_simple(settings.out, camera, box)
    elif is_calibration(settings.source):
        check_file(settings.out, settings.force, rig)
        cameras = import_cameras(settings.source, settings.taken_over, settings.views)
        box = box or import_box(settings.source, settings.taken_over)
        write_cameras(settings.out, cameras, {"source": str(settings.source)}, box)
        say(f"{settings.out}: {len(cameras)} cameras taken over from {settings.source}")
    else:
        check_file(settings.out, settings.force, rig, errors)
        given = settings.taken_over
        calibration = replace(_calibrate(settings), lens=given.lens, mount=given.pose_sigma or MOUNT)
        cameras = calibration.cameras
        calibration.write(settings.out, box)
        _tell(calibration)
        from nerif.report.calibration_figure import save_errors

        save_errors(errors, calibration)
        say(f"{settings.out}: {len(cameras)} cameras; {errors}: reprojection errors")
    _draw(rig, cameras, box)


def _simple(settings: Calibrate, box: Box | None) -> tuple[CalibratedCamera, Box]:
    name, size = find_image(settings.source, settings.views, settings.taken_over.image_size)
    camera = simple_camera(settings.rig, size, settings.taken_over, name)
    return camera, box or box_about_axis(camera)


def _tell_simple(out: Path, camera: CalibratedCamera, box: Box) -> None:
    whole = camera.camera()
    scale = float(whole.pixel_size(torch.zeros(3, dtype=torch.float64)))
    edges = ", ".join(f"{axis} {a:g} to {b:g}" for axis, a, b in zip("xyz", box.lower, box.upper, strict=True))
    say(
        f"{out}: camera '{camera.name}', {float(camera.translation[2]):g} mm from the axis of the flow, the background "
        f"{-whole.plane.offset:g} mm behind it"
    )
    say(f"scale: {scale:.4g} mm per px at the axis; hold a ruler there if in doubt")
    say(f"box: {edges} mm; z along the axis, y away from the camera")


def _calibrate(settings: Calibrate) -> Calibration:
    views, count = find_views(settings.source, settings.views), itertools.count(1)
    with counting_bar("looking for targets", target_images(views)) as bar:
        return calibrate_views(
            views, settings.target, settings.method, settings.background_scale,
            settings.taken_over.background_distance, say, lambda: bar(next(count)), settings.leave_out,
        )  # fmt: skip


def _tell(calibration: Calibration) -> None:
    scale = f"f [{calibration.projection.unit}]"
    say(
        f"{'camera':<12}{'images':>9}{'rms [px]':>10}{scale:>10}{'+-':>8}{'rotation +-':>13}{'position +-':>13}"
        f"{'background rms':>16}"
    )
    for i, name in enumerate(calibration.names):
        own = [e for e in calibration.errors if e.camera == name]
        plane = calibration.backgrounds[i]
        used = f"{sum(e.used for e in own)}/{len(own)}"
        say(
            f"{name:<12}{used:>9}{calibration.rms(name):>10.3f}{calibration.intrinsics[i, 0]:>10.5g}"
            f"{calibration.sigma_focal[i]:>8.2%}{calibration.sigma_rotation[i]:>9.4f} deg"
            f"{calibration.sigma_translation[i]:>10.3f} mm" + (f"{plane.rms:>13.3f} mm" if plane else f"{'none':>16}")
        )
    for note in calibration.notes:
        say(f"note: {note}")


def _existing(settings: Calibrate, box: Box | None) -> tuple[Sequence[CalibratedCamera] | Sequence[Camera], Box | None]:
    if settings.simple:
        camera, box = _simple(settings, box)
        return (camera,), box
    if settings.source.suffix == ".nc":
        measurement = Measurement.read(settings.source)
        return measurement.cameras, box or measurement.box
    cameras = import_cameras(settings.source, settings.taken_over, settings.views)
    return cameras, box or import_box(settings.source, settings.taken_over)


def _draw(path: Path, cameras: Sequence[CalibratedCamera] | Sequence[Camera], box: Box | None) -> None:
    from nerif.report.rig_figure import save_rig

    whole: list[Camera] = []
    for camera in cameras:
        if isinstance(camera, Camera):
            whole.append(camera)
            continue
        try:
            whole.append(replace(camera, lens=None).camera())
        except InputError as error:
            say(f"note: not drawn: {error}")
    if not whole:
        say(f"note: {path} was not drawn; --image-size tells what is missing")
        return
    save_rig(path, whole, box)
    say(f"{path}: the rig; look whether cameras and axes stand where they do in the laboratory")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Calibrate(source=tyro.MISSING), arguments, "calibrate"))
