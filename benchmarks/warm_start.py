"""What a classical start saves NeRIF: error against seconds, from nothing and from a total-variation volume.

    python benchmarks/warm_start.py --write benchmarks/results/warm-start-cpu.md

The seconds of the start count in full: those of the classical method and those of fitting the network to it. Errors
are looked at from outside and never reach the training.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from bench import N_AMBIENT, Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.volume import Volume
from nerif.fields.base import Field
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import add_noise, simulate

COLUMNS = (
    "start", "fit steps", "rate after it", "seconds of the start", "seconds in all", "L2", "L2 of variation", "CC",
)  # fmt: skip


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixels", type=int, default=64)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--seconds", type=float, nargs="+", default=[10, 20, 40])
    parser.add_argument("--voxels", type=int, default=60, help="of the start, a quick one on the linear basis")
    parser.add_argument("--rates", type=float, nargs="+", default=[0.3], help="learning rate after the fit, as a share")
    parser.add_argument("--fit-steps", type=int, nargs="+", default=[400])
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--device", default="auto")
    add_write(parser)
    arguments = parser.parse_args()

    keep_freed_memory()
    cameras, box = paper_rig(arguments.pixels)
    flame = make_phantom("flame", box, 0)
    measurement = add_noise(simulate(flame, cameras, box, N_AMBIENT), arguments.noise, seed=1)
    grid = Grid.of_resolution(box, 80)
    truth = Volume(flame.sample(grid), grid)
    table = Table(
        "Starting NeRIF from a classical volume",
        COLUMNS,
        arguments.write,
        f"; flame, {arguments.pixels} x {arguments.pixels} px, noise {arguments.noise:g}",
    )

    def add(name: str, fit: str, rate: str, before: float, seconds: float, field: Field, device: str) -> None:
        m = evaluate_volume(field, truth, N_AMBIENT, device)
        cells = [name, fit, rate, f"{before:.0f}", f"{seconds:.0f}", f"{m['l2']:.3%}", f"{m['l2_variation']:.2%}"]
        table.row([*cells, f"{m['cc']:.5f}"])

    tv = TotalVariation(voxels=arguments.voxels, basis="linear", device=arguments.device)
    tv(replace(measurement))  # compiles what is compiled once
    start = tv(measurement)
    add(f"TV {arguments.voxels}³ alone", "-", "-", start.seconds, start.seconds, start.field, start.device)
    for seconds in arguments.seconds:
        base = replace(preset(arguments.preset), epochs=0, device=arguments.device)
        cold = replace(base, time_limit=seconds)(measurement)
        add("nothing", "-", "-", 0, seconds, cold.field, cold.device)
        if seconds <= start.seconds + 1:
            continue
        for fit in arguments.fit_steps:
            for rate in arguments.rates:
                settings = replace(base, time_limit=seconds - start.seconds, fit_steps=fit, rate_after_fit=rate)
                warm = settings(measurement, start=start.field)
                add(f"TV {arguments.voxels}³", f"{fit}", f"{rate:g}", start.seconds, seconds, warm.field, warm.device)


if __name__ == "__main__":
    main()
