"""nerif demo: simulation, reconstruction, evaluation and report of a small flame, with one withheld view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Ge

from nerif.cli.commands import evaluate, reconstruct, simulate
from nerif.cli.commands.output import MONITOR, say
from nerif.cli.commands.settings import Settings, command
from nerif.common.installation import install
from nerif.geometry import Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import Simulation
from nerif.workflow.job import Run
from nerif.workflow.reports import write_report

__all__ = ["Demo", "main", "run"]

WITHHELD_ANGLE = 95.625  # degrees, halfway between the fifth and the sixth of nine views


@dataclass(frozen=True)
class Demo(Settings):
    """Simulate nine small views of a flame and a withheld tenth, reconstruct with standard deviations, and evaluate."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/demo")
    """Directory to write."""
    steps: Annotated[int, Ge(1)] = 700
    """Training steps of each of three runs: the reconstruction and two bootstrap trials."""
    pixels: Annotated[int, Ge(8)] = 64
    """Pixels along an edge of each view (paper: 200)."""
    noise: float = 0.05
    """Noise relative to the rms displacement."""
    seed: int = 0
    """Random seed of flame, noise and network."""
    force: bool = False
    """Overwrite an existing directory."""


def run(settings: Demo) -> None:
    """Run the demo and print where its results are."""
    out = ResultDirectory(settings.out, say)
    out.check_free(settings.force)
    settings.out.mkdir(parents=True, exist_ok=True)
    path, pixels = settings.out / "measurement.nc", settings.pixels
    truth = simulate.truth_path(path)
    ring = Ring(extra_angles=(WITHHELD_ANGLE,), image_size=(pixels,) * 2, pixel_pitch=0.02 * 200 / pixels)
    simulation = Simulation(noise=settings.noise, seed=settings.seed, truth_voxels=80)
    with out.writing(path.name), out.writing(truth.name):
        simulate.run(simulate.Simulate(out=path, force=True, simulation=simulation, ring=ring))
    reconstruct.run(
        reconstruct.ReconstructNeRIF(
            measurement=path, out=settings.out, preset="fast", voxels=80, force=True,
            run=Run(withhold=(f"{WITHHELD_ANGLE:g}deg",), uncertainty="fast", report=False),
            reconstructor=NeRIF(max_steps=settings.steps, seed=settings.seed),
        )
    )  # fmt: skip
    evaluate.run(evaluate.Evaluate(settings.out, truth=truth))
    page = write_report(settings.out, monitor=MONITOR)
    say(f"Report of field, views and estimated error: open {page} in a browser.")
    say(f"Browser interface: nerif app {settings.out} ({install('app')})")
    say(f"ParaView: {settings.out}/volume.vti; figures for print: nerif figures {settings.out}")


main = command("demo", Demo, run)
