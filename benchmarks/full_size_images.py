"""Cameras of full size: seconds and memory of nerif displacement, mask and check on 12 views of 2048 x 2048 px.

    python benchmarks/full_size_images.py --write benchmarks/results/full-size-images-cpu.md
    python benchmarks/full_size_images.py --pixels 256 --views 4          # a quick trial

The images are random dots with noise, displaced by what a smooth blob of hot gas in the middle of the box does to
parallel rays; each command is a process of its own, its children's memory with it. Two figures of memory: the largest
process, and the largest sum over all processes at one moment.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import tifffile
from scipy.ndimage import gaussian_filter, map_coordinates

from bench import Table, add_write
from nerif.geometry import Camera, Ring
from nerif.imaging.calibration.cameras_file import CalibratedCamera, write_cameras

COLUMNS = ("command", "seconds", "largest process [GiB]", "all processes together [GiB]", "exit code")
LARGEST = 3.0  # px
BOX = ("--lower", "-25", "-25", "-25", "--upper", "25", "25", "25")


def write_view(folder: Path, camera: Camera, references: int, seed: int) -> None:
    """Write the images of one view: a 12-bit camera before dots of about 3 px."""
    rng = np.random.default_rng(seed)
    height, width = camera.image_size
    dots = gaussian_filter((rng.random((height + 16, width + 16)) < 0.04).astype(np.float32), 1.2)
    dots = np.clip(dots / np.percentile(dots, 99), 0, 1)
    rows, columns = np.arange(height, dtype=np.float32)[:, None], np.arange(width, dtype=np.float32)[None]
    y, x = (rows - height / 2) / (height / 5), (columns - width / 2) / (width / 5)
    bump = LARGEST * math.sqrt(2 * math.e) * np.exp(-(x**2) - y**2)  # gradient of a Gaussian blob
    for source, count, size in (("reference", references, 0.0), ("flow", 1, 1.0)):
        seen = map_coordinates(dots, [rows + 8 - size * y * bump, columns + 8 - size * x * bump], order=3)
        path = folder / camera.name / source
        path.mkdir(parents=True)
        for i in range(count):
            grey = 300 + 3000 * seen + 12 * rng.standard_normal(seen.shape, dtype=np.float32)
            tifffile.imwrite(path / f"{source}_{i}.tif", np.clip(grey, 0, 4095).astype(np.uint16))


def write_images(folder: Path, views: int, pixels: int, references: int) -> None:
    """Write an experiment: the images of all views, and their calibration."""
    ring = Ring(views=views, arc=(0.0, 165.0), pixel_pitch=0.02 * 200 / pixels, image_size=(pixels, pixels))
    cameras = ring.cameras()
    for seed, camera in enumerate(cameras):
        write_view(folder / "images", camera, references, seed)
    write_cameras(folder / "calibration.toml", [CalibratedCamera.from_camera(c) for c in cameras])


def run(words: list[str]) -> tuple[float, float, float, int]:
    """Run nerif in a process; seconds, GiB of its largest process and of all together, exit code."""
    started = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "nerif", *words])
    largest, together = [0], [0]

    def watch() -> None:
        parent = psutil.Process(process.pid)
        while process.poll() is None:
            sizes = []
            try:
                for p in (parent, *parent.children(recursive=True)):
                    memory = p.memory_full_info()
                    sizes.append(getattr(memory, "pss", 0) or memory.rss)
            except psutil.Error:
                pass
            largest[0], together[0] = max(largest[0], *sizes, 0), max(together[0], sum(sizes))
            time.sleep(0.2)

    watcher = threading.Thread(target=watch)
    watcher.start()
    code = process.wait()
    watcher.join()
    return time.perf_counter() - started, largest[0] / 2**30, together[0] / 2**30, code


def main() -> None:
    """Make the images, run the commands, print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixels", type=int, default=2048)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--references", type=int, default=5)
    parser.add_argument("--folder", type=Path, help="where to keep images and results; a temporary one if left out")
    add_write(parser)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        if not (folder / "calibration.toml").exists():
            write_images(folder, given.views, given.pixels, given.references)
        calibration, measured, masked = (str(folder / n) for n in ("calibration.toml", "m.nc", "masked.nc"))
        commands = {
            "displacement": [str(folder / "images"), "--calibration", calibration, *BOX, "-o", measured, "--force"],
            "mask": [measured, "-o", masked, "--force"],
            "check": [masked],
        }
        size = f"{given.views} views of {given.pixels} x {given.pixels} px, {given.references} reference images each"
        table = Table("Images of full size", COLUMNS, given.write, f"; {size}")
        for verb, words in commands.items():
            seconds, largest, together, code = run([verb, *words])
            table.row((verb, f"{seconds:.0f}", f"{largest:.2f}", f"{together:.2f}", str(code)))


if __name__ == "__main__":
    main()
