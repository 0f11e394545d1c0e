"""Simulated measurements: curved rays from every pixel through a field, to the background, plus noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import AMBIENT_INDEX, DEFAULT_AMBIENT_FACES, InputError
from nerif.fields.base import Field
from nerif.fields.grid import VoxelField
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Camera, Grid
from nerif.measurement import Measurement
from nerif.measurement_sequence import MeasurementSequence
from nerif.physics.ray_tracing import background_points
from nerif.volume import Volume
from nerif.volume_file import read_volume
from nerif.volume_sequence import VolumeSequence

__all__ = ["Simulation", "add_noise", "simulate", "view_displacement"]

MOVING = ("flame", "2", "3", "4", "5", "6", "7")
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
        x0 = chosen.end_points
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


@dataclass(frozen=True)
class Simulation:
    """A phantom, and how it is measured."""

    phantom: str = "flame"
    """One of gaussians, flame, octahedron, 1-7 (the paper's numbers), or a volume file (.nc, .vti) of your own."""
    noise: float = 0.0
    """Standard deviation of the noise as a share of the rms displacement over rays that cross the box."""
    seed: int = 0
    """Of phantom and noise."""
    time: float = 0.0
    """Instant of the flame, s."""
    box: tuple[float, float, float] = (50.0, 50.0, 50.0)
    """Edges of the box around the origin, along x y z, mm; a volume file brings its own."""
    n_ambient: float | None = None
    """Refractive index around the flow; default: that of the volume file, else 1.00027."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm (kept in the file)."""
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES
    """Faces of the box on which the index is ambient (kept in the file)."""
    truth_voxels: int = 100
    """Voxels of the truth along the longest edge."""
    steps: int = STEPS
    """Runge-Kutta steps of a ray through the box."""

    def __post_init__(self) -> None:
        if self.truth_voxels < 1:
            raise InputError(f"truth_voxels: expected at least 1, got {self.truth_voxels}")

    def __call__(
        self, cameras: Sequence[Camera], on_view: Callable[[int], None] | None = None, frame: int = 0
    ) -> tuple[Measurement, Volume]:
        """Return what the cameras would measure, and the truth as index excess; each frame has noise of its own.

        Raises
        ------
        InputError
            If there is no such phantom, or a volume file is none.
        """
        field, box, n_ambient = self._field()
        measurement = simulate(
            field, cameras, box, n_ambient, self.noise, self.seed + frame, self.steps, self.wavelength_nm,
            self.ambient_faces, on_view,
        )  # fmt: skip
        grid = Grid.of_resolution(box, self.truth_voxels)
        return measurement, Volume(field.sample(grid), grid, attributes={"n_ambient": n_ambient})

    def over_time(
        self,
        times: Sequence[float],
        cameras: Sequence[Camera],
        out: Path,
        truth: Path,
        force: bool = False,
        on_frame: Callable[[int, int], None] = lambda done, total: None,
    ) -> tuple[MeasurementSequence, VolumeSequence]:
        """Write a measurement of every instant (s) and its truth as two stores, and return them.

        Raises
        ------
        InputError
            If the phantom does not move.
        """
        if self.phantom not in MOVING:
            raise InputError(f"times: expected a phantom that moves (flame, 2-7), got '{self.phantom}'")
        for i, time in enumerate(times):
            measurement, volume = replace(self, time=time)(cameras, frame=i)
            if i == 0:
                sequence = MeasurementSequence.create(out, times, measurement, force)
                store = VolumeSequence.create(truth, times, volume.grid, ("index_excess",), measurement.n_ambient)
            sequence.write_frame(i, measurement)
            store.write(i, [volume])
            on_frame(i + 1, len(times))
        return sequence, store

    def _field(self) -> tuple[Field, Box, float]:
        """The field of index excess, its box, and the ambient it is counted from."""
        path = Path(self.phantom)
        if path.suffix not in (".nc", ".vti"):
            box = Box.around_origin(self.box)
            n_ambient = AMBIENT_INDEX if self.n_ambient is None else self.n_ambient
            return make_phantom(self.phantom, box, self.seed, self.time), box, n_ambient
        volume = read_volume(path)
        try:
            n_ambient = next(n for n in (self.n_ambient, volume.n_ambient, AMBIENT_INDEX) if n is not None)
            excess = volume.relative_to(n_ambient)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        return VoxelField.through(excess.values, excess.grid), excess.grid.box, n_ambient
