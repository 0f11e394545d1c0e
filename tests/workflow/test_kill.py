"""A reconstruction that is killed at any instant and resumed gives the result of one that was not."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import sys
import time
from pathlib import Path

import pytest
import torch

from nerif.data.measurement import Measurement
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Grid
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.results.directory import ResultDirectory
from nerif.workflow import pipeline
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings
from nerif.workflow.steps import STEPS

if sys.platform == "win32":
    pytest.skip("kills processes by a POSIX signal", allow_module_level=True)

CONTEXT = multiprocessing.get_context("forkserver")
PRELOADED = ["pytest", "xarray", "h5netcdf", "scipy.ndimage", "matplotlib.figure", "nerif.workflow.steps"]
RUN = RunSettings(uncertainty="fast", checkpoint_every=0.0)
NETWORK = NetworkShape(depth=2, width=32, octaves=3)
METHODS: dict[str, Reconstructor] = {
    "nerif": NeRIF(max_steps=60, points_per_batch=512, network=NETWORK, refine=("cameras",), device="cpu"),
    "tv": TotalVariation(voxels=16, device="cpu"),
}
KILLS = 15  # of each method
STAGES = [*(step.__name__ for step in STEPS), "judge", "write_page"]
UNREPEATED = {"run.toml", "metrics.json", "report.html", "history.csv", "written.json"}  # hold times


def reconstruct(out: Path, data: Path, method: str, stage: str = "") -> None:
    """Reconstruct, or resume what was begun; the process is killed where a stage begins."""
    torch.set_num_threads(1)
    kill = lambda *_: os.kill(os.getpid(), signal.SIGKILL)  # noqa: E731
    pipeline.STEPS = tuple(kill if step.__name__ == stage else step for step in STEPS)  # type: ignore[misc]
    if hasattr(pipeline, stage):
        setattr(pipeline, stage, kill)
    reconstruct_into(out, data, METHODS[method], RUN, voxels=16, resume=(out / "run.toml").exists())


def run(*arguments: object, seconds: float | None = None) -> int | None:
    """Run `reconstruct` in a process of its own, killed after some seconds; return its exit code."""
    CONTEXT.set_forkserver_preload(PRELOADED)  # so that a process starts in no time
    process = CONTEXT.Process(target=reconstruct, args=arguments)
    process.start()
    process.join(seconds)
    process.kill()
    process.join()
    return process.exitcode


def content(out: Path) -> set[str]:
    return {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}


def compare(out: Path, complete: Path) -> None:
    """Expect the same files, and those that hold no times to be the same to the bit."""
    assert content(out) == content(complete)
    (a, box, _), (b, *_) = ResultDirectory(out).field(), ResultDirectory(complete).field()
    points = Grid.of_resolution(box, 11).points().reshape(-1, 3)
    assert torch.equal(a(points), b(points))
    for quantity, volume in ResultDirectory(complete).volumes().items():
        assert torch.equal(volume.values, ResultDirectory(out).volumes()[quantity].values), quantity
    scores = [[v["rms"] for v in ResultDirectory(d).metrics().views] for d in (out, complete)]
    assert scores[0] == scores[1]


@pytest.fixture(scope="module", params=METHODS)
def complete(request, measurement: Measurement, tmp_path_factory) -> tuple[Path, str, float]:
    """A measurement, the name of a method, and the time of a run that nobody disturbs, in the folder `complete`."""
    folder = tmp_path_factory.mktemp(request.param)
    measurement.write(folder / "m.nc")
    start = time.perf_counter()
    assert run(folder / "complete", folder / "m.nc", request.param) == 0
    return folder, request.param, time.perf_counter() - start


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_a_run_killed_where_a_stage_begins_is_resumed(complete, stage):
    folder, method, _ = complete
    out = folder / stage
    assert run(out, folder / "m.nc", method, stage) == -signal.SIGKILL
    assert run(out, folder / "m.nc", method) == 0
    compare(out, folder / "complete")


@pytest.mark.slow
def test_a_run_killed_at_random_instants_is_resumed(complete):
    folder, method, seconds = complete
    instants = random.Random(7)
    for kill in range(KILLS):
        out = folder / f"random{kill}"
        code = run(out, folder / "m.nc", method, seconds=instants.uniform(0, seconds))
        assert code in (0, -signal.SIGKILL)
        if code:
            assert run(out, folder / "m.nc", method) == 0
        compare(out, folder / "complete")
