"""Short films of a small flame, and the settings that reconstruct them in seconds."""

from __future__ import annotations

from pathlib import Path

from nerif.cli.cli import main
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.fields.network_shape import NetworkShape
from nerif.reconstruction.neural.neural import NeRIF

RIG = ["--image-size", "14", "16", "--pixel-pitch", "0.3", "--views", "3", "--steps", "20", "--truth-voxels", "12"]
QUICK = [
    "--network.depth", "2", "--network.width", "16", "--network.octaves", "2", "--max-steps", "40",
    "--samples", "8", "12", "--sample-jitter", "2", "--points-per-batch", "400", "--device", "cpu",
    "--precision", "float32", "--warm-steps", "20", "--voxels", "12",
]  # fmt: skip

COLD = NeRIF(
    network=NetworkShape(depth=2, width=16, octaves=2), samples=(8, 12), sample_jitter=2, points_per_batch=400,
    max_steps=30, device="cpu", precision="float32",
)  # fmt: skip
"""Frames that start from nothing."""


def simulated(out: Path, frames: int) -> Path:
    """Simulate a number of frames, a tenth of a millisecond apart."""
    times = f"0:{(frames - 1) * 1e-4}:{frames}"
    assert main(["simulate", "--phantom", "flame", "--times", times, "--noise", "0.05", "-o", str(out), *RIG]) == 0
    return out


def blank(path: Path, frame: int, view: int | None = None) -> None:
    """Make a frame, or one view of it, NaN."""
    import zarr

    displacement = zarr.open_group(path, mode="r+")["displacement"]
    if view is None:
        displacement[frame] = float("nan")
    else:
        displacement[frame, view] = float("nan")
    assert len(MeasurementSequence.read(path)) > frame
