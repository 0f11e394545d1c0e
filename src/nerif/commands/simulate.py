"""nerif simulate: a measurement of a phantom, or of a moving one over time, and its truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from nerif.commands.output import check_file, counting_bar, say
from nerif.commands.settings import Settings, read_settings
from nerif.conventions import DEFAULT_AMBIENT_FACES, InputError
from nerif.fields.base import Field
from nerif.fields.grid import VoxelField
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.measurement_sequence import MeasurementSequence
from nerif.simulation import STEPS, simulate
from nerif.volume import Volume, read_volume, write_netcdf
from nerif.volume_sequence import VolumeSequence

__all__ = ["Simulate", "main", "run"]


@dataclass(frozen=True)
class Simulate(Settings):
    """Trace curved rays through a phantom and write a measurement, with its truth as a volume beside it."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Measurement to write, NAME.nc; the truth becomes NAME.truth.nc. With --times NAME.zarr and NAME.truth.zarr."""
    phantom: str = "flame"
    """One of gaussians, flame, octahedron, 1-7 (the paper's numbers), or a volume file (.nc, .vti) of your own."""
    noise: float = 0.0
    """Standard deviation of the noise as a share of the rms displacement over rays that cross the box."""
    seed: int = 0
    """Of phantom and noise."""
    time: float = 0.0
    """Instant of the flame, s."""
    times: str = ""
    """Many instants of the flame, FIRST:LAST:COUNT in s (0:2.3e-3:24): a sequence."""
    box: tuple[float, float, float] = (50.0, 50.0, 50.0)
    """Edges of the box around the origin, along x y z, mm; a volume file brings its own."""
    n_ambient: float = 1.00027
    """Refractive index around the flow."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm (kept in the file)."""
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES
    """Faces of the box on which the index is ambient (kept in the file)."""
    truth_voxels: int = 100
    """Voxels of the truth along the longest edge."""
    steps: int = STEPS
    """Runge-Kutta steps of a ray through the box."""
    force: bool = False
    """Overwrite existing files."""
    ring: Annotated[Ring, tyro.conf.arg(name="")] = field(default_factory=Ring)


def truth_path(out: Path) -> Path:
    """Return NAME.truth.nc for NAME.nc, NAME.truth.zarr for NAME.zarr."""
    return out.with_name(f"{out.stem}.truth{out.suffix}")


def run(settings: Simulate) -> None:
    """Write the measurement and its truth."""
    ending = ".zarr" if settings.times else ".nc"
    if settings.out.suffix != ending:
        raise InputError(f"out: expected a name ending in {ending}, got '{settings.out.name}'")
    if settings.truth_voxels < 1:
        raise InputError(f"truth_voxels: expected at least 1, got {settings.truth_voxels}")
    if settings.times:
        run_over_time(settings)
        return
    check_file(settings.out, settings.force, truth_path(settings.out))
    phantom, box = _phantom(settings)
    cameras = settings.ring.cameras()
    with counting_bar("tracing rays", len(cameras)) as bar:
        measurement = simulate(
            phantom, cameras, box, settings.n_ambient, settings.noise, settings.seed, settings.steps,
            settings.wavelength_nm, settings.ambient_faces, on_view=bar,
        )  # fmt: skip
    grid = Grid.of_resolution(box, settings.truth_voxels)
    truth = Volume(phantom.sample(grid), grid, attributes={"n_ambient": settings.n_ambient})
    measurement.write(settings.out)
    write_netcdf(truth_path(settings.out), [truth])
    rays, d, _ = measurement.rays()
    rms = float(d.square().mean().sqrt())
    say(f"{settings.out}: {len(cameras)} views, {len(rays)} rays cross the box, rms displacement {rms:.3f} px")
    say(f"{truth_path(settings.out)}: the truth on {' x '.join(map(str, grid.shape))} voxels (z, y, x)")


def instants(text: str) -> tuple[float, ...]:
    """Return the instants that FIRST:LAST:COUNT stands for, s.

    Raises
    ------
    InputError
        If it stands for none.
    """
    try:
        first, last, count = (kind(word) for kind, word in zip((float, float, int), text.split(":"), strict=True))
        if not (count == 1 or (count > 1 and last > first)):
            raise ValueError
    except ValueError:
        raise InputError(f"times: expected FIRST:LAST:COUNT in s, such as 0:2.3e-3:24, got '{text}'") from None
    return tuple(first + (last - first) * i / max(count - 1, 1) for i in range(count))


def run_over_time(settings: Simulate) -> None:
    """Write a measurement of every instant and its truth, as two stores."""
    times = instants(settings.times)
    if settings.phantom not in ("flame", "2", "3", "4", "5", "6", "7"):
        raise InputError(f"times: expected a phantom that moves (flame, 2-7), got '{settings.phantom}'")
    cameras, truth = settings.ring.cameras(), truth_path(settings.out)
    for path in (settings.out, truth):
        if path.exists() and not settings.force:
            raise InputError(f"{path}: exists already and was left as it is; give another --out, or --force")
    with counting_bar("simulating frames", len(times)) as bar:
        for i, time in enumerate(times):
            phantom, box = _phantom(replace(settings, time=time))
            measurement = simulate(
                phantom, cameras, box, settings.n_ambient, settings.noise, settings.seed + i, settings.steps,
                settings.wavelength_nm, settings.ambient_faces,
            )  # fmt: skip
            if i == 0:
                sequence = MeasurementSequence.create(settings.out, times, measurement, settings.force)
                grid = Grid.of_resolution(box, settings.truth_voxels)
                store = VolumeSequence.create(truth, times, grid, ("index_excess",), settings.n_ambient)
            sequence.write_frame(i, measurement)
            store.write(i, [Volume(phantom.sample(grid), grid)])
            bar(i + 1)
    say(f"{settings.out}: {len(times)} frames of {len(cameras)} views")
    say(f"{truth}: the truth on {' x '.join(map(str, grid.shape))} voxels (z, y, x)")


def _phantom(settings: Simulate) -> tuple[Field, Box]:
    path = Path(settings.phantom)
    if path.suffix in (".nc", ".vti"):
        volume = read_volume(path)
        if volume.quantity != "index_excess":
            raise InputError(f"{path}: expected index_excess or n in it, got '{volume.quantity}'")
        return VoxelField.through(volume.values, volume.grid), volume.grid.box
    x, y, z = (e / 2 for e in settings.box)
    box = Box((-x, -y, -z), (x, y, z))
    return make_phantom(settings.phantom, box, settings.seed, settings.time), box


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Simulate(out=tyro.MISSING), arguments, "simulate"))
