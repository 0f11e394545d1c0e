"""Simulated measurements of a field by any technique, with noise.

Displacements are those of curved rays, traced from every pixel through the field to the background; the other
techniques have straight rays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import DEFAULT_AMBIENT_FACES, InputError
from nerif.data.measurement import Measurement, measurement_of
from nerif.fields.field import Field
from nerif.forward.forward_model import ForwardModel
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.ray_tracing import background_points
from nerif.forward.registry import ASSUMED, forward_model
from nerif.geometry import Box, Camera, Rays

__all__ = ["add_noise", "add_quantum_noise", "simulate", "view_displacement"]

RAY_CHUNK = 2048  # rays that are integrated at a time
STEPS = 120  # Runge-Kutta steps through the box: 2e-4 of the rms displacement on the flame (test_simulate.py)


def view_displacement(
    field: Field, camera: Camera, box: Box, n_ambient: float, steps: int = STEPS
) -> Float[Tensor, "row column 2"]:
    """Return d(p) = p - p0(p) in px for every pixel; p0 is the image, without flow, of the bent ray's background point.

    Rays are bent inside the box only. Pixels whose ray misses it have d = 0; through a lens d is the mean over it.
    """
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(box)
    bundles: Iterable[Rays] = (rays,)
    if camera.lens is not None:
        bundles = (rays.through(offset.expand(len(rays), 1, 4)) for offset in camera.lens.offsets())
    total, light = torch.zeros_like(rays.pixel), torch.zeros_like(rays.near)
    for bundle in bundles:
        carries = ~bundle.crosses | bundle.unobstructed
        light += carries
        for part in torch.split((bundle.crosses & carries).nonzero()[:, 0], 1 << 14):
            # rays in single precision determine the precision of the field; positions stay in double
            selection = bundle[part]
            shift = background_points(field, selection.to(dtype=torch.float32), steps, n_ambient)
            x0 = selection.end_points
            total[part] += camera.project(x0) - camera.project(x0 + shift)
    return (total / light.clamp_min(1)[:, None]).reshape(*camera.image_size, 2).float()


def view_of(
    kind: type[ForwardModel], field: Field, camera: Camera, measurement: Measurement, steps: int = STEPS
) -> Float[Tensor, "row column c"]:
    """Return the data of a technique for every pixel of a camera; 0 where its ray misses the box."""
    if kind.traced:
        return view_displacement(field, camera, measurement.box, measurement.n_ambient, steps)
    projector = PathIntegral(forward_model(kind, measurement), steps)
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(measurement.box).to(dtype=torch.float32)
    return project(projector, field, rays, chunk=RAY_CHUNK).reshape(*camera.image_size, -1)


def add_noise(measurement: Measurement, level: float, seed: int = 0) -> Measurement:
    """Add Gaussian noise of sigma = level x the rms over the rays that cross the box, and record sigma.

    Level 0 adds no noise and records no sigma.
    """
    if not level >= 0:
        raise InputError(f"expected a level of 0 or more (0.1 is 10 % of the rms), got {level}", field="noise")
    if level == 0:
        return measurement
    generator, noisy, sigmas = torch.Generator().manual_seed(seed), {}, {}
    for o in measurement.observations:
        _, values, _ = measurement.rays(o)
        sigma = level * float(values.square().mean().sqrt())
        noisy[o.technique.name] = o.values + sigma * torch.randn(o.values.shape, generator=generator)
        sigmas[o.technique.name] = torch.full_like(o.values, sigma)
    return measurement.observed(noisy, sigmas)


def add_quantum_noise(measurement: Measurement, counts: float, seed: int = 0) -> Measurement:
    """Return the measurement with the shot noise of detected quanta, and its sigma.

    Parameters
    ----------
    counts : quanta per pixel without the medium (absorption), or where it is brightest (emission)
    """
    generator, noisy, sigmas = torch.Generator().manual_seed(seed), {}, {}
    for o in measurement.observations:
        noisy[o.technique.name], sigmas[o.technique.name] = o.technique.detect(o.values, counts, generator)
    return measurement.observed(noisy, {**sigmas})


def simulate(
    field: Field, cameras: Sequence[Camera], box: Box, n_ambient: float, noise: float = 0.0, seed: int = 0,
    steps: int = STEPS, wavelength_nm: float | None = None, ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES,
    on_view: Callable[[int], None] | None = None, techniques: Sequence[type[ForwardModel]] = (ASSUMED,),
) -> Measurement:  # fmt: skip
    """Return a simulated measurement of a field.

    Parameters
    ----------
    field : quantity of the techniques; of an index the excess
    cameras : with their backgrounds, where a technique needs them
    box : outside of which the field is ambient, mm
    noise : level, see add_noise
    seed : of the noise
    steps : Runge-Kutta steps, or samples, through the box
    on_view : called with the number of finished views
    techniques : of each pixel
    """
    if len(techniques) > 1 and not noise:
        raise InputError("expected a level above 0, which weights the techniques", field="noise")
    height, width = (max(c.image_size[i] for c in cameras) for i in (0, 1))
    if not any(kind.background for kind in techniques):
        cameras = [kind.seen_by(c) for kind in techniques[:1] for c in cameras]
    empty = {kind: torch.zeros(len(cameras), height, width, len(kind.channels)) for kind in techniques}
    # an empty measurement first: an impossible rig is refused before the long work
    measurement = measurement_of(empty, tuple(cameras), box, n_ambient, wavelength_nm, ambient_faces)
    maps = {kind.name: torch.full_like(values, float("nan")) for kind, values in empty.items()}
    with torch.no_grad():
        for i, camera in enumerate(cameras):
            h, w = camera.image_size
            for kind in techniques:
                maps[kind.name][i, :h, :w] = view_of(kind, field, kind.seen_by(camera), measurement, steps)
            if on_view is not None:
                on_view(i + 1)
    measurement = measurement.observed(maps) if len(techniques) > 1 else measurement.observed(maps, {})
    return add_noise(measurement, noise, seed)
