"""Frame by frame from nothing, and frame by frame from the one before: error, seconds.

    python benchmarks/sequence.py --write benchmarks/results/sequence-cpu.md
    python benchmarks/sequence.py --device cuda --preset best --pixels 200 --write benchmarks/results/sequence-gpu.md

A flame filmed from 9 and from 4 views. Seconds are those of a whole frame: training, sampling the volume, comparing
with the views, writing. Errors and seconds are means over the last frames; warm starts reach them from a first frame
with the most steps of those from nothing, so what they forget or pile up on the way counts. "Faster" is the time in
which frames from nothing reach the same error (on the line between the two nearest, in logarithms; a bound where all of
them are worse or better), over the time taken. "Change" is the difference of one frame from the next in the truth,
of its variation. Truth and reconstruction meet only in the errors.
Needs the extra `sequence`.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench import N_AMBIENT, Table, add_write
from nerif.analysis.metrics import volume_errors
from nerif.cli.commands.simulate import Simulate, instants
from nerif.cli.commands.simulate import run as simulate
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume_sequence import VolumeSequence
from nerif.geometry import Ring
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.presets import PRESETS, preset
from nerif.simulation.simulate import Simulation
from nerif.workflow.sequence.frames import reconstruct_frames
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.store import DONE, Frame, SequenceStore

COLUMNS = (
    "views", "s between frames", "change", "how", "steps a frame", "seconds a frame", "L2", "L2 of variation", "CC",
    "faster",
)  # fmt: skip


def film(folder: Path, views: int, frames: int, pixels: int, interval: float, noise: float, voxels: int) -> Path:
    """Simulate a film and return its path; the truth lies beside it."""
    out = folder / f"film{views}-{interval:g}.zarr"
    ring = Ring(views=views, image_size=(pixels, pixels), pixel_pitch=0.02 * 200 / pixels)
    times = f"0:{(frames - 1) * interval}:{frames}"
    assert len(instants(times)) == frames
    simulation = Simulation(noise=noise, truth_voxels=voxels)
    simulate(Simulate(out=out, times=times, simulation=simulation, ring=ring))
    return out


def run(
    film: Path, out: Path, cold: NeRIF, voxels: int, compared: int, first: SequenceStore | None = None, **changes: float
) -> tuple[float, float, float, float]:
    """Reconstruct a film; seconds a frame, and mean L2, L2 of the variation and CC of the last frames."""
    sequence, truth = MeasurementSequence.read(film), VolumeSequence(film.with_name(film.stem + ".truth.zarr"))
    steps, rate = (changes.get(k, 0) for k in ("warm_steps", "warm_rate"))
    settings = SequenceSettings(
        chunk=len(sequence), warm_steps=int(steps) or 1, warm_rate=rate or 0.7, voxels=voxels,
        quantities=("index_excess",),
    )  # fmt: skip
    cold = replace(cold, network=cold.resolved_by(sequence.fullest()).network, wave_pixels=0)
    plan = SequencePlan(film, out, cold, settings)
    store = SequenceStore.begin(out, sequence, truth.grid, settings.quantities, cold.network, plan.attributes)
    last = range(len(sequence) - compared, len(sequence))
    if first is not None:
        store.write_frame(0, Frame(first.field(0), [first.volume(0, "index_excess")], [], 0.0, 0))
        reconstruct_frames(plan, 0, len(sequence))
    else:
        for i in last:
            reconstruct_frames(plan, i, i + 1)
    assert all(store.status[i] == DONE for i in last), store.reasons
    errors = [
        volume_errors(
            truth.volume(i, "index_excess").values.numpy(), store.volume(i, "index_excess").values.numpy(), N_AMBIENT
        )
        for i in last
    ]
    seconds = float(np.mean([store.array("seconds")[i] for i in last]))
    l2, variation, cc = (float(np.mean([e[k] for e in errors])) for k in ("l2", "l2_variation", "cc"))
    return seconds, l2, variation, cc


def first_frame(film: Path, out: Path, cold: NeRIF, voxels: int) -> SequenceStore:
    """The frame that the warm starts begin with: from nothing."""
    sequence, truth = MeasurementSequence.read(film), VolumeSequence(film.with_name(film.stem + ".truth.zarr"))
    settings = SequenceSettings(chunk=len(sequence), voxels=voxels, quantities=("index_excess",))
    cold = replace(cold, network=cold.resolved_by(sequence.fullest()).network, wave_pixels=0)
    plan = SequencePlan(film, out, cold, settings)
    store = SequenceStore.begin(out, sequence, truth.grid, settings.quantities, cold.network, plan.attributes)
    reconstruct_frames(plan, 0, 1)
    return store


def change(film: Path) -> float:
    """How far each frame is from the next, in the truth: relative to its variation."""
    truth = VolumeSequence(film.with_name(film.stem + ".truth.zarr"))
    frames = [truth.volume(i, "index_excess").values.numpy() for i in range(len(truth))]
    return float(np.mean([volume_errors(b, a, N_AMBIENT)["l2_variation"] for a, b in itertools.pairwise(frames)]))


def faster(seconds: float, error: float, cold: list[tuple[float, float]]) -> str:
    """How many times longer frames from nothing, (seconds, error), take to the same error."""
    if len(cold) < 2:
        return "-"
    cold = sorted(cold, key=lambda c: -c[1])
    errors, times = np.log([c[1] for c in cold])[::-1], np.log([c[0] for c in cold])[::-1]
    sign = ">" if error < cold[-1][1] else "<" if error > cold[0][1] else ""
    return f"{sign} {np.exp(np.interp(np.log(error), errors, times)) / seconds:.1f}"


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=[9, 4])
    parser.add_argument("--frames", type=int, default=9)
    parser.add_argument("--compared", type=int, default=3, help="last frames that errors and seconds are means of")
    parser.add_argument(
        "--interval", type=float, nargs="+", default=[2.5e-5, 5e-5, 1e-4], help="s, between frames (it rises at 15 m/s)"
    )
    parser.add_argument("--pixels", type=int, default=64)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--voxels", type=int, default=64)
    parser.add_argument("--preset", default="fast", choices=list(PRESETS))
    parser.add_argument("--device", default="auto")
    parser.add_argument("--cold", type=int, nargs="*", default=[250, 500, 1000], help="steps of a frame from nothing")
    parser.add_argument("--warm", type=int, nargs="*", default=[80, 160, 320], help="steps of a frame from the last")
    parser.add_argument("--warm-rate", type=float, nargs="*", default=[0.7])
    add_write(parser)
    arguments = parser.parse_args()
    keep_freed_memory()
    table = Table("A film of a flame", COLUMNS, arguments.write)
    base = replace(preset(arguments.preset), device=arguments.device)
    best = max([*arguments.cold, 1])
    kinds: list[tuple[str, int, NeRIF, dict[str, float]]] = []
    kinds += [("from nothing", n, replace(base, max_steps=n), {}) for n in arguments.cold]
    for n, rate in itertools.product(arguments.warm, arguments.warm_rate):
        changes = {"warm_steps": n, "warm_rate": rate}
        kinds.append((f"from the one before, rate {rate:g}", n, replace(base, max_steps=best), changes))
    with tempfile.TemporaryDirectory() as folder:
        for views, interval in itertools.product(arguments.views, arguments.interval):
            path = film(
                Path(folder), views, arguments.frames, arguments.pixels, interval, arguments.noise, arguments.voxels
            )
            first = first_frame(
                path, Path(folder) / "first.zarr", replace(base, max_steps=best), arguments.voxels
            ) if arguments.warm else None  # fmt: skip
            about, from_nothing = [str(views), f"{interval:g}", f"{change(path):.0%}"], []
            for name, steps, cold, changes in kinds:
                seconds, l2, variation, cc = run(
                    path, Path(folder) / "out.zarr", cold, arguments.voxels, arguments.compared,
                    first if "warm_steps" in changes else None, **changes,
                )  # fmt: skip
                if not changes:
                    from_nothing.append((seconds, l2))
                gain = faster(seconds, l2, from_nothing) if changes else "1"
                cells = [*about, name, str(steps), f"{seconds:.2f}", f"{l2:.3%}", f"{variation:.2%}"]
                table.row([*cells, f"{cc:.5f}", gain])


if __name__ == "__main__":
    main()
