"""Pictures of particles: Gaussian images of a given diameter in px, integrated over the pixels, with shot noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import AMBIENT_INDEX, InputError
from nerif.geometry import Box, Camera, Ring
from nerif.measurement import Measurement
from nerif.particles.cloud import DIAMETER, Particles, spread
from nerif.techniques.emission import Emission

__all__ = ["four_cameras", "picture", "pictures"]

STEP = 1e-4  # of the distance to the camera, over which the scale of a picture is taken


def four_cameras(pixels: int = 200, depth: int = 40, angle: float = 30.0) -> tuple[tuple[Camera, ...], Box]:
    """Return four cameras at the corners of a square, and the box that all of them see whole, 0.1 mm a pixel.

    Cameras look from azimuth -angle and angle, above and below, along -x at a box that is thin along x.

    Parameters
    ----------
    pixels : of an edge of each picture
    depth : of the box, in pixels at its centre
    angle : between the optical axes and the x-axis, in azimuth and in elevation both, degrees

    Raises
    ------
    InputError
        If the pictures are too small for the box, or the angle is none.
    """
    if not 0 < angle < 80:
        raise InputError(f"angle: expected between 0 and 80 degrees, got {angle}")
    raise NotImplementedError


def picture(
    particles: Particles, camera: Camera, diameter: float = DIAMETER
) -> tuple[Float[Tensor, "row column"], Float[Tensor, " n"]]:
    """Return the radiance of particles in the pixels of a camera, and the square millimetres of a pixel at each.

        L(p) = sum_i b_i / area_i  integral over p of G(p' - p_i) dp'

    Parameters
    ----------
    diameter : of a particle image, four standard deviations, px
    """
    p = camera.project(particles.positions)
    scale = px_per_mm(camera, particles.positions, p)
    places = p.flip(-1)
    return spread(places, particles.brightness * scale, diameter / 4, camera.image_size), 1 / scale


def px_per_mm(camera: Camera, positions, pixels):
    """Pixels that a square millimetre across the line of sight covers."""
    rays = camera.rays(pixels, sensitivity=False)
    d = rays.direction
    other = torch.eye(3, dtype=d.dtype)[d.abs().argmin(dim=1)]
    first = torch.linalg.cross(d, other)
    first = first / first.norm(dim=1, keepdim=True)
    second = torch.linalg.cross(d, first)
    step = STEP
    j = [(camera.project(positions + step * e) - camera.project(positions - step * e)) / (2 * step) for e in (first, second)]
    return (j[0][:, 0] * j[1][:, 1] - j[0][:, 1] * j[1][:, 0]).abs()
