"""nerif body: opaque bodies in the flow, and the pixels that they hide."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from annotated_types import Ge

from nerif.cli.arguments import check_output
from nerif.cli.commands.output import counting_bar, say
from nerif.cli.commands.settings import Settings, command
from nerif.common.conventions import InputError
from nerif.data.body_file import read_body
from nerif.data.measurement import Measurement
from nerif.geometry.pose import rotation_matrix
from nerif.imaging.bodies import with_bodies, without_bodies

__all__ = ["BodyInFlow", "main", "run"]

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class BodyInFlow(Settings):
    """Add opaque bodies to a measurement, from files of their surfaces (STL, OBJ, PLY).

    Pixels that see a body have no data any more. The reconstruction is NaN within it.
    """

    measurement: tyro.conf.Positional[Path]
    """Measurement file."""
    models: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Closed surfaces of triangles (.stl, .obj, .ply), one or more."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Measurement to write, NAME.nc, with a figure NAME.bodies.png."""
    unit: Literal["mm", "cm", "m", "in"] | None = None
    """Unit of the lengths in the files (default: mm, and a size that does not suit the box is refused)."""
    rotation: Vector = (0.0, 0.0, 0.0)
    """Rotation from the frame of the models to the world: its axis times its angle in degrees."""
    translation: Vector = (0.0, 0.0, 0.0)
    """Place of the origin of the models in the world, mm."""
    margin: Annotated[int, Ge(0)] = 0
    """Pixels around those that see a body, without data either: half the correlation window, where it mixes the two."""
    remove: bool = False
    """Remove the bodies; pixels that saw one stay without data."""
    force: bool = False
    """Overwrite existing files."""


def run(settings: BodyInFlow) -> Measurement:
    """Write the measurement with its bodies."""
    if settings.out is None:
        raise InputError("expected the measurement to write, NAME.nc, got none", field="out")
    image = settings.out.with_suffix(".bodies.png")
    check_output(settings.out, settings.force, image, endings=(".nc",))
    if bool(settings.models) == settings.remove:
        raise InputError("expected the files of one or more models, or --remove", field="models")
    measurement = Measurement.read(settings.measurement)
    if settings.remove:
        measurement = without_bodies(measurement)
        measurement.write(settings.out)
        say(f"{settings.out}: without bodies")
        return measurement
    rotation = rotation_matrix(torch.tensor(settings.rotation, dtype=torch.float64) * (math.pi / 180))
    translation = torch.tensor(settings.translation, dtype=torch.float64)
    read = [read_body(path, settings.unit or "mm", lambda line: say(f"note: {line}")) for path in settings.models]
    bodies = [*measurement.bodies, *(body.moved(rotation, translation) for body in read)]
    stated = settings.unit is not None
    with counting_bar("pixels that see a body", len(measurement.names)) as bar:
        measurement = with_bodies(measurement, bodies, settings.margin, stated, bar)
    assert measurement.hidden is not None
    measurement.write(settings.out)
    for body in bodies:
        size = " x ".join(f"{e:.4g}" for e in (body.extent[1] - body.extent[0]).tolist())
        say(f"{body.name:<12} {len(body.faces)} triangles, {size} mm (x, y, z), {body.volume:.4g} mm3")
    for name, hidden, camera in zip(measurement.names, measurement.hidden, measurement.cameras, strict=True):
        height, width = camera.image_size
        say(f"{name:<12} a body in {float(hidden[:height, :width].float().mean()):.1%} of the image")
    from nerif.report.displacement_figure import save_masks

    save_masks(image, measurement, measurement.hidden)
    say(f"{settings.out}: {len(bodies)} bod{'y' if len(bodies) == 1 else 'ies'}; outlines in {image}")
    return measurement


main = command("body", BodyInFlow, run)
