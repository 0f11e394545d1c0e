"""nerif calibrate: cameras from target images, from a file of another program, or from measured distances."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerif.cli.arguments import check_output
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.settings import Flat, Positional
from nerif.imaging.calibration.calibration_settings import CalibrationSettings, ImportSettings, SimpleRig
from nerif.imaging.calibration.targets import CalibrationTarget

if TYPE_CHECKING:
    from nerif.data.cameras_file import CalibratedCamera
    from nerif.geometry import Box, Camera
    from nerif.imaging.calibration.result import Calibration

__all__ = ["Calibrate", "main", "run"]


@dataclass(frozen=True)
class Calibrate(Settings):
    """Calibrate cameras from target images or measured distances, or import a calibration; draw the rig in 3-D.

    SOURCE is a folder of views: VIEW/target/*.tif (target in free space, the same number for the same pose in all
    views) and VIEW/background/*.tif (target on the background of the view), or with a views.toml; or a calibration of
    another program (.mat, .yml, .xml, transforms.json, .npz, .csv, .toml). --check only draws the rig.

    With --simple, SOURCE is a folder with one view (VIEW/reference) or an image; the camera, which looks across the
    axis of a flow, follows from --distance, --background-distance and --mm-per-px.
    """

    source: Annotated[Path, Positional]
    """Folder of images, calibration file, measurement (--check) or image (--simple)."""
    out: Path = Path("calibration.toml")
    """Output file NAME.toml, with NAME.rig.png and NAME.errors.png."""
    check: bool = False
    """Only draw cameras, box and background planes to NAME.rig.png, which shows mirrored axes."""
    target: CalibrationTarget = field(default_factory=CalibrationTarget)
    background_scale: float = 1.0
    """Print scale of the target on the backgrounds relative to the free target."""
    views: tuple[str, ...] = ()
    """Views to use (default: all); with --simple and an image, the name of its view (default: camera)."""
    leave_out: tuple[str, ...] = ()
    """Target images to exclude: cam1/target/7 is pose 7 of cam1, cam1/background/2 is on its background."""
    simple: bool = False
    """One camera from distances, without target; z along the axis of the flow, y away from the camera."""
    rig: Annotated[SimpleRig, Flat] = field(default_factory=SimpleRig)
    method: Annotated[CalibrationSettings, Flat] = field(default_factory=CalibrationSettings)
    taken_over: Annotated[ImportSettings, Flat] = field(default_factory=ImportSettings)
    lower: tuple[float, float, float] | None = None
    """Lower corner x y z of the box, mm, stored with the cameras (--simple: default is the field of view)."""
    upper: tuple[float, float, float] | None = None
    """Upper corner x y z of the box, mm."""
    force: bool = False
    """Overwrite an existing calibration; its figures are always replaced."""


def run(settings: Calibrate) -> None:
    """Write the calibration and its figures."""
    from nerif.data.cameras_file import write_cameras
    from nerif.geometry import Box
    from nerif.imaging.calibration.importers.importers import import_box, import_cameras, is_calibration
    from nerif.imaging.calibration.result import MOUNT

    box = Box.between(settings.lower, settings.upper)
    if settings.simple and not settings.method.kind.shows_depth:
        raise InputError(f"expected perspective with --simple, got {settings.method.projection}", field="projection")
    if not settings.simple and settings.rig.entries:
        raise InputError(
            "expected together with --simple; add it, or leave them out", field=", ".join(settings.rig.entries)
        )
    out, rig, errors = settings.out, settings.out.with_suffix(".rig.png"), settings.out.with_suffix(".errors.png")
    if settings.check:
        check_output(out, True, rig, endings=(".toml",))
        _draw(rig, *_cameras(settings, box))
        return
    no_images = settings.simple or is_calibration(settings.source)
    if settings.taken_over.interfaces is not None and settings.simple:
        remedy = "run nerif calibrate calibration.toml --interfaces on its result"
        raise InputError(f"expected without --simple; {remedy}", field="interfaces")
    check_output(out, settings.force, endings=(".toml",))
    check_output(rig, True, errors)
    if settings.simple:
        camera, box = _simple(settings, box)
        write_cameras(out, [camera], {"source": str(settings.source), "simple": settings.rig.entries}, box)
        _print_simple(out, camera, box)
        _draw(rig, [camera], box)
        return
    imports = settings.taken_over
    if no_images:
        cameras, box = (
            import_cameras(settings.source, imports, settings.views, say),
            box or import_box(settings.source, imports),
        )
        write_cameras(out, cameras, {"source": str(settings.source)}, box)
        say(f"{out}: {len(cameras)} cameras imported from {settings.source}: {', '.join(c.name for c in cameras)}")
        _draw(rig, cameras, box)
        return
    result = replace(_calibrate(settings), lens=imports.lens, mount=imports.pose_sigma or MOUNT)
    result.write(out, box)
    _print(result)
    from nerif.report.calibration_figure import save_errors

    save_errors(errors, result)
    say(f"{out}: {len(result.cameras)} cameras; {errors}: reprojection errors")
    _draw(rig, result.cameras, box)


def _simple(settings: Calibrate, box: Box | None) -> tuple[CalibratedCamera, Box]:
    from nerif.imaging.calibration.simple_rig import box_about_axis, find_image, simple_camera

    name, size = find_image(settings.source, settings.views, settings.taken_over.image_size)
    camera = simple_camera(settings.rig, size, settings.taken_over, name)
    return camera, box or box_about_axis(camera)


def _cameras(settings: Calibrate, box: Box | None) -> tuple[Sequence[CalibratedCamera] | Sequence[Camera], Box | None]:
    """Return the cameras to draw with --check, and the box."""
    from nerif.data.measurement import Measurement
    from nerif.imaging.calibration.importers.importers import import_box, import_cameras

    if settings.simple:
        camera, box = _simple(settings, box)
        return (camera,), box
    if ending(settings.source) == ".nc":
        measurement = Measurement.read(settings.source)
        return measurement.cameras, box or measurement.box
    cameras = import_cameras(settings.source, settings.taken_over, settings.views, say)
    return cameras, box or import_box(settings.source, settings.taken_over)


def _print_simple(out: Path, camera: CalibratedCamera, box: Box) -> None:
    import torch

    complete = camera.camera()
    scale = float(complete.pixel_size(torch.zeros(3, dtype=torch.float64)))
    edges = ", ".join(f"{axis} {a:g} to {b:g}" for axis, a, b in zip("xyz", box.lower, box.upper, strict=True))
    say(
        f"{out}: camera '{camera.name}', {float(camera.translation[2]):g} mm from the axis of the flow, background "
        f"{-complete.plane.offset:g} mm behind it"
    )
    say(f"scale: {scale:.4g} mm per px at the axis; verify with a ruler")
    say(f"box: {edges} mm; z along the axis, y away from the camera")


def _calibrate(settings: Calibrate) -> Calibration:
    from nerif.imaging.calibration.calibrate import calibrate_views, target_images
    from nerif.imaging.calibration.importers.importers import read_interfaces
    from nerif.imaging.readers.views import find_views

    views, count = find_views(settings.source, settings.views), itertools.count(1)
    with counting_bar("detecting targets", target_images(views)) as bar:
        return calibrate_views(
            views, settings.target, settings.method, settings.background_scale,
            settings.taken_over.background_distance, say, lambda: bar(next(count)), settings.leave_out,
            read_interfaces(settings.taken_over.interfaces, [view.name for view in views]),
        )  # fmt: skip


def _print(calibration: Calibration) -> None:
    scale = f"f [{calibration.projection.unit}]"
    say(
        f"{'camera':<12}{'images':>9}{'rms [px]':>10}{scale:>10}{'+-':>8}{'rotation +-':>13}{'position +-':>13}"
        f"{'background rms':>16}"
    )
    for i, name in enumerate(calibration.names):
        errors = [e for e in calibration.errors if e.camera == name]
        plane = calibration.backgrounds[i]
        images = f"{sum(e.used for e in errors)}/{len(errors)}"
        say(
            f"{name:<12}{images:>9}{calibration.rms(name):>10.3f}{calibration.intrinsics[i, 0]:>10.5g}"
            f"{calibration.sigma_focal[i]:>8.2%}{calibration.sigma_rotation[i]:>9.4f} deg"
            f"{calibration.sigma_translation[i]:>10.3f} mm" + (f"{plane.rms:>13.3f} mm" if plane else f"{'none':>16}")
        )
    if calibration.sigma_tilt.any():
        say(f"{'camera':<12}{'tilt of the sensor about its x [deg]':>38}{'about its y [deg]':>24}")
        for name, angles, sigma in zip(calibration.names, calibration.tilt, calibration.sigma_tilt, strict=True):
            x, y = (f"{angle:.3f} +- {s:.3f}" for angle, s in zip(angles, sigma, strict=True))
            say(f"{name:<12}{x:>38}{y:>24}")
    for note in calibration.notes:
        say(f"note: {note}")


def _draw(path: Path, cameras: Sequence[CalibratedCamera] | Sequence[Camera], box: Box | None) -> None:
    from nerif.geometry import Camera
    from nerif.report.rig_figure import save_rig

    complete: list[Camera] = []
    for camera in cameras:
        try:
            complete.append(camera if isinstance(camera, Camera) else replace(camera, lens=None).camera())
        except InputError as error:
            say(f"note: camera not drawn: {error}")
    if not complete:
        say(f"note: {path} was not drawn; give --image-size")
        return
    save_rig(path, complete, box)
    say(f"{path}: the rig; compare cameras and axes with the laboratory")


main = command("calibrate", Calibrate, run)
