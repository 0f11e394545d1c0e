"""nerif displacement: a measurement from the images of all views."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerif.cli.arguments import check_output
from nerif.cli.measurement import MeasurementSettings, print_views
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import command
from nerif.common.conventions import InputError
from nerif.common.interruption import if_interrupted
from nerif.common.locks import locked
from nerif.common.settings import Count, Flat, Natural, NonNegative, Positional
from nerif.imaging.imaging_settings import DisplacementSettings, MaskSettings, Surroundings

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement
    from nerif.data.measurement_sequence import MeasurementSequence
    from nerif.imaging.recording import Recording

__all__ = ["Displacement", "main", "run"]

UNRECORDED = ("out", "force", "config", "frames", "frame_offset")  # or recorded by measure_recording


@dataclass(frozen=True)
class Displacement(MeasurementSettings):
    """Compute the displacements of all views, and write them with the calibration as a measurement.

    Displacement: where a dot appears with flow minus where it appears without (px, u right, v down).

    FOLDER has for each view VIEW/reference (images without flow; three or more give the noise) and VIEW/flow (images
    with flow), or a views.toml with their places. Optional: VIEW/mask.png (flow region), VIEW/region.png (visible
    background).
    """

    folder: Annotated[Path, Positional]
    """Folder of the experiment."""
    out: Path
    """Measurement to write, NAME.nc, with a figure NAME.png; with --frames NAME.zarr."""
    frame: Natural = 0
    """Number of the flow image."""
    frames: str = ""
    """Flow images of a sequence: all, or FIRST:LAST (LAST excluded); requires --out NAME.zarr."""
    frame_offset: dict[str, int] = field(default_factory=dict)
    """View and offset of its film, such as cam3 -2: number i is flow image i - 2 of cam3. Once for each view; replaces
    frame_offset of views.toml."""
    frame_rate: float = 0.0
    """Flow images per second (0: from the recording)."""
    average: Count = 1
    """Number of flow images, from --frame on, whose displacements are averaged."""
    references: Natural = 100
    """Maximum number of reference images (0: all)."""
    mask: NonNegative = 0.0
    """Threshold of the flow mask for the visual hull: |d| in units of sigma, such as 4 (0: no mask)."""
    images: bool = True
    """Store the images with the displacements, for reconstructions from images (not of averages or sequences)."""
    force: bool = False
    """Overwrite existing files."""
    surroundings: Annotated[Surroundings, Flat] = field(default_factory=Surroundings)
    method: Annotated[DisplacementSettings, Flat] = field(default_factory=DisplacementSettings)

    def recording(self) -> Recording:
        """Return images, cameras and box."""
        from nerif.geometry import Box
        from nerif.imaging.calibration.importers.importers import box_to_reconstruct, import_cameras
        from nerif.imaging.calibration.importers.names import cameras_by_view
        from nerif.imaging.readers.views import find_views
        from nerif.imaging.recording import Recording, Scene

        views = find_views(self.folder, self.views, self.frame_offset)
        everything = [view.name for view in find_views(self.folder)]
        cameras = cameras_by_view(everything, import_cameras(self.calibration), say)
        box = box_to_reconstruct(Box.between(self.lower, self.upper), self.calibration)
        scene = Scene(box, self.surroundings)
        masks = MaskSettings(self.mask) if self.mask else None
        return Recording(views, cameras, scene, self.method, masks, self.references, self.images)


def run(settings: Displacement) -> Measurement:
    """Write the measurement, or a sequence, of which a complete frame is returned."""
    from nerif.imaging.recording import measure_instant

    image = settings.out.with_suffix(".png")
    if settings.frames:  # a sequence that exists is continued
        check_output(settings.out, True, endings=(".zarr",))
    else:
        check_output(settings.out, settings.force, image, endings=(".nc",))
    recording = settings.recording()
    box = recording.scene.box
    settings = replace(settings, lower=box.lower, upper=box.upper)
    if settings.frames:
        return _run_over_time(settings, recording).fullest()
    with counting_bar("computing displacements", len(recording.views)) as bar:
        numbers = range(settings.frame, settings.frame + settings.average)
        measurement, noise = measure_instant(recording, numbers, say, bar)
    measurement.write(settings.out)
    print_views(measurement, noise)
    from nerif.report.displacement_figure import save_displacements

    save_displacements(image, measurement)
    say(f"{settings.out}: measurement of {len(measurement.names)} views; {image}: its displacements")
    return measurement


def _run_over_time(settings: Displacement, recording: Recording) -> MeasurementSequence:
    from nerif.imaging.recording_sequence import frame_numbers, instants_of, measure_recording

    if settings.average != 1 or settings.frame != 0:
        raise InputError("expected none with --frames, which selects the flow images", field="frame, average")
    numbers = frame_numbers(settings.frames, recording.views)
    times = instants_of(numbers, recording.views[0], settings.frame_rate)
    attributes = {k: v for k, v in asdict(settings).items() if k not in UNRECORDED}
    remedy = f"complete frames are kept in {settings.out}; run the same command again to continue"
    count = len(recording.views) + len(numbers)
    out = settings.out
    with locked(out), if_interrupted(lambda: remedy), counting_bar("references, then frames", count) as bar:
        return measure_recording(recording, numbers, times, out, attributes, settings.force, say, bar)


main = command("displacement", Displacement, run)
