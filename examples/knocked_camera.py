"""A camera is knocked after the calibration: found, named, and the field as good as if it had not been.

    python examples/knocked_camera.py out/knocked

The pictures are rendered, as in from_images.py; the calibration of one camera is then moved by 0.3 mm, as if the camera
had been calibrated there and knocked before the flow was photographed.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import torch

from nerif.cli import main
from nerif.imaging.cameras_file import read_cameras, write_cameras

KNOCKED, BY = "cam5", (0.3, 0.0, 0.0)  # mm along the camera's own axes


def nerif(*words: object) -> None:
    """Run one command of nerif, and stop where it fails."""
    print("$ nerif", *words, flush=True)
    code = main([str(word) for word in words])
    if code:
        sys.exit(code)


out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/knocked")
seconds = sys.argv[2] if len(sys.argv) > 2 else "45"
pictures = out / "pictures"
nerif("render", "-o", pictures, "--phantom", "flame", "--image-size", 128, 128, "--pixel-pitch", 0.032,
      "--background-distance", 1000, "--poses", 24, "--backgrounds", 3, "--force")  # fmt: skip
nerif("calibrate", pictures, "--config", pictures / "calibrate.toml", "-o", out / "good.toml", "--force")

# x_cam = R x + t: a centre that stands elsewhere by c along the camera's axes has t less by c
moved = torch.tensor(BY, dtype=torch.float64)
write_cameras(
    out / "knocked.toml",
    [replace(c, translation=c.translation - moved * (c.name == KNOCKED)) for c in read_cameras(out / "good.toml")],
)
box = ("--lower", -25, -25, -25, "--upper", 25, 25, 25, "--force")
for rig in ("good", "knocked"):
    nerif("displacement", pictures, "--calibration", out / f"{rig}.toml", "-o", out / f"{rig}.nc", *box)

nerif("check", out / "knocked.nc", "--refine", "cameras")

errors = {}
for name, rig, refine in (("good", "good", ()), ("knocked", "knocked", ()), ("refined", "knocked", ("cameras",))):
    more = ("--refine", *refine) if refine else ()
    nerif("reconstruct", out / f"{rig}.nc", "-o", out / name, "--time-limit", seconds, "--voxels", 64, "--force", *more)
    nerif("evaluate", out / name, "--truth", pictures / "truth" / "volume.nc", "--align", "rigid")
    metrics = json.loads((out / name / "metrics.json").read_text())
    errors[name] = (metrics["l2"], metrics["aligned"]["l2"])

print(f"{'cameras':<10}{'L2':>9}{'aligned':>9}")
for name, (plain, aligned) in errors.items():
    print(f"{name:<10}{plain:>9.2%}{aligned:>9.2%}")
