"""nerif displacement: a measurement from the images of all views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Ge

from nerif.cli.arguments import check_output
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError
from nerif.common.interruption import if_interrupted
from nerif.common.locks import locked
from nerif.common.settings import Count, Flat, NonNegative, Positional
from nerif.imaging.imaging_settings import DisplacementSettings, MaskSettings, Surroundings

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement
    from nerif.data.measurement_sequence import MeasurementSequence
    from nerif.imaging.recording import Recording

__all__ = ["Displacement", "main", "print_views", "run"]

UNRECORDED = ("out", "force", "config", "frames", "frame_offset")  # or recorded by measure_recording


@dataclass(frozen=True)
class Displacement(Settings):
    """Compute the displacements of all views, and write them with the calibration as a measurement.

    Displacement: where a dot appears with flow minus where it appears without (px, u right, v down).

    FOLDER has for each view VIEW/reference (images without flow; three or more give the noise) and VIEW/flow (images
    with flow), or a views.toml with their places. Optional: VIEW/mask.png (flow region), VIEW/region.png (visible
    background).
    """

    folder: Annotated[Path, Positional]
    """Folder of the experiment."""
    calibration: Path
    """Calibrated cameras with the names of the views: output of nerif calibrate, or any file that it imports."""
    out: Path
    """Measurement to write, NAME.nc, with a figure NAME.png; with --frames NAME.zarr."""
    lower: tuple[float, float, float] | None = None
    """Lower corner x y z of the box to reconstruct, mm (default: box of the calibration)."""
    upper: tuple[float, float, float] | None = None
    """Upper corner x y z of the box, mm."""
    views: tuple[str, ...] = ()
    """Views to use (default: all)."""
    frame: Annotated[int, Ge(0)] = 0
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
    references: Annotated[int, Ge(0)] = 100
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
        from nerif.imaging.calibration.importers.importers import import_box, import_cameras
        from nerif.imaging.calibration.importers.names import cameras_by_view
        from nerif.imaging.readers.views import find_views
        from nerif.imaging.recording import Recording, Scene

        views = find_views(self.folder, self.views, self.frame_offset)
        everything = [view.name for view in find_views(self.folder)]
        cameras = cameras_by_view(everything, import_cameras(self.calibration), say)
        box = Box.between(self.lower, self.upper) or import_box(self.calibration)
        if box is None:
            raise InputError(
                f"expected the corners of the box to reconstruct, since {self.calibration} has none; "
                "give --lower X Y Z and --upper X Y Z, mm",
                field="lower, upper",
            )
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


def print_views(measurement: Measurement, noise: Mapping[str, str]) -> None:
    from nerif.data.measurement_summary import valid_pixels
    from nerif.forward.deflection import Deflection

    say(f"{'view':<12}{'valid':>8}{'rms d [px]':>12}{'max |d| [px]':>14}{'sigma [px]':>12}  noise from")
    assert measurement.sigma is not None
    (deflection,) = (o for o in measurement.observations if o.technique is Deflection)
    usable = measurement.usable_for(deflection)
    for i, (name, share) in enumerate(zip(measurement.names, measurement.valid_share(deflection), strict=True)):
        d, sigma = measurement.displacements[i][usable[i]], measurement.sigma[i][usable[i]]
        say(
            f"{name:<12}{share:>8.1%}{float(d.square().mean().sqrt()):>12.3f}"
            f"{float(d.norm(dim=-1).max()):>14.3f}{float(sigma.median()):>12.4f}  {noise[name]}"
        )
    say(f"valid pixels: {valid_pixels(measurement)}")


main = command("displacement", Displacement, run)
