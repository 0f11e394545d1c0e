"""Images of particles: Gaussians of a diameter in px, integrated over the pixels, with shot noise.

    L(p) = sum_i b_i / a_i integral over pixel p of G(p' - p_i) dp'

b_i is the brightness of a particle, p_i its image and a_i the area (mm^2) of a pixel at its position.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import AMBIENT_INDEX, InputError
from nerif.data.measurement import Measurement, measurement_of
from nerif.forward.registry import technique_of
from nerif.geometry import Camera
from nerif.simulation.particles.cloud import DIAMETER, QUANTITY, Particles, spread

__all__ = ["image", "images"]

STEP = 1e-3  # mm, of the difference quotient for the scale of an image


def images(
    particles: Particles, cameras: Sequence[Camera], counts: float = 1000.0, diameter: float = DIAMETER, seed: int = 0,
) -> Measurement:  # fmt: skip
    """Return the images of particles as a measurement of emission in their box.

    Parameters
    ----------
    counts : detected quanta of a particle of mean brightness in one image, which have shot noise; 0 for no noise
    diameter : of a particle image, four standard deviations, px
    seed : of the noise
    """
    if not 0 <= counts < math.inf:
        raise InputError(f"expected 0 or more, got {counts}", field="counts")
    kind = technique_of(QUANTITY)
    generator = torch.Generator().manual_seed(seed)
    height, width = (max(c.image_size[i] for c in cameras) for i in (0, 1))
    radiance = torch.full((len(cameras), height, width), float("nan"))
    sigma = torch.full_like(radiance, float("nan"))
    for i, camera in enumerate(cameras):
        h, w = camera.image_size
        values = image(particles, camera, diameter)
        total = float(values.sum())
        if not total > 0:
            raise InputError(
                f"expected some in view '{camera.name}', got none; check camera and box", field="particles"
            )
        if counts:
            quantum = total / (counts * len(particles))  # radiance of one
            detections = torch.poisson(values / quantum, generator)
            values, noise = quantum * detections, quantum * detections.clamp_min(1).sqrt()
            sigma[i, :h, :w] = noise.float()
        radiance[i, :h, :w] = values.float()
    measurement = measurement_of({kind: radiance[..., None]}, cameras, particles.box, AMBIENT_INDEX)
    if not counts:
        return measurement
    return measurement.observed({kind.name: radiance[..., None]}, {kind.name: sigma[..., None]})


def image(particles: Particles, camera: Camera, diameter: float = DIAMETER) -> Float[Tensor, "row column"]:
    """Return the radiance of particles in the pixels of a camera, without noise; diameter as in `images`."""
    places = camera.project(particles.positions)
    amounts = particles.brightness * _px_per_mm2(camera, particles.positions, places)
    return spread(places.flip(-1), amounts, diameter / 4, camera.image_size)


def _px_per_mm2(camera: Camera, points: Float[Tensor, "n 3"], places: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
    """Pixels per square millimetre across the line of sight, at points and their images."""
    direction = camera.rays(places, sensitivity=False).direction
    least = torch.nn.functional.one_hot(direction.abs().argmin(dim=1), 3).to(direction)
    across = torch.linalg.cross(direction, least)
    across = across / across.norm(dim=1, keepdim=True)
    (a, b), (c, d) = (
        ((camera.project(points + STEP * e) - camera.project(points - STEP * e)) / (2 * STEP)).unbind(-1)
        for e in (across, torch.linalg.cross(direction, across))
    )
    return (a * d - b * c).abs()
