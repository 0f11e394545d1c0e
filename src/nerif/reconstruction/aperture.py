"""Aperture and correlation window of pixels, applied or replaced by thin rays."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement

__all__ = ["apply_aperture", "check_aperture", "lens_rays"]

APERTURES = ("auto", "on", "off")
RAYS_PER_PX2, MAX_RAYS = 2, 12  # of a pixel: per square of the cone's radius in px, and at most


def check_aperture(aperture: str) -> None:
    """Raise InputError unless it is one of APERTURES."""
    if aperture not in APERTURES:
        raise InputError(f"expected one of {', '.join(APERTURES)}, got '{aperture}'", field="aperture")


def apply_aperture(measurement: Measurement, aperture: str) -> Measurement:
    """Return the measurement with its lenses and windows ("auto"; "on" requires an aperture) or thin rays ("off")."""
    check_aperture(aperture)
    lenses = [camera.lens for camera in measurement.cameras if camera.lens is not None]
    if aperture == "on" and not any(lens.diameter > 0 for lens in lenses):
        raise InputError(
            "expected a measurement with aperture_diameter (mm), got one without; add it to the calibration "
            "(nerif calibrate --aperture-diameter) or measurement file, or omit --aperture on",
            field="aperture",
        )
    if (aperture != "off" and any(lens.wide for lens in lenses)) or not lenses:
        return measurement
    return replace(measurement, cameras=tuple(replace(camera, lens=None) for camera in measurement.cameras))


def lens_rays(measurement: Measurement, count: int = 0) -> int:
    """Return the rays of a pixel in the last part of a training: 1 where rays are thin, else `count` or the default.

    That is RAYS_PER_PX2 r^2, 2 to MAX_RAYS, where r is the radius in px of the cone in the middle of the box, or of a
    disc of the area of the window.
    """
    centre, radii = torch.tensor(measurement.box.centre, dtype=torch.float64), []
    for camera in measurement.cameras:
        lens, radius = camera.lens, 0.0
        if lens is None or not lens.wide:
            continue
        if lens.diameter > 0:
            focus = lens.focus or camera.depth(camera.plane)
            depth = float(camera.local(centre)[2])
            radius = lens.diameter / 2 * abs(1 - depth / focus) / float(camera.pixel_size(centre))
        windowed = any(kind.windowed for kind in measurement.techniques)
        radii.append(math.hypot(radius, windowed * lens.window / math.sqrt(math.pi)))
    if not radii:
        return 1
    return count or 2 * min(max(round(RAYS_PER_PX2 * max(radii) ** 2 / 2), 1), MAX_RAYS // 2)
