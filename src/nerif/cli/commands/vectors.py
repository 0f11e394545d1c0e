"""nerif vectors: a measurement from displacement vectors that another program computed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerif.cli.arguments import check_output
from nerif.cli.measurement import MeasurementSettings, print_views
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import command
from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.installation import quoted, word_of
from nerif.common.interruption import if_interrupted
from nerif.common.locks import locked
from nerif.common.settings import Count, Flat, Natural, Positional
from nerif.imaging.imaging_settings import Surroundings
from nerif.imaging.vectors.vector_settings import VectorSettings

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["Vectors", "main", "run"]

UNRECORDED = ("out", "force", "config", "frame", "frame_rate")  # the last two are those of the times


@dataclass(frozen=True)
class Vectors(MeasurementSettings):
    """Read displacement vectors of PIVlab, OpenPIV, DaVis, Insight, Dynamic Studio, or of any table or arrays.

    FOLDER has a folder or a file for each view, named as its camera; numbered files are the frames of a film. Or it is
    one file (.mat, .npz, .nc) with all views. A vector on every k-th pixel becomes a pixel of a view of a k-th of the
    size; its interrogation window is part of the model.
    """

    folder: Annotated[Path, Positional]
    """Folder with the vectors of all views, or a file."""
    out: Path
    """Measurement to write, NAME.nc, with a figure NAME.png; for a film NAME.zarr."""
    frame: Natural = 0
    """Number of the frame, or of the first of a film, from 0."""
    average: Count = 1
    """Number of frames, from --frame on, whose vectors are averaged."""
    frame_rate: float = 0.0
    """Frames per second of a film."""
    force: bool = False
    """Overwrite existing files."""
    surroundings: Annotated[Surroundings, Flat] = field(default_factory=Surroundings)
    vectors: Annotated[VectorSettings, Flat] = field(default_factory=VectorSettings)


def run(settings: Vectors) -> Measurement:
    """Write the measurement, or the film, of which a complete frame is returned."""
    from nerif.geometry import Box
    from nerif.geometry.plausibility import in_one_plane
    from nerif.imaging.vectors.vectors import VectorFilm

    out, image = settings.out, settings.out.with_suffix(".png")
    film = ending(out) == ".zarr"
    check_output(
        out, settings.force or film, *(() if film else (image,)), endings=(".nc", ".zarr")
    )  # a film is continued
    box = Box.between(settings.lower, settings.upper)
    vectors = VectorFilm.open(
        settings.folder, settings.calibration, settings.vectors, box, settings.surroundings, settings.views, say
    )
    for note in vectors.notes:
        say(note)
    for view in vectors.views[:1]:
        first = view.map(settings.frame if settings.frame < len(vectors) else 0)
        stated = "" if first.window else ": assumed, two steps of the grid (--window states it)"
        say(f"a vector on every {first.step[0]:.4g} x {first.step[1]:.4g} px, window {first.windowed:.4g} px{stated}")
        for doubt in first.doubts(view.camera):
            say(f"note: {view.name}: {doubt}")
    if film:
        if settings.average != 1:
            raise InputError("expected none for a film, got one; write one instant to a .nc file", field="average")
        numbers = range(settings.frame, len(vectors))
        remedy = f"complete frames are kept in {out}; run the same command again to continue"
        entries = {name: value for name, value in asdict(settings).items() if name not in UNRECORDED}
        with locked(out), if_interrupted(lambda: remedy), counting_bar("reading vectors", len(numbers)) as bar:
            sequence = vectors.write(out, settings.frame_rate, numbers, settings.force, bar, entries)
        say(f"{out}: {len(numbers)} frames of {len(vectors.views)} views; next: nerif sequence {quoted(word_of(out))}")
        return sequence.fullest()
    with counting_bar("reading vectors", len(vectors.views)) as bar:
        measurement, noise = vectors.measure(range(settings.frame, settings.frame + settings.average), bar)
    measurement.write(out)
    if len(vectors) > settings.average:
        say(
            f"note: {settings.average} of {len(vectors)} frames, from number {settings.frame} on; --average takes the "
            "mean of more, and --out NAME.zarr writes the film"
        )
    if note := vectors.smaller_grids(measurement):
        say(f"note: {note}")
    say("displacements in pixels of the views, which are steps of the grid:")
    print_views(measurement, noise)
    from nerif.report.displacement_figure import save_displacements

    save_displacements(image, measurement)
    say(f"{out}: measurement of {len(measurement.names)} views; {image}: its displacements")
    say(f"next: nerif check {quoted(word_of(out))}, which compares the axes of the views with one another")
    if note := in_one_plane(measurement.cameras):
        say(f"note: {note} in {image}, and give --y-axis if it is")
    return measurement


main = command("vectors", Vectors, run)
