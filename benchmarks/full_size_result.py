"""What follows the training of a full-size measurement: seconds and memory of re-projection, files and report.

    python benchmarks/full_size_result.py --views 12 --pixels 1024

A network is fitted to a flame, not trained on views, since only what comes after the training is looked at. What was
measured is the prediction plus noise of 5 %. Every stage is a process of its own, so that its peak memory is its own.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from bench import Table, add_write, alone
from nerif.analysis.evaluation import evaluate_views
from nerif.analysis.prediction import reproject
from nerif.data.measurement import Measurement
from nerif.data.reprojection import Reprojection
from nerif.fields.network import Network, NetworkShape, NeuralField
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.physics.quantities import GasSettings
from nerif.reconstruction.base import Outcome, Reconstruction
from nerif.reconstruction.neural.losses import MixedPrecision
from nerif.reconstruction.neural.warm_start import fit_network
from nerif.results.directory import ResultDirectory
from nerif.workflow.repeats import all_quantities
from nerif.workflow.reports import write_report

BOX, N_AMBIENT, NOISE = Box.cube(50.0), 1.00027, 0.05
COLUMNS = ("stage", "seconds", "of CPU", "peak [GiB]", "")
STAGES = ("prepare", "volume", "reproject", "score", "write", "report")


def prepare(out: ResultDirectory, measured: Path, views: int, pixels: int, steps: int) -> None:
    """Fit the network, and make the measurement of it."""
    torch.manual_seed(0)
    network = Network(NetworkShape())
    field = NeuralField(network, BOX, 1e-4)
    flame = make_phantom("flame", BOX, 0, 0.0)
    evaluator = MixedPrecision(network, torch.device("cpu"), "float32", "off")
    fit_network(field, evaluator, flame, steps, 4096, 2e-3, torch.Generator().manual_seed(0))
    network.eval().requires_grad_(False)
    result = Reconstruction(field, BOX, N_AMBIENT, [], Outcome("time_limit", "fitted"), {"model": "lever_arm"})
    out.begin({"method": "nerif", "measurement": str(measured)})
    out.write_field(result)
    out.write_metrics({"outcome": "time_limit", "message": "fitted", "seconds": 0.0})
    cameras = Ring(views=views, image_size=(pixels, pixels), pixel_pitch=0.02 * 200 / pixels).cameras()
    empty = Measurement(cameras, torch.zeros(views, pixels, pixels, 2), box=BOX, n_ambient=N_AMBIENT)
    predicted = reproject(field, empty).predicted
    sigma = NOISE * float(predicted.square().mean().sqrt())
    noisy = predicted + sigma * torch.randn(predicted.shape, generator=torch.Generator().manual_seed(1))
    replace(empty, displacement=noisy, sigma=torch.full_like(noisy, sigma)).write(measured)


def stage(name: str, folder: Path, views: int, pixels: int, steps: int) -> list[str]:
    """Do one stage, and return its row."""
    out, measured, kept = ResultDirectory(folder / "result"), folder / "m.nc", folder / "views.pt"
    note, data, views_seen = "", None, None
    if name in ("reproject", "score", "write"):
        data = Measurement.read(measured)
    if name in ("score", "write"):
        views_seen = Reprojection(data, {"deflection": torch.load(kept)}) if data else None
    began, before = time.perf_counter(), _cpu()
    if name == "prepare":
        prepare(out, measured, views, pixels, steps)
    elif name == "volume":
        field, box, n_ambient = out.field()
        result = Reconstruction(field, box, n_ambient, [], Outcome("time_limit", "fitted"), {"model": "lever_arm"})
        out.write_volumes(all_quantities(result, GasSettings(), 100))
    elif name == "reproject" and data is not None:
        found = reproject(out.field()[0], data)
        rms = float(found.predicted.square().mean().sqrt())
        sigma = NOISE * rms
        error = found.accuracies[0].error
        note = f"error {error:.2g} px = {error / rms:.2%} of rms d = {error / sigma:.3f} sigma"
        torch.save(found.predicted, kept)
    elif name == "score" and views_seen is not None:
        scores = evaluate_views(views_seen)
        out.add_metrics({"views": scores})
        note = f"rms over sigma {max(v['rms_over_sigma'] for v in scores):.4f}"
    elif name == "write" and views_seen is not None:
        out.write_reprojection(views_seen)
        note = f"{(out / 'reprojection.nc').stat().st_size / 2**20:.0f} MiB"
    elif name == "report":
        note = f"page of {write_report(out.path).stat().st_size / 1e6:.1f} MB"
    seconds, busy = time.perf_counter() - began, _cpu() - before
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return [name, f"{seconds:.1f}", f"{busy:.1f}", f"{peak:.2f}", note]


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Run the stages one after the other and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--pixels", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=300, help="of the fit of the network")
    parser.add_argument("--folder", type=Path, help="where the files are kept; default: a temporary one")
    add_write(parser)
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp())
    more = f"; {given.views} views of {given.pixels} x {given.pixels} px, network fitted in {given.steps} steps"
    table = Table("What follows the training of full-size views", COLUMNS, given.write, more)
    for name in STAGES:
        table.row(alone(stage, name, folder, given.views, given.pixels, given.steps))


if __name__ == "__main__":
    main()
