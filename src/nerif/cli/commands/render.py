"""nerif render: images of a whole experiment with a phantom, and its truth."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import counting_bar, say
from nerif.cli.commands.settings import Flat, Settings, read_settings
from nerif.common.conventions import AMBIENT_INDEX
from nerif.common.interruption import if_interrupted
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.results.directory import ResultDirectory
from nerif.simulation.experiment import Experiment

__all__ = ["Render", "main", "run"]


@dataclass(frozen=True)
class Render(Settings):
    """Render the images that a rig would take: targets, background without and with flow; the truth comes with them.

    In the folder OUT: VIEW/target, VIEW/background, VIEW/reference, VIEW/flow for nerif calibrate and nerif
    displacement; calibrate.toml, the settings for the former; truth/calibration.toml and truth/volume.nc to
    compare with.
    """

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder to write."""
    phantom: str = "flame"
    """One of gaussians, flame, octahedron, turbulence, fire, gaussian-jet, plume, underexpanded, 1-7 (the paper's
    numbers)."""
    phantom_seed: int = 0
    """Of the phantom."""
    box: tuple[float, float, float] = (50.0, 50.0, 50.0)
    """Edges of the box around the origin, along x y z, mm."""
    n_ambient: float = AMBIENT_INDEX
    """Refractive index around the flow."""
    f_number: float = 0.0
    """Focal length over aperture of the lenses, focused on the backgrounds; 0 for pinholes."""
    truth_voxels: int = 100
    """Voxels of the truth along the longest edge."""
    force: bool = False
    """Write into a folder that holds something."""
    images: Annotated[Experiment, Flat] = field(default_factory=Experiment)
    ring: Annotated[Ring, Flat] = field(default_factory=Ring)


def run(settings: Render) -> None:
    """Write images and truth."""
    ResultDirectory(settings.out).check_free(settings.force)
    cameras, images = settings.ring.cameras(settings.f_number), settings.images
    box = Box.around_origin(settings.box)
    phantom = make_phantom(settings.phantom, box, settings.phantom_seed)
    count = itertools.count(1)
    begun = f"{settings.out} lacks images; the same command with --force starts again"
    with if_interrupted(lambda: begun), counting_bar("rendering", images.images(len(cameras))) as bar:
        images.write(
            settings.out, cameras, phantom, box, settings.n_ambient, settings.truth_voxels,
            lambda: bar(next(count)),
        )  # fmt: skip
    target = images.target_for(cameras)
    say(f"{settings.out}: images of {len(cameras)} views, {images.sensor.bits} bit")
    say(f"target: {target.label}")
    say(f"next: nerif calibrate {settings.out} --config {settings.out / 'calibrate.toml'} -o calibration.toml")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Render(out=tyro.MISSING), arguments, "render"))
