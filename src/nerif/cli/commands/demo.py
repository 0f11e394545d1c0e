"""nerif demo: the whole road on a small flame, with one view held out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands import evaluate, reconstruct, simulate
from nerif.cli.commands.methods import ReconstructNeRIF
from nerif.cli.commands.output import MONITOR, say
from nerif.cli.commands.settings import Settings, read_settings
from nerif.common.conventions import InputError
from nerif.common.installation import install
from nerif.geometry import Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import Simulation
from nerif.workflow.pipeline import Run, write_report

__all__ = ["Demo", "main", "run"]


@dataclass(frozen=True)
class Demo(Settings):
    """Simulate nine small views of a flame and a tenth to hold out, reconstruct with error bars, evaluate, report."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/demo")
    """Directory to write."""
    time_limit: float = 22.0
    """Seconds of training, three times: of the reconstruction, and of two that tell how far off it may be."""
    pixels: int = 64
    """Pixels along an edge of each view (the paper has 200)."""
    noise: float = 0.05
    """Noise as a share of the rms displacement."""
    seed: int = 0
    """Of flame, noise and network."""
    force: bool = False
    """Overwrite an existing directory."""


def run(settings: Demo) -> None:
    """Run the demo and say where to look."""
    if settings.pixels < 8:
        raise InputError(f"expected at least 8, got {settings.pixels}", field="pixels")
    if not settings.time_limit > 0:
        raise InputError(f"expected seconds above 0, got {settings.time_limit}", field="time_limit")
    out = ResultDirectory(settings.out, say)
    out.check_free(settings.force)
    settings.out.mkdir(parents=True, exist_ok=True)
    measured = settings.out / "measurement.nc"
    between = 95.625  # degrees, halfway between the fifth and the sixth of nine views
    ring = Ring(extra_angles=(between,), image_size=(settings.pixels,) * 2, pixel_pitch=0.02 * 200 / settings.pixels)
    with out.writing(measured.name), out.writing(simulate.truth_path(measured).name):
        simulate.run(
            simulate.Simulate(
                out=measured,
                force=True,
                simulation=Simulation(noise=settings.noise, seed=settings.seed, truth_voxels=80),
                ring=ring,
            )
        )
    withheld = f"{between:g}deg"
    reconstruct.run(
        ReconstructNeRIF(
            measurement=measured,
            out=settings.out,
            preset="fast",
            voxels=80,
            force=True,
            run=Run(withhold=(withheld,), uncertainty="fast", report=False),
            reconstructor=NeRIF(time_limit=settings.time_limit, seed=settings.seed),
        )
    )
    evaluate.run(evaluate.Evaluate(settings.out, truth=simulate.truth_path(measured)))
    page = write_report(settings.out, monitor=MONITOR)
    say(f"Open {page} in a browser: the field, the views, and whether it can be trusted.")
    say(f"Or in the app, with everything that can be done next: nerif app {settings.out} ({install('app')})")
    say(f"Open {settings.out}/volume.vti in ParaView; figures for print: nerif figures {settings.out}")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Demo(), arguments, "demo"))
