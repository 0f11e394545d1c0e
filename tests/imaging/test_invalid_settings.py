"""Settings that cannot be are refused by the name of the field, before any image is read."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from nerif.imaging.calibration.calibrate import CalibrationSettings
from nerif.imaging.calibration.importers.importers import ImportSettings
from nerif.imaging.calibration.simple_rig import SimpleRig, simple_camera
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.displacement.displacement import DisplacementSettings
from nerif.imaging.masks import MaskSettings, MaskShape
from nerif.imaging.patterns import Background
from nerif.imaging.readers.crop import Crop
from refusals import refused


def target(*values: object) -> None:
    CalibrationTarget(*values).raster(0.5)  # type: ignore[arg-type]


def telecentric(**settings: object) -> None:
    CalibrationSettings(projection="telecentric", **settings)  # type: ignore[arg-type]


def rig(settings: ImportSettings, **measures: object) -> None:
    simple_camera(SimpleRig(**measures), (320, 240), settings)  # type: ignore[arg-type]


BEHIND, LENS = (ImportSettings(background_distance=300.0, aperture_diameter=d) for d in (None, 5.0))
RULED = {"distance": 700.0, "mm_per_px": 0.1}
AXIS = "axis_from, axis_to"
REFUSED: list[tuple[Callable[..., object], tuple[object, ...], dict[str, object], str]] = [
    *[(MaskSettings, (), {name: -1}, name) for name in ("threshold", "smooth", "smallest", "grow")],
    (MaskShape, ("oval", ((0, 0),)), {}, "kind"), (MaskShape, ("polygon", ((0, 0), (1, 1))), {}, "points"),
    (MaskShape, ("brush", ((math.nan, 0),)), {}, "points"), (MaskShape, ("brush", ((0, 0),), True, 0.0), {}, "width"),
    *[(DisplacementSettings, (), {name: value}, name) for name, value in (
        ("method", "piv"), ("smoothness", 0.0), ("max_sigma", -1.0), ("local_contrast", -1), ("shake_border", -3),
        ("min_correlation", 1.5))],
    *[(Crop, (), {name: value}, name) for name, value in (
        ("row", -1), ("width", -2), ("flip", "left"), ("rotate", 45))],
    *[(Background, (), {"width": 60.0, "height": 40.0, "dot": 1.0, name: value}, name) for name, value in (
        ("kind", "stripes"), ("width", 0.0), ("fill", 0.9), ("dot", 30.0))],
    (lambda: Background("dots", 60.0, 40.0, 1.0).raster(0.8), (), {}, "pixel"),
    (target, ("checker", 9, 7), {}, "kind"), (target, ("chessboard", 9, 7), {}, "target"),
    (target, ("chessboard", 3, 2), {}, "target"), (target, ("charuco", 9, 7, 0.0), {}, "target"),
    (target, ("charuco", 9, 7, 5.0, 6.0), {}, "target"),
    (target, ("charuco", 9, 7, 5.0, 3.0, "DICT_9X9"), {}, "dictionary"),
    (target, ("charuco", 12, 10, 5.0, 0.0, "DICT_4X4_50"), {}, "dictionary"),
    (CalibrationSettings, (), {"axes": ("x+", "y+", "z-")}, "axes"),
    (CalibrationSettings, (), {"distortion": ("k9",)}, "distortion"),
    (CalibrationSettings, (), {"max_error": 0.0}, "max_error"),
    (CalibrationSettings, (), {"projection": "fisheye"}, "projection"),
    (telecentric, (), {"side": None}, "side"), (telecentric, (), {"side": ("cam1", "left")}, "side"),
    (telecentric, (), {"side": ("cam1", "x+"), "scheimpflug": True}, "scheimpflug"),
    (ImportSettings, (), {"scale_mm": 0.0}, "scale_mm"),
    (ImportSettings, (), {"focus_distance": 900.0}, "focus_distance"),
    (ImportSettings, (), {"aperture_diameter": -1.0}, "aperture_diameter"),
    (ImportSettings, (), {"pose_sigma_mm": 0.3}, "pose_sigma_mm, pose_sigma_deg"),
    (ImportSettings, (), {"pose_sigma_mm": 0.3, "pose_sigma_deg": -1.0}, "pose_sigma_deg"),
    (SimpleRig, (), {"distance": -1.0}, "distance"), (SimpleRig, (), {"mm_per_px": math.nan}, "mm_per_px"),
    (SimpleRig, (), {"axis_from": (1.0, 2.0)}, AXIS),
    (SimpleRig, (), {"axis_from": (1.0, 2.0), "axis_to": (1.0, 2.5)}, AXIS),
    (SimpleRig, (), {"principal_point": (math.inf, 2.0)}, "principal_point"),
    (SimpleRig, (), {"mm_per_px": 0.1, "pixel_pitch_um": 5.0}, "mm_per_px, pixel_pitch_um"),
    (SimpleRig, (), {"mm_per_px": 0.1, "f_number": 8.0}, "f_number"),
    (rig, (BEHIND,), {"mm_per_px": 0.1}, "distance"),
    (rig, (BEHIND,), {"distance": 700.0, "focal_length": 50.0}, "mm_per_px"),
    (rig, (ImportSettings(),), RULED, "background_distance"),
    (rig, (ImportSettings(background_distance=-5.0),), RULED, "background_distance"),
    (rig, (LENS,), {**RULED, "focal_length": 50.0, "f_number": 8.0}, "f_number, aperture_diameter"),
]  # fmt: skip


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("make", "values", "named", "field"), REFUSED)
def test_invalid_settings(make, values, named, field):
    with refused(field):
        make(*values, **named)
