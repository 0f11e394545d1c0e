"""What a folder of the app holds: images, results, a run that is watched."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from nerif.app.project.jobs import Jobs
from nerif.common.files import write_json
from nerif.data.volume import Volume
from nerif.fields.phantoms import Flame
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.reconstruction.reconstructor import Outcome, Reconstruction
from nerif.results.directory import LIVE, LIVE_FIELD, ResultDirectory
from nerif.results.metrics_file import Metrics

__all__ = ["AMBIENT", "BOX", "OUT", "REPORT", "SIMULATE", "TARGET", "images", "result", "snapshot", "watched"]

BOX = Box((-25.0, -24.0, -20.0), (25.0, 24.0, 20.0))
AMBIENT = 1.00027
TARGET = CalibrationTarget("chessboard", 8, 5, pitch=12.0)
SIMULATE = ["--image-size", "20", "24", "--pixel-pitch", "0.18", "--views", "4", "--arc", "0", "135"]
SIMULATE += ["--truth-voxels", "8", "--steps", "20"]
OUT = "results/live <b>"
LOWER, UPPER = (-20.0, -15.0, -10.0), (20.0, 15.0, 10.0)
REPORT = """<!doctype html><title>r</title><p id=outcome>nothing</p><script>
const outcome = document.querySelector('#outcome'); outcome.textContent = 'run';
try { parent.document.title = 'taken'; outcome.textContent += ' reached' } catch { outcome.textContent += ' barred' }
fetch('/design').then(() => { outcome.textContent += ' fetched' }, () => { outcome.textContent += ' refused' });
</script>"""


def images(folder: Path, views: tuple[str, ...], counts: dict[str, int]) -> None:
    """Images of an upright target, by source; the third of a source, if it has one, is empty."""
    board = (40 + 170 * TARGET.raster(TARGET.pitch / 8)).astype(np.uint8)
    for name in views:
        for source, count in counts.items():
            (folder / name / source).mkdir(parents=True)
            for i in range(count):
                image = np.full((64, 96), 210, np.uint8)
                if i < 2:
                    image[4 : 4 + board.shape[0], 6 + i : 6 + i + board.shape[1]] = board
                iio.imwrite(folder / name / source / f"p{i}.png", image)


def result(path: Path, voxels: int, error: float) -> None:
    """A finished result of a flame, as nerif reconstruct leaves it, with standard deviations."""
    grid = Grid.of_resolution(BOX, voxels)
    values = Flame(BOX).sample(grid)
    directory = ResultDirectory(path)
    directory.begin({"measurement": "m.nc", "method": "tikhonov"})
    field = VoxelField.through(values, grid)
    directory.write_field(Reconstruction(field, BOX, AMBIENT, [], Outcome("converged", "by hand"), {}))
    index = Volume.of(values * (1 + error), grid, "index_excess", AMBIENT)
    directory.write_volumes([index, Volume.of((values * 0.02).abs(), grid, "index_excess_std", AMBIENT)])
    views = [
        {"name": str(i), "withheld": i == 0, "measured": "displacement", "unit": "px", "cc": 0.99, "rms": 0.01,
         "ssim": 0.99, "psnr": 40.0, "pixels": 100, "rms_predicted": 0.5, "rms_measured": 0.5} for i in range(5)
    ]  # fmt: skip
    trials = {"kind": "fast", "trials": 2, "diverged_trials": [], "seconds": 4.0}
    directory.write_metrics(Metrics(views=views, outcome="converged", seconds=12.0, uncertainty=trials))
    (path / "report.html").write_text(REPORT)


def snapshot(directory: Path, radius: float, seconds: float) -> None:
    """Leave a snapshot of a warm ball of that radius, mm, as a run does."""
    directory.mkdir(parents=True, exist_ok=True)
    z, y, x = np.meshgrid(*(np.linspace(-e, e, n) for e, n in ((9.5, 20), (14.5, 30), (19.5, 40))), indexing="ij")
    values = -1e-4 / (1 + np.exp(2 * (np.sqrt(x**2 + y**2 + z**2) - radius)))
    about = {
        "title": "training", "seconds": seconds, "quantity": "index_excess", "lower": LOWER, "upper": UPPER,
        "withheld": True, "view": "0", "components": ["u"], "unit": "px",
    }  # fmt: skip
    view = np.linspace(0, 1, 30, dtype=np.float32).reshape(5, 6, 1)
    part = directory / "part.npz"
    np.savez(part, about=np.array(json.dumps(about)), values=values.astype(np.float32), measured=view, predicted=view)
    part.replace(directory / LIVE_FIELD)


def watched(folder: Path) -> None:
    """Leave a run that has ended after two steps."""
    snapshot(folder / OUT, 6.0, 1.0)
    live: dict[str, Any] = {"title": "training", "step": 2, "seconds": 1.0, "progress": 1.0, "losses": {"loss": 0.5}}
    live |= {"written": time.time(), "view": "0", "curve": {"seconds": [0.5, 1.0], "step": [1, 2], "loss": [1, 0.5]}}
    write_json(folder / OUT / LIVE, live)
    jobs = Jobs(folder)
    job = jobs.add(["reconstruct", "m.nc", "--out", OUT, "--live"], "m.nc", OUT)
    write_json(jobs.directory / job.id / "started.json", {"pid": 1, "began": 0.0, "time": 1.0})
    write_json(jobs.directory / job.id / "ended.json", {"code": 0, "time": 2.0})
