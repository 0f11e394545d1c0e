"""nerif displacement: from pictures of all views to a measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from nerif.commands.output import check_file, counting_bar, say
from nerif.commands.recording import FrameJob, RestingView, frame_numbers, instants_of, measure_frames
from nerif.commands.settings import Settings, read_settings
from nerif.conventions import DEFAULT_AMBIENT_FACES, InputError
from nerif.geometry import Box, Camera
from nerif.imaging.assembly import World, join_views
from nerif.imaging.cameras_file import CalibratedCamera
from nerif.imaging.displacement import AtRest, DisplacementMap, DisplacementSettings, measure
from nerif.imaging.masks import flow_mask, read_mask
from nerif.imaging.views import View, find_views, good_pictures
from nerif.measurement import Measurement
from nerif.measurement_sequence import MeasurementSequence

__all__ = ["Displacement", "main", "run"]


@dataclass(frozen=True)
class Displacement(Settings):
    """Find the displacements of all views and write them, with the calibration, as a measurement.

    FOLDER has a folder for each view with VIEW/reference (pictures without flow; with three or more, the noise is taken
    from them) and VIEW/flow (pictures with flow), or a views.toml that says where they are. VIEW/mask.png, if there is
    one, tells where the flow is, VIEW/region.png where the background is seen.
    """

    folder: tyro.conf.Positional[Path]
    """Folder of the experiment."""
    calibration: Path
    """Calibrated cameras: of nerif calibrate, or any file it can take over. Names are those of the views."""
    lower: tuple[float, float, float]
    """Lower corner (x y z) of the box to reconstruct, mm."""
    upper: tuple[float, float, float]
    """Upper corner of the box, mm."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Measurement to write, NAME.nc, and NAME.png to show the displacements; NAME.zarr with --frames."""
    views: tuple[str, ...] = ()
    """Only these views."""
    frame: int = 0
    """Which flow picture to take."""
    frames: str = ""
    """Many flow pictures, all or FIRST:LAST (LAST not included): a sequence, --out NAME.zarr."""
    frame_rate: float = 0.0
    """Flow pictures a second, where the recording does not tell."""
    average: int = 1
    """Number of flow pictures, from `frame` on, whose displacements are averaged."""
    references: int = 100
    """Most reference pictures to read; 0 for all."""
    mask: float = 0.0
    """Flow mask (for the visual hull) where |d| exceeds this many sigma; 0 for none. 4 is a good value."""
    n_ambient: float = 1.00027
    """Refractive index around the flow."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES
    """Faces of the box on which the index is ambient."""
    force: bool = False
    """Overwrite existing files."""
    method: Annotated[DisplacementSettings, tyro.conf.arg(name="")] = field(default_factory=DisplacementSettings)

    def world(self, box: Box) -> World:
        """What the measurement holds beside its views."""
        return World(box, self.n_ambient, self.wavelength_nm, self.ambient_faces)


def run(settings: Displacement) -> Measurement:
    """Write the measurement, or the first frame's of a sequence."""
    ending = ".zarr" if settings.frames else ".nc"
    if settings.out.suffix != ending:
        raise InputError(f"out: expected a name ending in {ending}, got '{settings.out.name}'")
    for name, least in (("frame", 0), ("average", 1), ("references", 0), ("mask", 0)):
        if not getattr(settings, name) >= least:
            raise InputError(f"{name}: expected {least} or more, got {getattr(settings, name)}")
    box = Box(settings.lower, settings.upper)
    views = find_views(settings.folder, settings.views)
    if settings.frames:
        return run_over_time(settings, box, views).first_good()
    picture = settings.out.with_suffix(".png")
    check_file(settings.out, settings.force, picture)
    cameras = _calibrated(settings.calibration, views)
    maps, kept = _measure(views, cameras, settings)
    measurement = join_views([camera for camera, _ in kept], maps, [mask for _, mask in kept], settings.world(box))
    measurement.write(settings.out)
    _tell(measurement, maps)
    from nerif.report.displacement_figure import save_displacements

    save_displacements(picture, measurement)
    say(f"{settings.out}: measurement of {len(kept)} views; {picture}: its displacements")
    return measurement


def run_over_time(settings: Displacement, box: Box, views: Sequence[View]) -> MeasurementSequence:
    """Write a measurement of every flow picture asked for."""
    if settings.average != 1 or settings.frame != 0:
        raise InputError("frame, average: expected neither with --frames, which takes every flow picture by itself")
    cameras = _calibrated(settings.calibration, views)
    numbers = frame_numbers(settings.frames, views)
    times = instants_of(numbers, views[0], settings.frame_rate)
    resting = []
    with counting_bar("looking at references", len(views)) as bar:
        for view in views:
            view.check_alike()
            reference = good_pictures(view, "reference", say, settings.references)
            shape = (reference[0].shape[0], reference[0].shape[1])
            region, mask = (_drawn(view, source, shape) for source in ("region", "mask"))
            rest = AtRest.of(reference, settings.method, _full_scale(view))
            resting.append(RestingView(view, _camera(view, cameras[view.name], shape), rest, region, mask))
            bar(len(resting))
    job = FrameJob(resting, settings.world(box), settings.mask)
    kept = {name: value for name, value in asdict(settings).items() if name not in ("out", "force", "config", "frames")}
    return measure_frames(job, numbers, times, settings.out, kept, settings.force)


def _drawn(view: View, source: str, shape: tuple[int, int]) -> np.ndarray | None:
    """A drawn mask of a view, if there is one."""
    return read_mask(view.folder / view.sources[source], shape) if source in view.sources else None


def _full_scale(view: View) -> float | None:
    """Grey value at which the sensor is full, if that can be told."""
    bits = _bits(view)
    return 2**bits - 1 if bits > 1 else None


def _calibrated(path: Path, views: Sequence[View]) -> dict[str, CalibratedCamera]:
    """The camera of every view."""
    from nerif.imaging.importers import import_cameras

    cameras = {c.name: c for c in import_cameras(path)}
    for view in views:
        if view.name not in cameras:
            raise InputError(
                f"{path}: no camera named '{view.name}' as the view, only {', '.join(cameras)}; rename one of them, or "
                "choose --views"
            )
    return cameras


def _measure(
    views: Sequence[View], cameras: dict[str, CalibratedCamera], settings: Displacement
) -> tuple[list[DisplacementMap], list[tuple[Camera, np.ndarray | None]]]:
    """Displacement of every view that has good pictures, its camera, and its flow mask if one is drawn."""
    from rich.console import Console
    from rich.progress import track

    maps, kept, lost = [], [], []
    for view in track(views, "finding displacements", console=Console(stderr=True), transient=True):
        try:
            found, camera, mask = _measure_view(view, cameras[view.name], settings)
        except InputError as error:
            lost.append(str(error))
            say(f"view '{view.name}' left out: {error}")
            continue
        maps.append(found)
        kept.append((camera, mask))
    if not kept:
        raise InputError(f"displacement: no view could be used; the first: {lost[0]}")
    return maps, kept


def _measure_view(
    view: View, calibrated: CalibratedCamera, settings: Displacement
) -> tuple[DisplacementMap, Camera, np.ndarray | None]:
    view.check_alike()
    reference = good_pictures(view, "reference", say, settings.references)
    flow = _flow(view, settings)
    shape = (flow[0].shape[0], flow[0].shape[1])
    camera = _camera(view, calibrated, shape)
    found = measure(reference, flow, settings.method, _full_scale(view), _drawn(view, "region", shape))
    if not found.valid.any():
        raise InputError(
            f"view '{view.name}': no pixel holds (noise above {settings.method.max_sigma:g} px or correlation below "
            f"{settings.method.min_correlation:g} everywhere); do the pictures show the same pattern, in focus?"
        )
    mask = _drawn(view, "mask", shape)
    if mask is None and settings.mask:
        mask = flow_mask(found.displacement, found.sigma, settings.mask)
    return found, camera, mask


def _flow(view: View, settings: Displacement) -> list[np.ndarray]:
    """The flow pictures that were asked for."""
    pictures = good_pictures(view, "flow", say) if len(view.open("flow")) == 1 else None
    frames = view.open("flow")
    last = settings.frame + settings.average
    if last > len(frames):
        raise InputError(
            f"frame, average: expected numbers within the {len(frames)} flow pictures of view '{view.name}', got "
            f"{settings.frame} and {settings.average}"
        )
    if pictures is not None:
        return pictures
    from nerif.imaging.readers import check_exposure, effective_bits

    bits, pictures = effective_bits(frames), []
    for i in range(settings.frame, last):
        pictures.append(view.cropped(frames[i], frames.name(i)))
        exposure = check_exposure(pictures[-1], bits, frames.name(i))
        if exposure:
            say(f"note: {exposure}")
    return pictures


def _bits(view: View) -> int:
    from nerif.imaging.readers import effective_bits

    return max(effective_bits(view.open("flow")), effective_bits(view.open("reference")))


def _camera(view: View, calibrated: CalibratedCamera, shape: tuple[int, int]) -> Camera:
    """The camera of the view's pictures, which may be a crop of those it was calibrated with."""
    if calibrated.image_size in (None, shape):
        return calibrated.camera(image_size=shape)
    crop = view.crop
    frames = view.open("flow")
    if crop is not None and calibrated.image_size == frames.shape and not crop.flip and not crop.rotate:
        return calibrated.camera().view(crop.row, crop.column, *shape)
    raise InputError(
        f"view '{view.name}': its pictures have {shape[0]} x {shape[1]} px (height x width), its camera was calibrated "
        f"with {calibrated.image_size}; calibrate with the same crop, or with the whole frame and no flip"
    )


def _tell(measurement: Measurement, maps: Sequence[DisplacementMap]) -> None:
    say(f"{'view':<12}{'valid':>8}{'rms d [px]':>12}{'max |d| [px]':>14}{'sigma [px]':>12}  noise from")
    for name, found in zip(measurement.names, maps, strict=True):
        d, sigma = found.displacement[found.valid], found.sigma[found.valid]
        say(
            f"{name:<12}{found.valid.mean():>8.1%}{np.sqrt((d**2).mean()):>12.3f}"
            f"{np.linalg.norm(d, axis=-1).max():>14.3f}{np.median(sigma):>12.4f}  {found.noise_from}"
        )


def main(arguments: list[str]) -> None:
    """Parse and run."""
    missing = tyro.MISSING
    default = Displacement(folder=missing, calibration=missing, lower=missing, upper=missing, out=missing)
    run(read_settings(default, arguments, "displacement"))
