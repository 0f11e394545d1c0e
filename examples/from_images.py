"""The whole road, from images alone: calibrate nine cameras, find displacements, check, reconstruct, see how good.

    python examples/from_images.py out/from_images

The images are rendered here, small ones, so that there is a truth to compare with; in the laboratory they come from
your cameras, in the same folders. Each line is what you would type: nerif calibrate FOLDER ..., nerif displacement ...
"""

from __future__ import annotations

import sys
from pathlib import Path

from nerif.cli.cli import main


def nerif(*words: object) -> None:
    """Run one command of nerif, and stop where it fails."""
    print("$ nerif", *words, flush=True)
    code = main([str(word) for word in words])
    if code:
        sys.exit(code)


out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/from_images")
images = out / "images"

# Stands in for the laboratory: VIEW/target, VIEW/background, VIEW/reference, VIEW/flow for each of nine views.
nerif("render", "-o", images, "--phantom", "flame", "--image-size", 128, 128, "--pixel-pitch", 0.032,
      "--background-distance", 1000, "--poses", 24, "--backgrounds", 3, "--force")  # fmt: skip

# Which target, and which of its poses is the world, stands in a small file; on the command line: --target.kind ...
nerif("calibrate", images, "--config", images / "calibrate.toml", "-o", out / "calibration.toml", "--force")

nerif("displacement", images, "--calibration", out / "calibration.toml", "--lower", -25, -25, -25,
      "--upper", 25, 25, 25, "-o", out / "measurement.nc", "--force")  # fmt: skip

# Swapped components, flipped signs, mirrored and exchanged views would be named here, and flow that leaves the box.
nerif("check", out / "measurement.nc")

nerif("reconstruct", out / "measurement.nc", "-o", out / "result", "--time-limit", 30, "--voxels", 64, "--force")

# The truth was never looked at so far.
nerif("evaluate", out / "result", "--truth", images / "truth" / "volume.nc")
