"""nerif simulate: a measurement of a phantom, or of a moving one over time, and the true field."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from nerif.cli.arguments import check_output
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError, with_unit
from nerif.common.interruption import if_interrupted
from nerif.common.locks import locked
from nerif.common.settings import Flat
from nerif.simulation.simulated_rig import SimulatedRig
from nerif.simulation.simulation import Simulation

__all__ = ["Simulate", "main", "run"]


@dataclass(frozen=True)
class Simulate(Settings):
    """Trace rays through a phantom and write a measurement, with the true field as a volume."""

    out: Path
    """Measurement to write, NAME.nc, with the true field NAME.truth.nc; .zarr instead of .nc with --times."""
    times: str = ""
    """Instants of a sequence of the flame, FIRST:LAST:COUNT in s, such as 0:2.3e-3:24."""
    force: bool = False
    """Overwrite existing files."""
    simulation: Annotated[Simulation, Flat] = field(default_factory=Simulation)
    rig: Annotated[SimulatedRig, Flat] = field(default_factory=SimulatedRig)


def truth_path(out: Path) -> Path:
    """Return NAME.truth.nc for NAME.nc, NAME.truth.zarr for NAME.zarr."""
    return out.with_name(f"{out.stem}.truth{out.suffix}")


def run(settings: Simulate) -> None:
    """Write the measurement, or a sequence, and the true field."""
    from nerif.data.volume import write_netcdf

    out, truth = settings.out, truth_path(settings.out)
    times = instants(settings.times) if settings.times else ()
    check_output(out, settings.force, truth, endings=(".zarr",) if times else (".nc",))
    cameras = settings.rig.cameras()
    if times:
        remedy = f"{out} and {truth} lack frames; run the same command with --force to start again"
        with locked(out), if_interrupted(lambda: remedy), counting_bar("simulating frames") as bar:
            _, store = settings.simulation.over_time(times, cameras, out, truth, settings.force, bar)
        say(f"{out}: {len(times)} frames of {len(cameras)} views")
        grid = store.grid
    else:
        with counting_bar("tracing rays", len(cameras)) as bar:
            measurement, volume = settings.simulation(cameras, bar)
        measurement.write(out)
        write_netcdf(truth, [volume])
        for observation in measurement.observations:
            rays, values, _ = measurement.rays(observation)
            kind, rms = observation.technique, float(values.square().mean().sqrt())
            rms_values = f"rms {kind.measured} {with_unit(f'{rms:.3g}', kind.unit)}"
            say(f"{out}: {len(cameras)} views, {len(rays)} rays cross the box, {rms_values}")
        grid = volume.grid
    say(f"{truth}: the true field on {' x '.join(map(str, grid.shape))} voxels (z, y, x)")


def instants(text: str) -> tuple[float, ...]:
    """Return the instants of a text FIRST:LAST:COUNT, s."""
    try:
        first, last, count = (kind(word) for kind, word in zip((float, float, int), text.split(":"), strict=True))
        if not (count == 1 or (count > 1 and last > first)):
            raise ValueError
    except ValueError:
        raise InputError(f"expected FIRST:LAST:COUNT in s, such as 0:2.3e-3:24, got '{text}'", field="times") from None
    return tuple(first + (last - first) * i / max(count - 1, 1) for i in range(count))


main = command("simulate", Simulate, run)
