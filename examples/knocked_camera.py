"""A camera is knocked after the calibration: found, named, and the field as good as if it had not been.

    python examples/knocked_camera.py out/knocked

The images are rendered, as in from_images.py, of a flame of 14 mm; the calibration of one camera is then moved by
0.3 mm, as if the camera had been calibrated there and knocked before the flow was photographed. No camera can see how
all of them moved together, so errors are compared after the best rigid motion of the field too.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import torch

from nerif.cli.cli import main
from nerif.data.cameras_file import read_cameras, write_cameras

KNOCKED, BY = "85deg", (0.3, 0.0, 0.0)  # mm along the camera's own axes
SIGMA = ("--pose-sigma-mm", 0.05, "--pose-sigma-deg", 0.005)  # as well as a bench as this holds its cameras


def nerif(*words: object) -> None:
    """Run one command of nerif, and stop where it fails."""
    print("$ nerif", *words, flush=True)
    code = main([str(word) for word in words])
    if code:
        sys.exit(code)


out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/knocked")
seconds = sys.argv[2] if len(sys.argv) > 2 else "60"
images = out / "images"
nerif("render", "-o", images, "--phantom", "flame", "--box", 14, 14, 14, "--image-size", 128, 128,
      "--pixel-pitch", 0.032, "--focal-length", 100, "--distance", 400, "--background-distance", 600,
      "--poses", 24, "--backgrounds", 3, "--force")  # fmt: skip
nerif("calibrate", images, "--config", images / "calibrate.toml", "-o", out / "good.toml", "--force")

# x_cam = R x + t: a centre that stands elsewhere by c along the camera's axes has t less by c
moved = torch.tensor(BY, dtype=torch.float64)
good = read_cameras(out / "good.toml")
assert KNOCKED in [camera.name for camera in good]
knocked = [replace(c, translation=c.translation - moved * (c.name == KNOCKED)) for c in good]
write_cameras(out / "knocked.toml", knocked)
box = ("--lower", -7, -7, -7, "--upper", 7, 7, 7, "--force")
for rig in ("good", "knocked"):
    nerif("displacement", images, "--calibration", out / f"{rig}.toml", "-o", out / f"{rig}.nc", *box)

nerif("check", out / "knocked.nc", "--refine", "cameras", *SIGMA, "--time-limit", seconds)

errors = {}
for name, rig, refine in (("good", "good", ()), ("knocked", "knocked", ()), ("refined", "knocked", ("cameras",))):
    more = ("--from", "displacements", *(("--refine", *refine, *SIGMA) if refine else ()))
    nerif("reconstruct", out / f"{rig}.nc", "-o", out / name, "--time-limit", seconds, "--voxels", 64, "--force", *more)
    nerif("evaluate", out / name, "--truth", images / "truth" / "volume.nc", "--align", "rigid")
    metrics = json.loads((out / name / "metrics.json").read_text(encoding="utf-8"))
    errors[name] = (metrics["l2"], metrics["aligned"]["l2"])

print(f"{'cameras':<10}{'L2':>9}{'aligned':>9}")
for name, (plain, aligned) in errors.items():
    print(f"{name:<10}{plain:>9.2%}{aligned:>9.2%}")
