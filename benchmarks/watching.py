"""How much a run is slowed by being watched: steps of NeRIF in equal seconds, without --live, with it, and looked at.

    python benchmarks/watching.py --write benchmarks/results/watching-cpu.md

Each turn is a process of its own; the three ways take turns, so that what else the machine does meets them alike.
"Looked at" has a second process that reads live.json and live.npz and draws them, as the page of nerif app does.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import tempfile
import time
from pathlib import Path

from bench import N_AMBIENT, Table, add_write, alone

WAYS = ("not watched", "--live", "--live, looked at")
EVERY = 1.0  # seconds, as the page of a run does


def look(directory: str) -> None:
    """Read and draw how a run goes on until somebody ends it."""
    from nerif.app.live_view import curve_options, look_html
    from nerif.results.live import read_live, read_look

    while True:
        live, seen = read_live(Path(directory)), read_look(Path(directory))
        if live:
            curve_options(live["curve"])
        if seen is not None:
            look_html(seen)
        time.sleep(EVERY)


def simulated(path: Path, pixels: int) -> None:
    """Write what all turns reconstruct."""
    from nerif.fields.phantoms import make_phantom
    from nerif.geometry import paper_rig
    from nerif.simulation.simulate import simulate

    cameras, box = paper_rig(pixels)
    simulate(make_phantom("gaussians", box, 0), cameras, box, N_AMBIENT).write(path)


def steps_of(way: str, path: Path, preset_name: str, seconds: float, device: str) -> float:
    """Return the steps a second of a run of so many seconds."""
    from dataclasses import replace

    from nerif.data.measurement import Measurement
    from nerif.reconstruction.base import Step
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.presets import preset
    from nerif.reconstruction.progress import QUIET
    from nerif.results.live import Live

    keep_freed_memory()
    measurement = Measurement.read(path)
    method = replace(preset(preset_name), epochs=0, time_limit=seconds, device=device)
    told: list[tuple[int, float]] = []

    def count(step: Step) -> None:
        told.append((step.step, time.monotonic()))

    with tempfile.TemporaryDirectory() as folder:
        monitor = QUIET
        if way != WAYS[0]:
            monitor = Live(Path(folder), measurement, method).watching(QUIET, withheld=False)
        eye = multiprocessing.get_context("spawn").Process(target=look, args=(folder,))
        if way == WAYS[2]:
            eye.start()
            time.sleep(8.0)  # until it looks
        try:
            with monitor.training("training") as watched:

                def both(step: Step) -> None:
                    watched(step)
                    count(step)

                method(measurement, both)
        finally:
            if eye.pid is not None:
                eye.terminate()
                eye.join()
    (first, begun), (last, ended) = told[0], told[-1]
    return (last - first) / (ended - begun)


def main() -> None:
    """Run the turns and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixels", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each turn")
    parser.add_argument("--turns", type=int, default=5, help="of each way")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--device", default="cpu")
    add_write(parser)
    asked = parser.parse_args()
    more = f"; nine views of {asked.pixels} x {asked.pixels} px, preset {asked.preset}, {asked.seconds:g} s a turn"
    table = Table("What it costs to watch a run", ("turn", *(f"{way}, steps/s" for way in WAYS)), asked.write, more)
    found: dict[str, list[float]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.nc"
        simulated(path, asked.pixels)
        for turn in range(asked.turns):
            for way in WAYS:
                found[way].append(alone(steps_of, way, path, asked.preset, asked.seconds, asked.device))
            table.row([str(turn + 1), *(f"{found[way][-1]:.2f}" for way in WAYS)])
    medians = {way: statistics.median(values) for way, values in found.items()}
    table.row(["median", *(f"{medians[way]:.2f}" for way in WAYS)])
    slower = {way: medians[WAYS[0]] / medians[way] - 1 for way in WAYS[1:]}
    table.text("", f"Longer for the same steps: {', '.join(f'{way} {share:+.1%}' for way, share in slower.items())}.")


if __name__ == "__main__":
    main()
