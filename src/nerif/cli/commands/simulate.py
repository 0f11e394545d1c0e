"""nerif simulate: a measurement of a phantom, or of a moving one over time, and its truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import check_file, counting_bar, say
from nerif.cli.commands.settings import Flat, Settings, read_settings
from nerif.common.conventions import InputError, with_unit
from nerif.common.interruption import if_interrupted
from nerif.data.volume_file import write_netcdf
from nerif.geometry import Ring
from nerif.simulation.simulate import Simulation

__all__ = ["Simulate", "main", "run"]


@dataclass(frozen=True)
class Simulate(Settings):
    """Trace rays through a phantom and write a measurement, with its truth as a volume beside it."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Measurement to write, NAME.nc; the truth becomes NAME.truth.nc. With --times NAME.zarr and NAME.truth.zarr."""
    times: str = ""
    """Many instants of the flame, FIRST:LAST:COUNT in s (0:2.3e-3:24): a sequence."""
    f_number: float = 0.0
    """Focal length over aperture of the lenses, focused on the backgrounds; 0 for thin rays."""
    force: bool = False
    """Overwrite existing files."""
    simulation: Annotated[Simulation, Flat] = field(default_factory=Simulation)
    ring: Annotated[Ring, Flat] = field(default_factory=Ring)


def truth_path(out: Path) -> Path:
    """Return NAME.truth.nc for NAME.nc, NAME.truth.zarr for NAME.zarr."""
    return out.with_name(f"{out.stem}.truth{out.suffix}")


def run(settings: Simulate) -> None:
    """Write the measurement and its truth."""
    ending = ".zarr" if settings.times else ".nc"
    if settings.out.suffix != ending:
        raise InputError(f"expected a name ending in {ending}, got '{settings.out.name}'", field="out")
    if settings.times:
        run_over_time(settings)
        return
    truth = truth_path(settings.out)
    check_file(settings.out, settings.force, truth)
    cameras = settings.ring.cameras(settings.f_number)
    with counting_bar("tracing rays", len(cameras)) as bar:
        measurement, volume = settings.simulation(cameras, bar)
    measurement.write(settings.out)
    write_netcdf(truth, [volume])
    for observation in measurement.observations:
        rays, values, _ = measurement.rays(observation)
        rms, kind = float(values.square().mean().sqrt()), observation.technique
        size = f"rms {kind.measured} {with_unit(f'{rms:.3g}', kind.unit)}"
        say(f"{settings.out}: {len(cameras)} views, {len(rays)} rays cross the box, {size}")
    say(f"{truth}: the truth on {' x '.join(map(str, volume.grid.shape))} voxels (z, y, x)")


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
        raise InputError(f"expected FIRST:LAST:COUNT in s, such as 0:2.3e-3:24, got '{text}'", field="times") from None
    return tuple(first + (last - first) * i / max(count - 1, 1) for i in range(count))


def run_over_time(settings: Simulate) -> None:
    """Write a measurement of every instant and its truth, as two stores."""
    times = instants(settings.times)
    cameras, truth = settings.ring.cameras(settings.f_number), truth_path(settings.out)
    for path in (settings.out, truth):
        if path.exists() and not settings.force:
            raise InputError("exists already and was left as it is; give another --out, or --force", field=path)
    begun = f"{settings.out} and {truth} lack frames; the same command with --force starts again"
    with if_interrupted(lambda: begun), counting_bar("simulating frames") as bar:
        _, store = settings.simulation.over_time(times, cameras, settings.out, truth, settings.force, bar)
    say(f"{settings.out}: {len(times)} frames of {len(cameras)} views")
    say(f"{truth}: the truth on {' x '.join(map(str, store.grid.shape))} voxels (z, y, x)")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Simulate(out=tyro.MISSING), arguments, "simulate"))
