"""Whether pixels count as seeing through the whole of their lens, or along thin rays."""

from __future__ import annotations

from dataclasses import replace

import torch

from nerif.conventions import InputError
from nerif.measurement import Measurement

__all__ = ["APERTURES", "check_aperture", "lens_rays", "seen_through"]

APERTURES = ("auto", "on", "off")

OF_AREA, MOST = 2, 12


def check_aperture(aperture: str) -> None:
    """Raise InputError unless it is one of APERTURES."""
    if aperture not in APERTURES:
        raise InputError(f"aperture: expected one of {', '.join(APERTURES)}, got '{aperture}'")


def seen_through(measurement: Measurement, aperture: str) -> Measurement:
    """Return the measurement as seen through the lenses that are known of it ("auto", "on") or by thin rays ("off").

    Raises
    ------
    InputError
        If it is "on" and no aperture is known.
    """
    check_aperture(aperture)
    known = any(camera.lens is not None and camera.lens.diameter > 0 for camera in measurement.cameras)
    if aperture == "on" and not known:
        raise InputError(
            "aperture: expected a measurement that knows aperture_diameter (mm), got one that does not; add it to the "
            "calibration (nerif calibrate --aperture-diameter) or measurement file, or leave --aperture on out"
        )
    if (aperture != "off" and known) or all(camera.lens is None for camera in measurement.cameras):
        return measurement
    return replace(measurement, cameras=tuple(replace(camera, lens=None) for camera in measurement.cameras))


def lens_rays(measurement: Measurement, asked: int = 0) -> int:
    """Return how many rays through the lens of a pixel a network is trained on at the end; 1 where rays are thin.

    Parameters
    ----------
    asked : so many; 0 for OF_AREA r^2, 2 to MOST, of the radius r of the cone in the middle of the box, px
    """
    centre, widths = torch.tensor(measurement.box.centre, dtype=torch.float64), []
    for camera in measurement.cameras:
        if camera.lens is not None and camera.lens.diameter > 0:
            focus = camera.lens.focus or camera.depth(camera.plane)
            depth = float(camera.local(centre)[2])
            radius = camera.lens.diameter / 2 * abs(1 - depth / focus)
            widths.append(radius / float(camera.pixel_size(centre)))
    if not widths:
        return 1
    return asked or 2 * min(max(round(OF_AREA * max(widths) ** 2 / 2), 1), MOST // 2)
