"""nerif render: pictures of a whole experiment with a phantom, and its truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.atomic import atomic
from nerif.commands.output import check_directory, say
from nerif.commands.settings import Settings, read_settings, to_toml
from nerif.conventions import InputError
from nerif.experiment import Experiment, background_scale, world_axes
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.imaging.cameras_file import CalibratedCamera, write_cameras
from nerif.volume import Volume, write_netcdf

__all__ = ["Render", "main", "run"]


@dataclass(frozen=True)
class Render(Settings):
    """Render the pictures that a rig would take: targets, background without and with flow; the truth comes with them.

    In the folder OUT: VIEW/target, VIEW/background, VIEW/reference, VIEW/flow for nerif calibrate and nerif
    displacement; calibrate.toml, the settings for the former; truth/calibration.toml and truth/volume.nc to
    compare with.
    """

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder to write."""
    phantom: str = "flame"
    """One of gaussians, flame, octahedron, 1-7 (the paper's numbers)."""
    phantom_seed: int = 0
    """Of the phantom."""
    box: tuple[float, float, float] = (50.0, 50.0, 50.0)
    """Edges of the box around the origin, along x y z, mm."""
    n_ambient: float = 1.00027
    """Refractive index around the flow."""
    truth_voxels: int = 100
    """Voxels of the truth along the longest edge."""
    force: bool = False
    """Write into a folder that holds something."""
    pictures: Annotated[Experiment, tyro.conf.arg(name="")] = field(default_factory=Experiment)
    ring: Annotated[Ring, tyro.conf.arg(name="")] = field(default_factory=Ring)


def run(settings: Render) -> None:
    """Write pictures and truth."""
    from rich.console import Console
    from rich.progress import Progress

    if settings.truth_voxels < 1:
        raise InputError(f"truth_voxels: expected at least 1, got {settings.truth_voxels}")
    check_directory(settings.out, settings.force)
    cameras = settings.ring.cameras()
    x, y, z = (e / 2 for e in settings.box)
    box = Box((-x, -y, -z), (x, y, z))
    phantom = make_phantom(settings.phantom, box, settings.phantom_seed)
    truth = settings.out / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    target = settings.pictures.target_for(cameras)
    axes = ", ".join(f'"{a}"' for a in world_axes(cameras))
    with atomic(settings.out / "calibrate.toml") as part:
        scale = background_scale(cameras)
        part.write_text(f'world = "0"\naxes = [{axes}]\nbackground_scale = {scale}\n\n[target]\n{to_toml(target)}')
    write_cameras(truth / "calibration.toml", [CalibratedCamera.from_camera(c) for c in cameras])
    grid = Grid.of_resolution(box, settings.truth_voxels)
    write_netcdf(
        truth / "volume.nc", [Volume(phantom.sample(grid), grid, attributes={"n_ambient": settings.n_ambient})]
    )
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("rendering", total=settings.pictures.pictures(len(cameras)))
        settings.pictures.write(
            settings.out, cameras, phantom, box, settings.n_ambient, settings.ring.focal_length,
            lambda: bar.advance(task),
        )  # fmt: skip
    say(f"{settings.out}: pictures of {len(cameras)} views, {settings.pictures.sensor.bits} bit")
    say(f"target: {target.kind} of {target.columns} x {target.rows}, pitch {target.pitch:.4g} mm")
    say(f"next: nerif calibrate {settings.out} --config {settings.out / 'calibrate.toml'} -o calibration.toml")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Render(out=tyro.MISSING), arguments, "render"))
