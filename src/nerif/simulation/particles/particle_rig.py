"""Four cameras in front of a thin volume, as is common in tomographic particle imaging."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import torch

from nerif.common.conventions import InputError
from nerif.geometry import Box, Camera, Ring

__all__ = ["four_cameras"]

PX_PER_MM = 10  # in the middle of the box
DISTANCE = 500.0  # mm
PITCH = 0.02  # mm
MARGIN = 2  # px between the box and the edges of the images


def four_cameras(pixels: int = 200, depth: int = 40, angle: float = 30.0) -> tuple[tuple[Camera, ...], Box]:
    """Return four cameras at the corners of a square, and the largest box of a depth that is in all images.

    The box is thin along x; the cameras are 500 mm away from it at +x. A pixel is 0.1 mm in its middle.

    Parameters
    ----------
    pixels : of an edge of each image
    depth : of the box along x, in pixels
    angle : between the x-axis and each line of sight, degrees
    """
    if not 0 < angle < 80:
        raise InputError(f"expected between 0 and 80 degrees, got {angle}", field="angle")
    if depth < 1:
        raise InputError(f"expected at least 1 px, got {depth}", field="depth")
    aside = math.degrees(math.acos(math.sqrt(math.cos(math.radians(angle)))))  # azimuth and elevation both
    cameras: list[Camera] = []
    for side, elevation in (("below", -aside), ("above", aside)):
        ring = Ring(
            views=2, arc=(-aside, aside), elevation=elevation, distance=DISTANCE, pixel_pitch=PITCH,
            focal_length=PX_PER_MM * DISTANCE * PITCH, image_size=(pixels, pixels),
        )  # fmt: skip
        for hand, camera in zip(("left", "right"), ring.cameras(), strict=True):
            cameras.append(replace(camera, background=None, name=f"{hand} {side}"))
    for width in range(pixels, 0, -1):
        box = Box.around_origin((depth / PX_PER_MM, width / PX_PER_MM, width / PX_PER_MM))
        if all(_sees(camera, box) for camera in cameras):
            return tuple(cameras), box
    raise InputError(f"expected images that hold a box {depth} px deep, got {pixels} px; increase it", field="pixels")


def _sees(camera: Camera, box: Box) -> bool:
    corners = torch.tensor(list(itertools.product(*zip(box.lower, box.upper, strict=True))), dtype=torch.float64)
    pixels, (height, width) = camera.project(corners), camera.image_size
    most = pixels.new_tensor([width - 1 - MARGIN, height - 1 - MARGIN])
    return bool(((pixels >= MARGIN) & (pixels <= most)).all())
