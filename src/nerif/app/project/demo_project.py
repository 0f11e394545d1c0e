"""The project of `nerif app --demo`: a small experiment, rendered when the command starts."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from nerif.app.project.folder import OWN
from nerif.cli.output import counting_bar, say
from nerif.common.conventions import AMBIENT_INDEX, InputError
from nerif.common.files import read_json, write_json
from nerif.common.interruption import if_interrupted
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.simulation.experiment import Experiment

__all__ = ["EDGE", "FOLDER", "IMAGES", "RIG", "fill", "is_demo"]

FOLDER, IMAGES = Path("nerif-demo"), "images"
MARK = f"{OWN}/demo.json"
EDGE = 50.0  # of the box of the flow, mm
TRUTH_VOXELS = 48
RIG: dict[str, Any] = {
    "views": 6, "arc": (0.0, 150.0), "image_size": (96, 96), "pixel_pitch": 0.043, "background_distance": 1000.0,
}  # fmt: skip
"""Settings of the rig that differ from the defaults of Ring."""


def is_demo(folder: Path) -> bool:
    """Whether a folder is a project of `nerif app --demo`."""
    return (folder / MARK).is_file()


def fill(folder: Path) -> None:
    """Render the experiment into a new or an empty folder; a complete one stays as it is."""
    mark = folder / MARK
    if folder.exists() and not folder.is_dir():
        raise InputError("expected a new folder for --demo, got a file; give another name", field=folder)
    if not mark.is_file() and folder.is_dir() and (names := sorted(path.name for path in folder.iterdir())):
        raise InputError(
            f"expected a new or an empty folder for --demo, or one of an earlier --demo, got one with {names[0]}; "
            f"give another name, such as nerif app {FOLDER} --demo",
            field=folder,
        )
    if _is_complete(mark):
        say(f"{folder}: the demo of an earlier start; delete the folder to begin again")
        return
    mark.parent.mkdir(parents=True, exist_ok=True)
    write_json(mark, {"complete": False})
    say(f"{folder}: rendering a small experiment, about 10 s")
    render(folder / IMAGES)
    (folder / IMAGES / "truth" / "calibration.toml").unlink()  # else pages offer it beside the one to be made
    write_json(mark, {"complete": True})


def render(folder: Path) -> None:
    """Render the images of a flame and of a calibration target."""
    cameras, box = Ring(**RIG).cameras(), Box.cube(EDGE)
    experiment = Experiment(references=2, poses=10, backgrounds=2)
    count = itertools.count(1)
    remedy = "images are missing; run the same command again"
    with if_interrupted(lambda: remedy), counting_bar("rendering", experiment.images(len(cameras))) as bar:
        phantom = make_phantom("flame", box)
        experiment.write(folder, cameras, phantom, box, AMBIENT_INDEX, TRUTH_VOXELS, lambda: bar(next(count)))


def _is_complete(mark: Path) -> bool:
    """Whether all images are there: an interrupted start renders them again."""
    try:
        return bool(read_json(mark)["complete"])
    except (OSError, ValueError, KeyError, TypeError):
        return False
