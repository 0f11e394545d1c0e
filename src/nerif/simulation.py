"""Simulated measurements: curved rays from every pixel through a field, to the background, plus noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import DEFAULT_AMBIENT_FACES, InputError
from nerif.fields.base import Field
from nerif.geometry import Box, Camera
from nerif.measurement import Measurement
from nerif.physics.ray_tracing import background_points

__all__ = ["add_noise", "simulate", "view_displacement"]

STEPS = 120  # Runge-Kutta steps through the box: 2e-4 of the rms displacement on the flame (tests/test_simulation.py)


def view_displacement(
    field: Field, camera: Camera, box: Box, n_ambient: float, steps: int = STEPS
) -> Float[Tensor, "row column 2"]:
    """Return d(p) = p - p0(p) in px for every pixel of a camera; p0 is where the bent ray's background point was seen.

    Rays are bent inside the box only. Pixels whose ray misses it have d = 0.
    """
    pixels = camera.pixel_grid().reshape(-1, 2)
    rays = camera.rays(pixels).clip(box)
    displacement = torch.zeros_like(pixels)
    for part in torch.split(rays.crosses.nonzero()[:, 0], 1 << 14):
        # rays in single precision choose the precision of the field; positions stay double inside
        chosen = rays[part]
        moved = background_points(field, chosen.to(dtype=torch.float32), steps, n_ambient)
        x0 = chosen.origin + chosen.background[:, None] * chosen.direction
        displacement[part] = camera.project(x0) - camera.project(x0 + moved)
    return displacement.reshape(*camera.image_size, 2).float()


def add_noise(measurement: Measurement, level: float, seed: int = 0) -> Measurement:
    """Add Gaussian noise of sigma = level x the rms displacement over the rays that cross the box, and record sigma.

    Parameters
    ----------
    level : e.g. 0.1; 0 changes nothing and records no sigma
    seed : of the noise
    """
    if not level >= 0:
        raise InputError(f"noise: expected a level of 0 or more (0.1 is 10 % of the rms displacement), got {level}")
    if level == 0:
        return measurement
    _, d, _ = measurement.rays()
    sigma = level * float(d.square().mean().sqrt())
    noise = torch.randn(measurement.displacement.shape, generator=torch.Generator().manual_seed(seed))
    return replace(
        measurement,
        displacement=measurement.displacement + sigma * noise,
        sigma=torch.full_like(measurement.displacement, sigma),
    )


def simulate(
    field: Field,
    cameras: Sequence[Camera],
    box: Box,
    n_ambient: float,
    noise: float = 0.0,
    seed: int = 0,
    steps: int = STEPS,
    wavelength_nm: float | None = None,
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES,
    on_view: Callable[[int], None] | None = None,
) -> Measurement:
    """Return what the cameras would measure of a field.

    Parameters
    ----------
    field : Field of index excess
    cameras : with their backgrounds
    box : outside of which the index is ambient, mm
    noise : level, see add_noise
    seed : of the noise
    steps : Runge-Kutta steps through the box
    on_view : called with the number of views done
    """
    height = max(c.image_size[0] for c in cameras)
    width = max(c.image_size[1] for c in cameras)
    displacement = torch.zeros(len(cameras), height, width, 2)
    # made first with nothing in it: a rig that cannot be right is refused before the long work
    measurement = Measurement(
        cameras=tuple(cameras),
        displacement=displacement,
        box=box,
        n_ambient=n_ambient,
        wavelength_nm=wavelength_nm,
        ambient_faces=ambient_faces,
    )
    displacement = torch.full_like(displacement, float("nan"))
    with torch.no_grad():
        for i, camera in enumerate(cameras):
            h, w = camera.image_size
            displacement[i, :h, :w] = view_displacement(field, camera, box, n_ambient, steps)
            if on_view is not None:
                on_view(i + 1)
    return add_noise(replace(measurement, displacement=displacement), noise, seed)
