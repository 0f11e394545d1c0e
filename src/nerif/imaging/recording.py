"""From the images of a recording to the measurement of one instant.

The reference images of a view are evaluated once (ViewReference); the flow images of each instant are compared with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool

from nerif.common.conventions import InputError
from nerif.common.settings import Natural, check_settings
from nerif.data.cameras_file import CalibratedCamera
from nerif.data.measurement import Measurement
from nerif.geometry import Box, Camera
from nerif.imaging.displacement.displacement import OVEREXPOSED, UNEVEN, DisplacementMap, Reference
from nerif.imaging.imaging_settings import DisplacementSettings, MaskSettings, Surroundings
from nerif.imaging.masks import flow_mask
from nerif.imaging.quality.reference_outliers import without_outliers
from nerif.imaging.quality.repetition import Repetition, repetition
from nerif.imaging.quality.unrelated import unrelated
from nerif.imaging.readers.exposure import check_exposure
from nerif.imaging.readers.views import View, good_images, paired
from nerif.imaging.shake import row_movement
from nerif.imaging.workers import cores, work

__all__ = ["Recording", "Scene", "ViewReference", "camera_of", "join_views", "measure_instant", "reported"]

PixelMask = Bool[np.ndarray, "row column"]
Result = TypeVar("Result")

AMBIGUOUS = 0.4, 0.005  # part of a period, and share of the pixels displaced by more
ROWS = 0.1  # px, movement of rows that is reported
NOTABLE = 0.005  # share of pixels that move too unevenly, from which on it is reported
FEW = 0.5  # share of valid pixels below which their number is reported
WORTH_PROCESSES = 2**22  # pixels of all images together


def silent(line: str) -> None:
    """Report nothing."""


class ViewMeasurement(NamedTuple):
    """Camera, displacement, flow mask and frame offset of a view."""

    camera: Camera
    result: DisplacementMap
    mask: PixelMask | None
    frame_offset: int = 0


@dataclass(frozen=True)
class Scene:
    """The parts of a measurement that are common to all views: the box to reconstruct, and its surroundings."""

    box: Box
    surroundings: Surroundings = field(default_factory=Surroundings)


def join_views(views: Iterable[ViewMeasurement], scene: Scene, images: bool = False) -> Measurement:
    """Return one measurement of all views; smaller images are padded.

    With images a pixel is valid where either the displacement or the image is; the other is NaN there. A generator
    keeps one view in memory at a time.
    """
    cameras: list[Camera] = []
    maps: dict[str, list[np.ndarray]] = {}
    frame_offsets: dict[str, int] = {}
    any_mask = False
    for camera, result, mask, frame_offset in views:
        cameras.append(camera)
        frame_offsets[camera.name] = frame_offset
        any_mask |= mask is not None
        arrays = {"displacement": result.displacement, "sigma": result.sigma, "valid": result.valid}
        arrays["flow_mask"] = np.ones(result.valid.shape, dtype=bool) if mask is None else mask
        if images and result.pair is not None:
            arrays["displacement"] = np.where(result.valid[..., None], result.displacement, np.float32(np.nan))
            arrays["valid"] = result.valid | np.isfinite(result.pair.flow)
            arrays |= {"reference": result.pair.reference, "flow": result.pair.flow, "image_sigma": result.pair.sigma}
        for name, array in arrays.items():
            maps.setdefault(name, []).append(array)
    size = tuple(max(v.shape[k] for v in maps["valid"]) for k in range(2))

    def stack(name: str) -> torch.Tensor:
        arrays = maps[name]
        kind = arrays[0].dtype
        padded = np.full((len(arrays), *size, *arrays[0].shape[2:]), np.nan if kind.kind == "f" else 0, dtype=kind)
        for view in padded:
            array = arrays.pop(0)  # free it once copied
            view[: array.shape[0], : array.shape[1]] = array
        return torch.from_numpy(padded)

    return Measurement(
        cameras=tuple(cameras),
        box=scene.box,
        displacement=stack("displacement"),
        sigma=stack("sigma"),
        valid=stack("valid"),
        maps={name: stack(name) for name in ("reference", "flow", "image_sigma") if name in maps},
        flow_mask=stack("flow_mask") if any_mask else None,
        frame_offsets=frame_offsets,
        **vars(scene.surroundings),
    )


@dataclass(frozen=True)
class Recording:
    """Images of all views, and the settings to evaluate them."""

    views: tuple[View, ...]  #: of views.find_views
    cameras: Mapping[str, CalibratedCamera]
    """Calibrated, by the names of the views (importers.import_cameras, cameras_file.read_cameras)."""
    scene: Scene
    method: DisplacementSettings = field(default_factory=DisplacementSettings)  #: of the displacements
    masks: MaskSettings | None = None  #: of the flow, or None; drawn masks take precedence
    references: Natural = 100  #: most reference images to use; 0 for all
    images: bool = True  #: whether a measurement of one flow image includes the images

    def __post_init__(self) -> None:
        for view in self.views:
            if view.name not in self.cameras:
                raise InputError(
                    f"no camera named '{view.name}', only {', '.join(self.cameras)}; "
                    "rename the view's folder, or choose --views",
                    field="calibration",
                )
        check_settings(self)
        object.__setattr__(self, "views", paired(self.views))

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines about how the flow images of the views are paired."""
        return next((view.count.lines for view in self.views if view.count is not None), ())

    def processes(self, tasks: int, images: int) -> int:
        """Return the number of processes for tasks with `images` images in total: 1 if these are small."""
        sizes = [c.image_size for c in self.cameras.values() if c.image_size is not None]
        pixels = images * max((height * width for height, width in sizes), default=WORTH_PROCESSES)
        return min(cores(), tasks) if pixels >= WORTH_PROCESSES else 1


@dataclass(frozen=True)
class ViewReference:
    """A view with its camera and its evaluated reference images."""

    view: View
    camera: Camera
    reference: Reference
    masks: MaskSettings | None = None  #: settings of the flow mask by threshold, or None
    region: PixelMask | None = None  #: where the background is visible, or None
    drawn_mask: PixelMask | None = None  #: drawn flow mask, or None
    images: bool = True  #: whether a displacement map includes the images
    others: tuple[View, ...] = ()  #: views whose images may have been exchanged with those of this one
    repeats: Repetition | None = None  #: how the background repeats, or None

    @classmethod
    def of(
        cls, recording: Recording, view: View, averages: int = 1, say: Callable[[str], None] = silent
    ) -> ViewReference:
        """Evaluate the reference images of a view, for an average over a number of flow images.

        Unusable images are reported, and a background that repeats.
        """
        view.check_alike()
        images = without_outliers(view, good_images(view, "reference", say, recording.references), say)
        for note in view.open("flow").notes:
            if note not in view.open("reference").notes:
                say(f"note: {note}")
        shape = (images[0].shape[0], images[0].shape[1])
        camera = camera_of(view, recording.cameras[view.name], shape)
        reference = Reference.of(images, recording.method, view.full_scale, averages)
        region, drawn_mask = (view.mask(source, shape, say) for source in ("region", "mask"))
        if (repeats := repetition(reference.mean)) is not None:
            text = f"its background {repeats}; print random dots (nerif pattern --kind dots)"
            if repeats.lines is not None:  # the error along them is unknown: noise looks like structure
                raise InputError(text, field=f"view '{view.name}'")
            say(f"note: view '{view.name}': {text}")
        others = recording.views
        return cls(view, camera, reference, recording.masks, region, drawn_mask, recording.images, others, repeats)

    def measure(self, numbers: Sequence[int], say: Callable[[str], None] = silent) -> ViewMeasurement:
        """Return camera, mean displacement over the flow images of these instants, and flow mask."""
        images = {}
        cause, name = "", f"view '{self.view.name}'"
        for i in numbers:
            if len(numbers) > 1 and i not in self.view.instants:
                cause = f"no flow image of instant {i}"
                say(f"left out: view '{self.view.name}': {cause}")
                continue
            image, name = self.view.flow_image(i)
            if exposure := check_exposure(image, self.reference.full_scale, name):
                say(f"note: {exposure}")
            if len(numbers) > 1 and (cause := self._unrelated(image)):  # the mean would hide it
                say(f"left out: {name}: {cause}")
                continue
            images[name] = image
        if not images:
            raise InputError(f"none of the {len(numbers)} flow images can be used; {cause}", field=name)
        result = self.reference.measure(list(images.values()), self.region, self.images)
        self._check_share(result, images, say)
        self._report_movements(result, say)
        self._check_period(result, say)
        mask = self.drawn_mask
        if mask is None and self.masks is not None:
            d = np.where(result.valid[..., None], result.displacement, np.nan)
            mask = flow_mask(d, result.sigma, self.masks)
        return ViewMeasurement(self.camera, result, mask, self.view.offset)

    def _unrelated(self, image: np.ndarray) -> str:
        """Cause of a flow image that shows another scene, or ""; a background that repeats correlates with any."""
        return "" if self.repeats else unrelated(self.reference.mean, image, self.view, self.others)

    def _check_share(
        self, result: DisplacementMap, images: Mapping[str, np.ndarray], say: Callable[[str], None]
    ) -> None:  # fmt: skip
        """Refuse flow images of another scene, and those without valid pixels; report few valid pixels."""
        share = 1 - sum(result.losses.values())
        if share >= FEW:
            return
        if result.losses[OVEREXPOSED] < FEW:  # the correlation of few pixels decides nothing
            for name, image in images.items():
                if cause := self._unrelated(image):
                    raise InputError(cause, field=name)
        if not result.valid.any():
            text = f"no valid pixel ({result.loss_text}); do the images show one pattern, in focus?"
            raise InputError(text, field=next(iter(images)))
        say(f"note: view '{self.view.name}': {100 * share:.0f} % of its pixels are valid; {result.loss_text}")

    def _report_movements(self, result: DisplacementMap, say: Callable[[str], None]) -> None:
        """Report a shift of the image or of its rows, and displacements that change too much within a window."""
        settings, name = self.reference.settings, f"note: view '{self.view.name}':"
        if any(result.shift):
            u, v = result.shift
            remedy = "give --shake-border N, the width of a border without flow, to remove it"
            remedy = f"--shake-border {settings.shake_border} removes it" if settings.shake_border else remedy
            say(f"{name} the whole image moved by about ({u}, {v}) px between reference and flow; {remedy}")
        if (rows := row_movement(result.displacement, result.valid)) > ROWS:
            say(
                f"{name} its rows moved together, by {rows:.2f} px (median), as with a rolling shutter and a camera "
                "that shakes; use a global shutter, or average flow images (--average). A flow of layers across the "
                "whole image looks the same"
            )
        if (share := result.losses[UNEVEN]) > NOTABLE:
            largest = np.quantile(np.linalg.norm(result.displacement[result.valid], axis=-1), 1 - NOTABLE)
            say(
                f"{name} {100 * share:.1f} % of its pixels are {UNEVEN} to be measured: from the reference to the flow "
                f"image and back, d differs by over {settings.max_sigma:g} px (valid ones reach {largest:.0f} px). "
                "Print larger dots, bring the background nearer to the flow, or try smaller windows (--smoothness 0.7)"
            )

    def _check_period(self, result: DisplacementMap, say: Callable[[str], None]) -> None:
        """Report displacements that a repeating background makes ambiguous."""
        if self.repeats is None:
            return
        part, pixels = AMBIGUOUS
        d = result.displacement[result.valid]
        if np.mean(self.repeats.reach(d) > part) > pixels:
            far = np.quantile(np.linalg.norm(d, axis=-1), 1 - pixels)
            half = min(np.linalg.norm(p) for p in self.repeats.periods) / 2
            say(
                f"note: view '{self.view.name}': displacements reach {far:.1f} px; from {half:.1f} px on, half the "
                "period of its background, they are wrong by whole periods"
            )


def camera_of(view: View, calibrated: CalibratedCamera, shape: tuple[int, int]) -> Camera:
    """Return the camera of a view's images, which may be a crop of those it was calibrated with, or binned."""
    name = f"view '{view.name}'"
    if calibrated.background is None:
        raise InputError(
            "its camera has no background plane, which displacements need; calibrate it with a "
            "target laid on the background, or give nerif calibrate --background-distance",
            field=name,
        )
    frames, crop = view.open("flow"), view.crop
    frame, stored, is_binned = frames.shape, frames.layout.shape, frames.binning is not None
    turned = crop is not None and bool(crop.flip or crop.rotate)
    if calibrated.image_size is None and (is_binned or (crop is not None and (turned or frame != shape))):
        how = "a raw Bayer mosaic, binned to half the size" if is_binned else "cropped or turned (views.toml)"
        raise InputError(
            f"its images are {how}, and its camera has no image size, so that those of the calibration are unknown; "
            f"add it: nerif calibrate FILE --image-size {shape[0]} {shape[1]} (as used here) or "
            f"{stored[0]} {stored[1]} (the whole frame)",
            field=name,
        )
    if is_binned and calibrated.image_size == stored:
        calibrated = calibrated.binned()
    if calibrated.image_size in (None, shape):
        return calibrated.camera(image_size=shape)
    if crop is not None and calibrated.image_size == frame and not turned:
        return calibrated.camera().view(crop.row, crop.column, *shape)
    remedy = "calibrate with the same crop, or with the whole frame and no flip"
    if shape[0] != shape[1] and calibrated.image_size == shape[::-1] and crop is None:
        remedy = (
            "is the size of the calibration (width, height), or are the images rotated? If rows and columns are "
            'exchanged (arrays of MATLAB), give rotate = 90, flip = "vertical" in views.toml'
        )
    elif not is_binned and calibrated.image_size == (stored[0] // 2, stored[1] // 2):
        remedy += '; if its target images were binned as a raw Bayer mosaic, set mosaic = "RGGB" in views.toml'
    raise InputError(
        f"its images have {shape[0]} x {shape[1]} px (height x width), its camera was calibrated "
        f"with {calibrated.image_size}; {remedy}",
        field=name,
    )


def measure_instant(
    recording: Recording, numbers: Sequence[int] = (0,), say: Callable[[str], None] = silent,
    on_view: Callable[[int], None] = lambda count: None, processes: int | None = None,
) -> tuple[Measurement, dict[str, str]]:  # fmt: skip
    """Return the measurement of one instant, and the source of the noise by the name of the view.

    Parameters
    ----------
    numbers : of the instants, whose displacements are averaged
    on_view : called with the number of views evaluated
    processes : 1 for this one only; by default one per core if the images are large
    """
    views = recording.views
    results: dict[int, ViewMeasurement] = {}
    errors = []
    for note in recording.notes:
        say(f"note: {note}")
    tasks = [(view, tuple(numbers)) for view in views]
    if processes is None:
        processes = recording.processes(len(views), len(views))
    for count, (i, result) in enumerate(reported(_measure_view, recording, tasks, processes, say), 1):
        if isinstance(result, InputError):
            errors.append(str(result))
            say(f"view '{views[i].name}' left out: {result}")
        else:
            results[i] = result
        on_view(count)
    if not results:
        raise InputError(f"no view could be used; the first: {errors[0]}", field="displacement")
    order = sorted(results)
    noise = {views[i].name: results[i][1].noise_source for i in order}
    images = recording.images and len(numbers) == 1
    return join_views((results.pop(i) for i in order), recording.scene, images), noise


def _measure_view(
    recording: Recording, task: tuple[View, Sequence[int]], say: Callable[[str], None]
) -> ViewMeasurement:  # fmt: skip
    view, numbers = task
    view.check_instants(numbers, "frame, average")
    return ViewReference.of(recording, view, len(numbers), say).measure(numbers, say)


def reported(
    function: Callable[..., Result], recording: Recording, tasks: Sequence[Any], processes: int,
    say: Callable[[str], None],
) -> Iterator[tuple[int, Result | InputError]]:  # fmt: skip
    """Yield number and result of function(recording, task, say=...), or its InputError, of each task as they finish."""
    for i, (result, lines) in work(_result_and_lines, (function, recording), tasks, processes):
        for line in lines:
            say(line)
        yield i, result


def _result_and_lines(
    common: tuple[Callable[..., Result], Recording], task: object
) -> tuple[Result | InputError, list[str]]:  # fmt: skip
    function, recording = common
    lines: list[str] = []
    try:
        return function(recording, task, say=lines.append), lines
    except InputError as error:
        return error, lines
