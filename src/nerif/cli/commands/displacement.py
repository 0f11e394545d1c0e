"""nerif displacement: from images of all views to a measurement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import check_file, counting_bar, say
from nerif.cli.commands.settings import Flat, Settings, read_settings
from nerif.common.conventions import InputError
from nerif.common.interruption import if_interrupted
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.forward.deflection import Deflection
from nerif.geometry import Box
from nerif.imaging.displacement.displacement import DisplacementSettings
from nerif.imaging.masks import MaskSettings
from nerif.imaging.readers.views import find_views
from nerif.imaging.recording import Recording, Scene, Surroundings, measure_instant
from nerif.imaging.recording_sequence import frame_numbers, instants_of, measure_recording

__all__ = ["Displacement", "main", "run"]


@dataclass(frozen=True)
class Displacement(Settings):
    """Find the displacements of all views and write them, with the calibration, as a measurement.

    FOLDER has a folder for each view with VIEW/reference (images without flow; with three or more, the noise is taken
    from them) and VIEW/flow (images with flow), or a views.toml that says where they are. VIEW/mask.png, if there is
    one, tells where the flow is, VIEW/region.png where the background is seen.
    """

    folder: tyro.conf.Positional[Path]
    """Folder of the experiment."""
    calibration: Path
    """Calibrated cameras: of nerif calibrate, or any file it can take over. Names are those of the views."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Measurement to write, NAME.nc, and NAME.png to show the displacements; NAME.zarr with --frames."""
    lower: tuple[float, float, float] | None = None
    """Lower corner (x y z) of the box to reconstruct, mm; default: the box of the calibration, if it holds one."""
    upper: tuple[float, float, float] | None = None
    """Upper corner of the box, mm."""
    views: tuple[str, ...] = ()
    """Only these views."""
    frame: int = 0
    """Which flow image to take."""
    frames: str = ""
    """Many flow images, all or FIRST:LAST (LAST not included): a sequence, --out NAME.zarr."""
    frame_rate: float = 0.0
    """Flow images a second, where the recording does not tell."""
    average: int = 1
    """Number of flow images, from `frame` on, whose displacements are averaged."""
    references: int = 100
    """Most reference images to read; 0 for all."""
    mask: float = 0.0
    """Flow mask (for the visual hull) where |d| exceeds this many sigma; 0 for none. 4 is a good value."""
    images: bool = True
    """Keep the images beside the displacements, to reconstruct straight from them (not of averages or sequences)."""
    force: bool = False
    """Overwrite existing files."""
    surroundings: Annotated[Surroundings, Flat] = field(default_factory=Surroundings)
    method: Annotated[DisplacementSettings, Flat] = field(default_factory=DisplacementSettings)

    def recording(self) -> Recording:
        """Find the images, the cameras and the box."""
        from nerif.imaging.calibration.importers.importers import import_box, import_cameras

        box = Box.between(self.lower, self.upper) or import_box(self.calibration)
        if box is None:
            raise InputError(
                f"expected the corners of the box to reconstruct, since {self.calibration} holds none; "
                "give --lower X Y Z and --upper X Y Z, mm",
                field="lower, upper",
            )
        scene = Scene(box, self.surroundings)
        masks = MaskSettings(self.mask) if self.mask else None
        views = find_views(self.folder, self.views)
        cameras = {c.name: c for c in import_cameras(self.calibration)}
        return Recording(views, cameras, scene, self.method, masks, self.references, self.images)


def run(settings: Displacement) -> Measurement:
    """Write the measurement, or the first frame's of a sequence."""
    ending = ".zarr" if settings.frames else ".nc"
    if settings.out.suffix != ending:
        raise InputError(f"expected a name ending in {ending}, got '{settings.out.name}'", field="out")
    for name, least in (("frame", 0), ("average", 1), ("references", 0), ("mask", 0)):
        if not getattr(settings, name) >= least:
            raise InputError(f"expected {least} or more, got {getattr(settings, name)}", field=name)
    recording = settings.recording()
    box = recording.scene.box
    settings = replace(settings, lower=box.lower, upper=box.upper)
    if settings.frames:
        return run_over_time(settings, recording).fullest()
    image = settings.out.with_suffix(".png")
    check_file(settings.out, settings.force, image)
    with counting_bar("finding displacements", len(recording.views)) as bar:
        numbers = range(settings.frame, settings.frame + settings.average)
        measurement, noise = measure_instant(recording, numbers, say, bar)
    measurement.write(settings.out)
    _tell(measurement, noise)
    from nerif.report.displacement_figure import save_displacements

    save_displacements(image, measurement)
    say(f"{settings.out}: measurement of {len(measurement.names)} views; {image}: its displacements")
    return measurement


def run_over_time(settings: Displacement, recording: Recording) -> MeasurementSequence:
    """Write a measurement of every flow image asked for."""
    if settings.average != 1 or settings.frame != 0:
        raise InputError(
            "expected neither with --frames, which takes every flow image by itself", field="frame, average"
        )
    numbers = frame_numbers(settings.frames, recording.views)
    times = instants_of(numbers, recording.views[0], settings.frame_rate)
    kept = {name: value for name, value in asdict(settings).items() if name not in ("out", "force", "config", "frames")}
    begun = f"frames that are done are kept in {settings.out}; the same command goes on with the others"
    count = len(recording.views) + len(numbers)
    with if_interrupted(lambda: begun), counting_bar("references, then frames", count) as bar:
        return measure_recording(recording, numbers, times, settings.out, kept, settings.force, say, bar)


def _tell(measurement: Measurement, noise: Mapping[str, str]) -> None:
    say(f"{'view':<12}{'valid':>8}{'rms d [px]':>12}{'max |d| [px]':>14}{'sigma [px]':>12}  noise from")
    assert measurement.sigma is not None
    (found,) = (o for o in measurement.observations if o.technique is Deflection)
    usable = measurement.usable_for(found)
    for i, (name, camera) in enumerate(zip(measurement.names, measurement.cameras, strict=True)):
        d, sigma = measurement.displacements[i][usable[i]], measurement.sigma[i][usable[i]]
        share = len(d) / (camera.image_size[0] * camera.image_size[1])
        say(
            f"{name:<12}{share:>8.1%}{float(d.square().mean().sqrt()):>12.3f}"
            f"{float(d.norm(dim=-1).max()):>14.3f}{float(sigma.median()):>12.4f}  {noise[name]}"
        )


def main(arguments: list[str]) -> None:
    """Parse and run."""
    missing = tyro.MISSING
    run(read_settings(Displacement(folder=missing, calibration=missing, out=missing), arguments, "displacement"))
