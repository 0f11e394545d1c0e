"""nerif render: images of an experiment with a phantom, and the true field."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import AMBIENT_INDEX
from nerif.common.installation import command_line, word_of
from nerif.common.interruption import if_interrupted
from nerif.common.settings import Flat
from nerif.simulation.experiment_settings import ExperimentSettings
from nerif.simulation.simulated_rig import SimulatedRig

__all__ = ["Render", "main", "run"]


@dataclass(frozen=True)
class Render(Settings):
    """Render the images that a rig would take: targets, background without and with flow; and write the true field.

    In the folder OUT: VIEW/target, VIEW/background, VIEW/reference, VIEW/flow for nerif calibrate and nerif
    displacement; calibrate.toml with the settings of the former; truth/calibration.toml and truth/volume.nc.
    """

    out: Path
    """Folder to write."""
    phantom: str = "flame"
    """Phantom: gaussians, flame, octahedron, turbulence, fire, gaussian-jet, plume, underexpanded, or 1 to 7 (numbers
    of the paper)."""
    phantom_seed: int = 0
    """Random seed of the phantom."""
    box: tuple[float, float, float] = (50.0, 50.0, 50.0)
    """Edges of the box, centred on the origin, along x y z, mm."""
    n_ambient: float = AMBIENT_INDEX
    """Refractive index around the flow."""
    truth_voxels: int = 100
    """Voxels of the true field along the longest edge."""
    force: bool = False
    """Write into a folder that is not empty."""
    images: Annotated[ExperimentSettings, Flat] = field(default_factory=ExperimentSettings)
    rig: Annotated[SimulatedRig, Flat] = field(default_factory=SimulatedRig)


def run(settings: Render) -> None:
    """Write images and true field."""
    from nerif.fields.phantoms import make_phantom
    from nerif.geometry import Box
    from nerif.results.directory import ResultDirectory
    from nerif.simulation.experiment import Experiment

    directory = ResultDirectory(settings.out)
    directory.check_free(settings.force)
    cameras, images = settings.rig.cameras(), Experiment(**vars(settings.images))
    box = Box.around_origin(settings.box)
    phantom = make_phantom(settings.phantom, box, settings.phantom_seed)
    count = itertools.count(1)
    remedy = f"{settings.out} lacks images; run the same command with --force to start again"
    total = images.images(len(cameras))
    with directory.locked(), if_interrupted(lambda: remedy), counting_bar("rendering", total) as bar:
        images.write(
            settings.out, cameras, phantom, box, settings.n_ambient, settings.truth_voxels,
            lambda: bar(next(count)),
        )  # fmt: skip
    say(f"{settings.out}: images of {len(cameras)} views, {images.sensor.bits} bit")
    if images.poses:
        say(f"target: {images.target_for(cameras).label}")
        words = ["calibrate", word_of(settings.out), "--config", word_of(settings.out / "calibrate.toml")]
        words += ["-o", "calibration.toml"]
    else:
        truth = word_of(settings.out / "truth" / "calibration.toml")
        words = ["displacement", word_of(settings.out), "--calibration", truth, "-o", "measurement.nc"]
    say(f"next: {command_line(words)}")


main = command("render", Render, run)
