"""Simulated measurements of a field by any technique, with noise.

Displacements are those of curved rays, traced from every pixel through the field to the background; the other
techniques have straight rays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from annotated_types import Ge, Lt
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import AMBIENT_INDEX, DEFAULT_AMBIENT_FACES, InputError
from nerif.common.files import ending
from nerif.common.settings import Count, check_settings
from nerif.data.measurement import Measurement, measurement_of
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume import INDEX, Volume
from nerif.data.volume_file import read_volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.field import Field
from nerif.fields.phantoms import Scaled, make_phantom
from nerif.fields.voxel_field import VoxelField
from nerif.forward.forward_model import ForwardModel
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.ray_tracing import background_points
from nerif.forward.registry import ASSUMED, TECHNIQUES, check_simulated, forward_model, technique
from nerif.geometry import Box, Camera, Grid, Rays

__all__ = ["Simulation", "add_noise", "add_quantum_noise", "simulate", "view_displacement"]

Finite = Annotated[float, Ge(0), Lt(math.inf)]
MOVING = ("flame", "2", "3", "4", "5", "6", "7")
PEAK_VOXELS = 64  # along the longest edge, to find the largest value of a phantom
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
    techniques: Sequence[type[ForwardModel]] = (ASSUMED,),
) -> Measurement:
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


@dataclass(frozen=True)
class Simulation:
    """A phantom, and the settings of its measurement."""

    phantom: str = "flame"
    """One of gaussians, flame, octahedron, turbulence, fire, gaussian-jet, plume, underexpanded (axisymmetric flows),
    1-7 (the paper's numbers), or your own volume file (.nc, .vti)."""
    technique: tuple[str, ...] = (ASSUMED.name,)
    """Data of a pixel: deflection, absorption, emission or interferometry; several if they share one field."""
    peak: Finite = 0.0
    """Largest extinction or emission, 1/mm, that a phantom is scaled to; 0 for one that gives about 1 along a ray."""
    noise: float = 0.0
    """Standard deviation of the noise as a share of the rms over rays that cross the box."""
    counts: Finite = 0.0
    """Detected quanta, for shot noise instead: without the medium (absorption) or where it is brightest."""
    seed: int = 0
    """Seed of phantom and noise."""
    time: float = 0.0
    """Instant of the flame, s."""
    box: tuple[float, float, float] = (50.0, 50.0, 50.0)
    """Edges of the box around the origin, along x y z, mm; a volume file has its own."""
    n_ambient: float | None = None
    """Refractive index around the flow; default: that of the volume file, else 1.00027."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm (stored in the file)."""
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES
    """Faces of the box on which the index is ambient (stored in the file)."""
    truth_voxels: Count = 100
    """Voxels of the truth along the longest edge."""
    steps: int = STEPS
    """Runge-Kutta steps of a ray through the box."""

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.technique:
            raise InputError(f"expected one or more of {', '.join(TECHNIQUES)}, got none", field="technique")
        kinds = [technique(name) for name in self.technique]
        check_simulated(kinds)
        if self.peak and (self._is_file or kinds[0].quantity == INDEX):
            what = "a volume file, which is not scaled" if self._is_file else f"{kinds[0].name}, of an index"
            raise InputError(f"expected for the extinction or emission of a phantom, got {what}; omit it", field="peak")
        if self.counts and self.noise:
            raise InputError("expected without --noise, which it replaces", field="counts")

    def __call__(
        self, cameras: Sequence[Camera], on_view: Callable[[int], None] | None = None, frame: int = 0
    ) -> tuple[Measurement, Volume]:
        """Return the simulated measurement and the true field; each frame has different noise."""
        field, box, n_ambient = self._field()
        kinds = [technique(name) for name in self.technique]
        measurement = simulate(
            field, cameras, box, n_ambient, self.noise, self.seed + frame, self.steps, self.wavelength_nm,
            self.ambient_faces, on_view, kinds,
        )  # fmt: skip
        if self.counts:
            measurement = add_quantum_noise(measurement, self.counts, self.seed + frame)
        grid = Grid.of_resolution(box, self.truth_voxels)
        return measurement, Volume.of(field.sample(grid), grid, measurement.quantity, n_ambient)

    def over_time(
        self,
        times: Sequence[float],
        cameras: Sequence[Camera],
        out: Path,
        truth: Path,
        force: bool = False,
        on_frame: Callable[[int, int], None] = lambda count, total: None,
    ) -> tuple[MeasurementSequence, VolumeSequence]:
        """Write the measurements at several times (s) and the true fields as two stores, and return these."""
        if self.phantom not in MOVING:
            raise InputError(f"expected a phantom that moves (flame, 2-7), got '{self.phantom}'", field="times")
        for i, time in enumerate(times):
            measurement, volume = replace(self, time=time)(cameras, frame=i)
            if i == 0:
                sequence = MeasurementSequence.create(out, times, measurement, force)
                store = VolumeSequence.create(truth, times, volume.grid, (volume.quantity,), measurement.n_ambient)
            sequence.write_frame(i, measurement)
            store.write(i, [volume])
            on_frame(i + 1, len(times))
        return sequence, store

    @property
    def _is_file(self) -> bool:
        return ending(self.phantom) in (".nc", ".vti")

    def _field(self) -> tuple[Field, Box, float]:
        """The field, its box, and the ambient index."""
        path, quantity = Path(self.phantom), technique(self.technique[0]).quantity
        if not self._is_file:
            box = Box.around_origin(self.box)
            n_ambient = AMBIENT_INDEX if self.n_ambient is None else self.n_ambient
            phantom = make_phantom(self.phantom, box, self.seed, self.time)
            return phantom if quantity == INDEX else self._scaled(phantom, box), box, n_ambient
        volume = read_volume(path, None if quantity == INDEX else quantity)
        if quantity != INDEX:
            return VoxelField.through(volume.values, volume.grid), volume.grid.box, AMBIENT_INDEX
        try:
            n_ambient = next(n for n in (self.n_ambient, volume.n_ambient, AMBIENT_INDEX) if n is not None)
            excess = volume.relative_to(n_ambient)
        except InputError as error:
            raise error.inside(path) from None
        return VoxelField.through(excess.values, excess.grid), excess.grid.box, n_ambient

    def _scaled(self, phantom: Field, box: Box) -> Field:
        """The phantom, scaled to the peak of its deviation from ambient."""
        values = phantom.sample(Grid.of_resolution(box, PEAK_VOXELS))
        peak = self.peak or 2 / min(box.edges[:2])
        return Scaled(phantom, peak / float(values.flatten()[values.abs().argmax()]))
