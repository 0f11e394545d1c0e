"""Frame by frame from nothing, frame by frame from the one before, and one network over space and time: error, seconds.

    python benchmarks/sequence.py --write results/sequence-cpu.md
    python benchmarks/sequence.py --device cuda --preset best --pixels 200 --write results/sequence-gpu.md

A flame filmed from 9 and from 4 views. Seconds are those of a whole frame: training, sampling the volume, comparing
with the views, writing. Errors are means over all frames but the first, which starts from nothing in any case.
Needs nerif[sequence]. Truth and reconstruction meet only in the errors.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import itertools
import platform
import shlex
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from nerif.commands.simulate import Simulate, instants
from nerif.commands.simulate import run as simulate
from nerif.geometry import Ring
from nerif.measurement_sequence import MeasurementSequence
from nerif.metrics import volume_errors
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural import NeRIF
from nerif.reconstruction.presets import PRESETS, preset
from nerif.sequence.frames import Plan, reconstruct_frames
from nerif.sequence.joint import reconstruct_jointly
from nerif.sequence.store import DONE, SequenceStore
from nerif.volume_sequence import VolumeSequence


def machine() -> str:
    """One line on what this ran on."""
    if torch.cuda.is_available():
        return f"{torch.cuda.get_device_name()}, torch {torch.__version__}"
    return f"{platform.machine()}, {torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}, " + (
        f"torch {torch.__version__}"
    )


def film(folder: Path, views: int, frames: int, pixels: int, interval: float, noise: float, voxels: int) -> Path:
    """Simulate a film and return its path; the truth lies beside it."""
    out = folder / f"film{views}.zarr"
    ring = Ring(views=views, image_size=(pixels, pixels), pixel_pitch=0.02 * 200 / pixels)
    times = f"0:{(frames - 1) * interval}:{frames}"
    assert len(instants(times)) == frames
    simulate(Simulate(out=out, phantom="flame", times=times, noise=noise, truth_voxels=voxels, ring=ring))
    return out


def run(film: Path, out: Path, cold: NeRIF, voxels: int, **changes: float) -> tuple[float, float, float, float]:
    """Reconstruct a film; seconds a frame, and mean L2, L2 of the variation and CC."""
    sequence, truth = MeasurementSequence.read(film), VolumeSequence(film.with_name(film.stem + ".truth.zarr"))
    warm_steps, rate, joint = (changes.get(k, 0) for k in ("warm_steps", "warm_rate", "joint_steps"))
    warm = replace(cold, max_steps=int(warm_steps), rate_after_fit=rate) if warm_steps else cold
    octaves = int(changes.get("time_octaves", 3))
    drift = int(changes.get("drift_steps", 0))
    plan = Plan(film, out, cold, warm, voxels, drift_steps=drift, joint_steps=int(joint), time_octaves=octaves)
    about = {"chunk": len(sequence), "hold_out": [], "settings": dataclasses.asdict(cold)}
    about |= {"temporal": "joint", "time_octaves": octaves} if joint else {}
    store = SequenceStore.begin(out, sequence, truth.grid, plan.quantities, cold.network, about)
    if joint:
        reconstruct_jointly(plan, 0, len(sequence))
    elif warm_steps:
        reconstruct_frames(plan, 0, len(sequence))
    else:
        for i in range(len(sequence)):
            reconstruct_frames(plan, i, i + 1)
    assert (store.status == DONE).all(), store.reasons
    errors = [
        volume_errors(
            truth.volume(i, "index_excess").values.numpy(), store.volume(i, "index_excess").values.numpy(), 1.00027
        )
        for i in range(1, len(sequence))
    ]
    seconds = float(np.mean(np.asarray(store.array("seconds")[:])[1:]))
    return (seconds, *(float(np.mean([e[k] for e in errors])) for k in ("l2", "l2_variation", "cc")))


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=[9, 4])
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--interval", type=float, default=1e-4, help="s between frames (the flame rises at 15 m/s)")
    parser.add_argument("--pixels", type=int, default=64)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--voxels", type=int, default=64)
    parser.add_argument("--preset", default="fast", choices=list(PRESETS))
    parser.add_argument("--device", default="auto")
    parser.add_argument("--cold", type=int, nargs="*", default=[200, 400, 800], help="steps of a frame from nothing")
    parser.add_argument("--warm", type=int, nargs="*", default=[60, 120, 240], help="steps of a frame from the last")
    parser.add_argument("--warm-rate", type=float, nargs="*", default=[0.5])
    parser.add_argument("--drift", type=int, nargs="*", default=[0, 40], help="steps in which the drift is found")
    parser.add_argument("--joint", type=int, nargs="*", default=[120, 240], help="steps a frame of a joint network")
    parser.add_argument("--time-octaves", type=int, nargs="*", default=[3])
    parser.add_argument("--write", type=Path, help="also write the table to this file")
    arguments = parser.parse_args()
    keep_freed_memory()
    lines = [
        f"Command: `python {shlex.join(sys.argv)}`  ",
        f"Machine: {machine()}  ",
        f"Date: {datetime.date.today().isoformat()}",
        "",
        "| views | how | steps a frame | seconds a frame | L2 | L2 of variation | CC |",
        "|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    base = replace(preset(arguments.preset), device=arguments.device, epochs=1e6)
    best = max([*arguments.cold, 1])
    kinds: list[tuple[str, int, NeRIF, dict[str, float]]] = []
    kinds += [("from nothing", n, replace(base, max_steps=n), {}) for n in arguments.cold]
    for n, rate, drift in itertools.product(arguments.warm, arguments.warm_rate, arguments.drift):
        name = f"from the one before, rate {rate:g}" + (", carried along" if drift else "")
        changes = {"warm_steps": n, "warm_rate": rate, "drift_steps": drift}
        kinds.append((name, n, replace(base, max_steps=best), changes))
    kinds += [
        (f"jointly, {k} octaves of time", n, base, {"joint_steps": n, "time_octaves": k})
        for n in arguments.joint
        for k in arguments.time_octaves
    ]
    with tempfile.TemporaryDirectory() as folder:
        for views in arguments.views:
            path = film(
                Path(folder), views, arguments.frames, arguments.pixels, arguments.interval, arguments.noise,
                arguments.voxels,
            )  # fmt: skip
            for name, steps, cold, changes in kinds:
                start = time.perf_counter()
                seconds, l2, variation, cc = run(path, Path(folder) / "out.zarr", cold, arguments.voxels, **changes)
                lines.append(f"| {views} | {name} | {steps} | {seconds:.2f} | {l2:.3%} | {variation:.2%} | {cc:.5f} |")
                print(lines[-1], f"  ({time.perf_counter() - start:.0f} s)", file=sys.stderr, flush=True)
    print("\n".join(lines[6:]))
    if arguments.write:
        arguments.write.write_text("# A film of a flame\n\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
