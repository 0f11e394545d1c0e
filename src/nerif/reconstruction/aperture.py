"""Whether pixels count as seeing through the whole of their lens, and over their window, or along thin rays."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement

__all__ = ["APERTURES", "check_aperture", "lens_rays", "seen_through"]

APERTURES = ("auto", "on", "off")

OF_AREA, MOST = 2, 12


def check_aperture(aperture: str) -> None:
    """Raise InputError unless it is one of APERTURES."""
    if aperture not in APERTURES:
        raise InputError(f"expected one of {', '.join(APERTURES)}, got '{aperture}'", field="aperture")


def seen_through(measurement: Measurement, aperture: str) -> Measurement:
    """Return the measurement as seen through the lenses, and over the windows, that are known of it, or by thin rays.

    Parameters
    ----------
    aperture : "auto", "on" to insist that an aperture is known, "off" for thin rays

    Raises
    ------
    InputError
        If it is "on" and no aperture is known.
    """
    check_aperture(aperture)
    lenses = [camera.lens for camera in measurement.cameras if camera.lens is not None]
    if aperture == "on" and not any(lens.diameter > 0 for lens in lenses):
        raise InputError(
            "expected a measurement that knows aperture_diameter (mm), got one that does not; add it to the "
            "calibration (nerif calibrate --aperture-diameter) or measurement file, or leave --aperture on out",
            field="aperture",
        )
    if (aperture != "off" and any(lens.wide for lens in lenses)) or not lenses:
        return measurement
    return replace(measurement, cameras=tuple(replace(camera, lens=None) for camera in measurement.cameras))


def lens_rays(measurement: Measurement, asked: int = 0) -> int:
    """Return how many rays of a pixel, through its lens and over its window, a network is trained on at the end.

    It is 1 where rays are thin.

    Parameters
    ----------
    asked : so many; 0 for OF_AREA r^2, 2 to MOST, of the radius r of the cone in the middle of the box, px, or that of
        a disc as large as the window
    """
    centre, widths = torch.tensor(measurement.box.centre, dtype=torch.float64), []
    for camera in measurement.cameras:
        lens, radius = camera.lens, 0.0
        if lens is None or not lens.wide:
            continue
        if lens.diameter > 0:
            focus = lens.focus or camera.depth(camera.plane)
            depth = float(camera.local(centre)[2])
            radius = lens.diameter / 2 * abs(1 - depth / focus) / float(camera.pixel_size(centre))
        windowed = any(kind.windowed for kind in measurement.techniques)
        widths.append(math.hypot(radius, windowed * lens.window / math.sqrt(math.pi)))
    if not widths:
        return 1
    return asked or 2 * min(max(round(OF_AREA * max(widths) ** 2 / 2), 1), MOST // 2)
