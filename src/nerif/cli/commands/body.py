"""nerif body: opaque bodies in the flow, and the pixels that they hide."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from nerif.cli.arguments import check_output
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.locks import locked
from nerif.common.settings import Natural, Positional

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement
    from nerif.geometry.body import Body

__all__ = ["BodyInFlow", "main", "run"]

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class BodyInFlow(Settings):
    """Add opaque bodies to a measurement or a film, from files of their surfaces (STL, OBJ, PLY) or from silhouettes.

    Pixels that see a body have no data any more. The reconstruction is NaN within it.
    """

    measurement: Annotated[Path, Positional]
    """Measurement file, or film (.zarr)."""
    models: Annotated[tuple[Path, ...], Positional] = ()
    """Closed surfaces of triangles (.stl, .obj, .ply), one or more."""
    out: Path | None = None
    """Measurement to write, NAME.nc (a film: NAME.zarr), with a figure NAME.bodies.png."""
    unit: Literal["mm", "cm", "m", "in"] | None = None
    """Unit of the lengths in the files (default: mm, and a size that does not suit the box is refused)."""
    rotation: Vector = (0.0, 0.0, 0.0)
    """Rotation from the frame of the models to the world: its axis times its angle in degrees."""
    translation: Vector = (0.0, 0.0, 0.0)
    """Place of the origin of the models in the world, mm."""
    refine: bool = False
    """Refine the pose of each model by its outline: that of the silhouettes, or of the pixels without data."""
    silhouettes: Path | None = None
    """Folder with an image VIEW.png per view (white: body), to refine the pose; without a model, the body is their
    visual hull."""
    poses: Path | None = None
    """Poses of models that move in a film: a table (.csv) with the columns rx, ry, rz (degrees), tx, ty, tz (mm) and a
    row per frame."""
    margin: Natural = 0
    """Pixels around those that see a body, without data either: half the correlation window, where it mixes the two."""
    remove: bool = False
    """Remove the bodies; pixels that saw one stay without data."""
    force: bool = False
    """Overwrite existing files."""


def run(settings: BodyInFlow) -> Measurement:
    """Write the measurement with its bodies."""
    from nerif.data.measurement import Measurement
    from nerif.data.measurement_sequence import MeasurementSequence
    from nerif.imaging.bodies import with_bodies, without_bodies

    out, film = settings.out, ending(settings.measurement) == ".zarr"
    last = ".zarr" if film else ".nc"
    if out is None:
        raise InputError(f"expected the measurement to write, NAME{last}, got none", field="out")
    image = out.with_suffix(".bodies.png")
    check_output(out, settings.force, image, endings=(last,))
    _check(settings, film)
    measurement = MeasurementSequence.read(settings.measurement).fullest() if film else None
    measurement = measurement or Measurement.read(settings.measurement)
    if settings.remove:
        measurement = without_bodies(measurement)
        measurement.write(out)
        say(f"{out}: without bodies")
        return measurement
    stated, bodies = settings.unit is not None, _bodies(settings, measurement)
    if film:
        with locked(out):
            measurement = _film(settings, bodies, out)
    else:
        with counting_bar("pixels that see a body", len(measurement.names)) as bar:
            measurement = with_bodies(measurement, [*measurement.bodies, *bodies], settings.margin, stated, bar)
        measurement.write(out)
    assert measurement.hidden is not None
    for body in measurement.bodies:
        size = " x ".join(f"{e:.4g}" for e in (body.extent[1] - body.extent[0]).tolist())
        say(f"{body.name:<12} {len(body.faces)} triangles, {size} mm (x, y, z), {body.volume:.4g} mm3")
    for name, hidden, camera in zip(measurement.names, measurement.hidden, measurement.cameras, strict=True):
        height, width = camera.image_size
        say(f"{name:<12} a body in {float(hidden[:height, :width].float().mean()):.1%} of the image")
    from nerif.report.displacement_figure import save_masks

    save_masks(image, measurement, measurement.hidden)
    count = len(measurement.bodies)
    say(f"{out}: {count} bod{'y' if count == 1 else 'ies'}; outlines in {image}")
    return measurement


def _check(settings: BodyInFlow, film: bool) -> None:
    """Raise InputError for options that do not go together."""
    assert settings.out is not None
    if bool(settings.models or settings.silhouettes or settings.poses) == settings.remove:
        raise InputError("expected the files of one or more models, silhouettes, or --remove", field="models")
    if not settings.models and (settings.refine or settings.poses or any((*settings.rotation, *settings.translation))):
        raise InputError("expected a model to which the pose belongs, got none", field="models")
    if settings.models and settings.silhouettes and not settings.refine:
        raise InputError("expected --refine with a model, or no model for the visual hull", field="silhouettes")
    if not film:
        if settings.poses is not None:
            raise InputError("expected a film (.zarr) for moving models, got a measurement", field="poses")
        return
    if settings.out.resolve() == settings.measurement.resolve():
        raise InputError("expected another name than that of the film, which is read frame by frame", field="out")
    if settings.remove or settings.silhouettes:
        option = "remove" if settings.remove else "silhouettes"
        raise InputError("expected a measurement (.nc), got a film; start from the film without bodies", field=option)
    if settings.refine and settings.poses:
        raise InputError("expected either --refine or --poses, got both", field="poses")


def _bodies(settings: BodyInFlow, measurement: Measurement) -> list[Body]:
    """The bodies of the files at their pose, or that of the silhouettes."""
    import torch

    from nerif.data.body_file import read_body
    from nerif.geometry.pose import rotation_matrix
    from nerif.imaging.bodies import check_size
    from nerif.imaging.masks import drawn_masks
    from nerif.imaging.silhouettes import drawn_silhouettes, hull_of_silhouettes, refine_pose

    silhouettes = None
    if settings.silhouettes is not None:
        silhouettes = drawn_silhouettes(
            drawn_masks(settings.silhouettes, measurement.names, say, "it counts for nothing"), measurement
        )
    if not settings.models:
        assert silhouettes is not None
        return [hull_of_silhouettes(measurement, silhouettes)]
    rotation = rotation_matrix(torch.tensor(settings.rotation, dtype=torch.float64) * (math.pi / 180))
    translation = torch.tensor(settings.translation, dtype=torch.float64)
    bodies = []
    for path in settings.models:
        read = read_body(path, settings.unit or "mm", lambda line: say(f"note: {line}"))
        body = read.moved(rotation, translation)
        if settings.refine and ending(settings.measurement) != ".zarr":
            check_size(measurement, body, settings.unit is not None)
            pose = refine_pose(measurement, body, silhouettes, 0 if silhouettes is not None else settings.margin)
            say(pose.sentence)
            body = pose.body
        bodies.append(body)
    return bodies


def _film(settings: BodyInFlow, bodies: list[Body], out: Path) -> Measurement:
    """Write the film with its bodies, and return its first complete frame."""
    from nerif.data.measurement_sequence import MeasurementSequence
    from nerif.imaging.bodies import film_with_bodies, read_poses

    film = MeasurementSequence.read(settings.measurement)
    poses = None if settings.poses is None else read_poses(settings.poses, len(bodies), len(film))
    stated = settings.unit is not None
    with counting_bar("frames", len(film)) as bar:
        whole = film_with_bodies(
            film, out, bodies, poses, settings.margin, stated, settings.refine, settings.force, bar
        )
    return whole.fullest()


main = command("body", BodyInFlow, run)
