"""A film of a flame, frame by frame.

9 and 4 views; every frame from nothing (cold), or from the frame before (warm). Seconds are those of a whole frame:
training, sampling the volume, comparing with the views, writing. Errors and seconds are means over the last frames;
warm frames begin with the best of the cold ones, so that what they accumulate counts. Faster: the time in which cold
frames reach the same error (linear in logarithms between the two nearest; a bound outside of them), over the time
taken. Change: difference between frames of the truth, of its variation. Needs the extra `sequence`.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runner import N_AMBIENT, Settings
from nerif.analysis.metrics import volume_errors
from nerif.cli.commands.simulate import Simulate
from nerif.cli.commands.simulate import run as simulate
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume_sequence import VolumeSequence
from nerif.geometry import Ring
from nerif.reconstruction.neural.presets import preset as settings_of
from nerif.simulation.simulated_rig import SimulatedRig
from nerif.simulation.simulation import Simulation
from nerif.workflow.sequence.chunk import reconstruct_frames
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.store import DONE, Frame, SequenceStore

COLUMNS = {
    "views": "{views}", "s between frames": "{interval:g}", "change": "{change:.0%}", "start": "{start}",
    "rate": "{rate:g}", "steps a frame": "{steps}", "seconds a frame": "{time:.2f}", "L2": "{l2:.3%}",
    "L2 of variation": "{l2_variation:.2%}", "CC": "{cc:.5f}", "faster": "{faster}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    size = {"frames": 9, "compared": 3, "pixels": 64, "noise": 0.05, "voxels": 64, "preset": "fast", "device": "auto"}
    size |= {"frames": 2, "compared": 1, "pixels": 12, "voxels": 12} if quick else {}
    cold, warm = ([5], [5]) if quick else ([250, 500, 1000], [80, 160, 320])
    for views, interval in [(3, 1e-4)] if quick else itertools.product((9, 4), (2.5e-5, 5e-5, 1e-4)):
        case = {"views": views, "interval": interval, **size}
        for steps in cold:
            yield case | {"start": "cold", "rate": 0.0, "steps": steps, "first": 0}
        for steps in warm:
            yield case | {"start": "warm", "rate": 0.7, "steps": steps, "first": max(cold)}


def film(folder: Path, views: int, frames: int, pixels: int, interval: float, noise: float, voxels: int) -> Path:
    """Simulate a film once for all cases; the truth lies beside it."""
    out = folder / f"film-{views}-{frames}-{pixels}-{interval:g}-{noise:g}-{voxels}.zarr"
    if not out.exists():
        ring = Ring(views=views, image_size=(pixels, pixels), pixel_pitch=0.02 * 200 / pixels)
        simulation = Simulation(noise=noise, truth_voxels=voxels)
        times, rig = f"0:{(frames - 1) * interval}:{frames}", SimulatedRig(ring=ring)
        simulate(Simulate(out=out, times=times, simulation=simulation, rig=rig))
    return out


def begin(path: Path, out: Path, steps: int, settings: SequenceSettings, preset: str, device: str) -> SequencePlan:
    """Return a plan of frames from nothing, its store written."""
    sequence = MeasurementSequence.read(path)
    cold = replace(settings_of(preset), device=device, max_steps=steps)
    cold = replace(cold, network=cold.resolved_by(sequence.fullest()).network, wave_pixels=0)
    plan = SequencePlan(path, out, cold, settings)
    grid = VolumeSequence(path.with_name(path.stem + ".truth.zarr")).grid
    SequenceStore.begin(out, sequence, grid, settings.quantities, cold.network, plan.attributes)
    return plan


def measure(
    folder: Path, views: int, interval: float, frames: int, compared: int, pixels: int, noise: float, voxels: int,
    preset: str, device: str, start: str, rate: float, steps: int, first: int,
) -> dict[str, Any]:  # fmt: skip
    path = film(folder, views, frames, pixels, interval, noise, voxels)
    settings = SequenceSettings(chunk=frames, voxels=voxels, quantities=("index_excess",))
    if start == "warm":
        settings = replace(settings, warm_steps=steps, warm_rate=rate)
    last = range(frames - compared, frames)
    truth = VolumeSequence(path.with_name(path.stem + ".truth.zarr"))

    def values(i: int) -> np.ndarray:
        return truth.volume(i, "index_excess").values.numpy()

    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        plan = begin(path, Path(temporary) / "out.zarr", first or steps, settings, preset, device)
        store = SequenceStore(plan.out)
        if start == "warm":
            cold = first_frame(path, folder, first, settings, preset, device)
            store.write_frame(0, Frame(cold.field(0), [cold.volume(0, "index_excess")], [], 0.0, 0))
            reconstruct_frames(plan, 0, frames)
        else:
            for i in last:
                reconstruct_frames(plan, i, i + 1)
        assert all(store.status[i] == DONE for i in last), store.reasons
        errors = [volume_errors(values(i), store.volume(i, "index_excess").values.numpy(), N_AMBIENT) for i in last]
        seconds = float(np.mean([store.array("seconds")[i] for i in last]))
    changes = [volume_errors(values(i + 1), values(i), N_AMBIENT)["l2_variation"] for i in range(frames - 1)]
    means = {name: float(np.mean([e[name] for e in errors])) for name in ("l2", "l2_variation", "cc")}
    return {"time": seconds, "change": float(np.mean(changes)), **means}


def first_frame(
    path: Path, folder: Path, steps: int, settings: SequenceSettings, preset: str, device: str
) -> SequenceStore:
    """Return the store of the frame that warm starts begin with, reconstructed once for all of them."""
    out = folder / f"first-{path.stem}-{steps}.zarr"
    if not out.exists():
        reconstruct_frames(begin(path, out, steps, settings, preset, device), 0, 1)
    return SequenceStore(out)


def derive(rows: list[dict[str, Any]]) -> None:
    for row in rows:
        group = [r for r in rows if (r["views"], r["interval"]) == (row["views"], row["interval"])]
        cold = sorted((r["l2"], r["time"]) for r in group if r["start"] == "cold" and "l2" in r)
        if row["start"] == "warm" and len(cold) > 1 and "l2" in row:
            errors, times = np.log(cold).T
            sign = ">" if row["l2"] < cold[0][0] else "<" if row["l2"] > cold[-1][0] else ""
            row["faster"] = f"{sign} {np.exp(np.interp(np.log(row['l2']), errors, times)) / row['time']:.1f}".strip()
