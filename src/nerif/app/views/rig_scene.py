"""The rig in 3-D: cameras, fields of view, backgrounds and box; and a table of the cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nerif.app.forms.elements import html, table_html, text_html
from nerif.app.views.surfaces import GROUND, scene_of
from nerif.common.conventions import InputError
from nerif.geometry import Box, Camera
from nerif.imaging.calibration.importers.importers import import_box, import_cameras
from nerif.imaging.calibration.result import ImageError, read_errors, rms_of
from nerif.report.rig_figure import COLOURS, box_edges, image_corners

__all__ = ["Rig", "read_rig", "show_rig"]

SIZE = 5.0  # extent of the rig in the scene
TIP = 0.18  # length of the pyramid of a camera, relative to the rig
BEYOND = "#bcc5cd"  # colour of the rays from there to the background
HEAD = ("Camera", "Image [px]", "Focal length [px]", "Position x, y, z [mm]", "Images used", "rms [px]")


@dataclass(frozen=True)
class Rig:
    """Contents of a calibration file."""

    cameras: tuple[Camera, ...]  #: cameras that can be drawn
    gaps: tuple[str, ...]  #: data that the other cameras lack
    box: Box | None  #: measurement volume
    errors: tuple[ImageError, ...]  #: reprojection errors of the calibration images, empty if the file has none


def read_rig(path: Path) -> Rig:
    """Read a calibration file."""
    cameras, gaps = [], []
    for camera in import_cameras(path):
        try:
            cameras.append(replace(camera, lens=None).camera())
        except InputError as error:
            gaps.append(str(error))
    return Rig(tuple(cameras), tuple(gaps), import_box(path), read_errors(path))


def show_rig(rig: Rig) -> None:
    """Build the scene and the table."""
    for text in rig.gaps:
        text_html(text, classes="note")
    if not rig.cameras:
        return
    scene = scene_of("The rig; drag to turn, scroll to zoom", 1080, 460)
    middle = np.zeros(3) if rig.box is None else np.array(rig.box.centre)
    outlines = [image_corners(c, middle) for c in rig.cameras]
    points = np.concatenate([np.concatenate([s.start, s.end]) for s in outlines] + [middle[None]])
    centre, reach = (points.max(axis=0) + points.min(axis=0)) / 2, float(np.ptp(points, axis=0).max()) or 1.0
    scale = SIZE / reach

    def at(point: np.ndarray) -> list[float]:
        return list(((point - centre) * scale).tolist())

    def line(a: np.ndarray, b: np.ndarray, colour: str) -> None:
        scene.line(at(a), at(b)).material(colour)

    def outline(corners: np.ndarray, colour: str) -> None:
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            line(a, b, colour)

    with scene:
        for i, (one, corners) in enumerate(zip(rig.cameras, outlines, strict=True)):
            colour = COLOURS[i % len(COLOURS)]
            tips = corners.start + TIP * reach * corners.direction
            outline(tips, colour)
            for start, tip in zip(corners.start, tips, strict=True):
                line(start, tip, colour)
            for tip, end in zip(tips, corners.end, strict=True):
                line(tip, end, BEYOND)
            if one.background is not None:
                outline(corners.end, colour)
            place = corners.start.mean(axis=0) - 0.04 * reach * corners.direction.mean(axis=0)
            style = f"color: #16202b; background: {GROUND}; font: 600 13px system-ui; border-bottom: 3px solid {colour}"
            scene.text(one.name, style=style).move(*at(place))
        if rig.box is not None:
            for a, b in box_edges(rig.box):
                line(a, b, "#16202b")
        for axis, colour in enumerate(("#c62828", "#2e7d32", "#1565c0")):
            end = 0.1 * reach * np.eye(3)[axis]
            line(np.zeros(3), end, colour)
            scene.text("xyz"[axis], style=f"color: {colour}; font: 700 13px system-ui").move(*at(1.15 * end))
    scene.move_camera(0.8 * SIZE, -1.05 * SIZE, 0.75 * SIZE, 0, 0, 0, duration=0)
    rows: dict[str, tuple[str, ...]] = {}
    for camera in rig.cameras:
        camera_errors = [e for e in rig.errors if e.camera == camera.name]
        height, width = camera.image_size
        used = f"{sum(e.used for e in camera_errors)} of {len(camera_errors)}" if camera_errors else "unknown"
        rms = f"{rms_of(camera_errors):.3f}" if any(e.used for e in camera_errors) else "unknown"
        place = ", ".join(f"{round(float(x), 1) + 0.0:.1f}" for x in camera.centre)
        rows[camera.name] = (f"{width} × {height}", f"{float(camera.intrinsics[0, 0]):.1f}", place, used, rms)
    html(table_html("Cameras", HEAD, rows))
