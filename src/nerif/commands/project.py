"""nerif project: the displacement that any camera would see of a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro

from nerif.commands.output import check_file, say
from nerif.commands.settings import Settings, read_settings
from nerif.conventions import InputError
from nerif.evaluation import predict_view
from nerif.geometry import Ring
from nerif.measurement import Measurement
from nerif.physics.deflection import Deflection, ForwardModel
from nerif.physics.ray_tracing import CurvedRays
from nerif.reconstruction.files import read_field

__all__ = ["Project", "main", "run"]


@dataclass(frozen=True)
class Project(Settings):
    """Predict the displacement that cameras would see of a reconstruction, and write it as a measurement."""

    result: Annotated[Path, tyro.conf.Positional]
    """Result directory of nerif reconstruct."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Measurement to write, NAME.nc."""
    cameras: Path | None = None
    """Measurement file whose cameras to use; without it, the ring described below."""
    names: tuple[str, ...] = ()
    """Names of the cameras of that file to use; none for all."""
    model: str = "lever_arm"
    """Forward model: lever_arm, paraxial or curved."""
    samples: int = 200
    """Samples (or Runge-Kutta steps) along a ray."""
    force: bool = False
    """Overwrite an existing file."""
    ring: Annotated[Ring, tyro.conf.arg(name="")] = field(default_factory=Ring)


def run(settings: Project) -> Measurement:
    """Write the predicted measurement and return it."""
    if settings.out.suffix != ".nc":
        raise InputError(f"out: expected a name ending in .nc, got '{settings.out.name}'")
    if settings.model not in ("lever_arm", "paraxial", "curved"):
        raise InputError(f"model: expected lever_arm, paraxial or curved, got '{settings.model}'")
    check_file(settings.out, settings.force)
    index, box, n_ambient = read_field(settings.result)
    if settings.cameras is not None:
        given = Measurement.read(settings.cameras)
        cameras = (given.select(settings.names) if settings.names else given).cameras
    elif settings.names:
        raise InputError("names: expected together with --cameras FILE, got no file")
    else:
        cameras = settings.ring.cameras()
    model: ForwardModel
    if settings.model == "curved":
        model = CurvedRays(settings.samples, n_ambient)
    else:
        model = Deflection(settings.model, settings.samples, n_ambient)
    height, width = (max(c.image_size[i] for c in cameras) for i in (0, 1))
    displacement = torch.full((len(cameras), height, width, 2), float("nan"))
    for i, camera in enumerate(cameras):
        h, w = camera.image_size
        displacement[i, :h, :w] = predict_view(index, camera, model, box)
    predicted = Measurement(cameras=cameras, displacement=displacement, box=box, n_ambient=n_ambient)
    predicted.write(settings.out)
    for i, camera in enumerate(cameras):
        rms = float(displacement[i].nan_to_num().square().mean().sqrt())
        say(f"{camera.name}: rms displacement {rms:.4f} px a component")
    say(f"{settings.out}: {len(cameras)} predicted views ({settings.model})")
    return predicted


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Project(tyro.MISSING, tyro.MISSING), arguments, "project"))
