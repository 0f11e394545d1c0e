"""From the pictures of an experiment to a measurement, of one instant or of many.

What the pictures without flow say of a view is worked out once (RestingView); each instant is then measured against
it. One measurement of an experiment is a film of one instant, whose views are looked at one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Camera
from nerif.imaging.assembly import Scene, join_views
from nerif.imaging.calibration.cameras_file import CalibratedCamera
from nerif.imaging.displacement.displacement import AtRest, DisplacementMap, DisplacementSettings, measure_against
from nerif.imaging.displacement.exposure import check_exposure
from nerif.imaging.masks import MaskSettings, flow_mask
from nerif.imaging.readers.views import View, good_pictures
from nerif.imaging.workers import cores, work

__all__ = ["Recording", "RestingView", "camera_of", "measure_instant"]

WORTH_PROCESSES = 2**22  # pixels of all pictures together

Found = tuple[Camera, DisplacementMap, Bool[np.ndarray, "row column"] | None]


@dataclass(frozen=True)
class Recording:
    """Pictures of all views, and how they are to be measured.

    Parameters
    ----------
    views : where the pictures are (views.find_views)
    cameras : calibrated, by the names of the views (importers.import_cameras, cameras_file.read_cameras)
    scene : box and surroundings of the measurement
    method : of the displacements
    masks : of the flow, or None; views with a drawn mask have that
    references : most reference pictures to look at; 0 for all
    pictures : whether a measurement of one instant keeps the pictures beside the displacements
    """

    views: tuple[View, ...]
    cameras: Mapping[str, CalibratedCamera]
    scene: Scene
    method: DisplacementSettings = field(default_factory=DisplacementSettings)
    masks: MaskSettings | None = None
    references: int = 100
    pictures: bool = True

    def __post_init__(self) -> None:
        for view in self.views:
            if view.name not in self.cameras:
                raise InputError(
                    f"calibration: no camera named '{view.name}', only {', '.join(self.cameras)}; "
                    "rename the view's folder, or choose --views"
                )
        if self.references < 0:
            raise InputError(f"references: expected 0 or more, got {self.references}")

    def processes(self, tasks: int, pictures: int) -> int:
        """Return how many processes are worth it for tasks on so many pictures in all."""
        sizes = [c.image_size for c in self.cameras.values() if c.image_size is not None]
        pixels = pictures * max((height * width for height, width in sizes), default=WORTH_PROCESSES)
        return min(cores(), tasks) if pixels >= WORTH_PROCESSES else 1


@dataclass(frozen=True)
class RestingView:
    """A view of which is known what it sees without flow.

    Parameters
    ----------
    view : where its pictures are
    camera : of its pictures
    rest : what the reference says
    masks : of the flow by threshold, or None
    region : (row, column) where the background is seen, or None
    drawn : (row, column) drawn mask of the flow, or None
    pictures : whether a displacement keeps the pictures that it was found in
    """

    view: View
    camera: Camera
    rest: AtRest
    masks: MaskSettings | None = None
    region: Bool[np.ndarray, "row column"] | None = None
    drawn: Bool[np.ndarray, "row column"] | None = None
    pictures: bool = True

    @classmethod
    def of(
        cls, recording: Recording, view: View, averaged: int = 1, say: Callable[[str], None] = lambda line: None
    ) -> RestingView:
        """Look at the reference pictures of a view.

        Parameters
        ----------
        averaged : number of flow pictures whose displacements will be averaged
        say : is told of pictures that cannot be used

        Raises
        ------
        InputError
            If none can be used, or they do not fit the flow pictures or the calibrated camera.
        """
        view.check_alike()
        reference = good_pictures(view, "reference", say, recording.references)
        shape = (reference[0].shape[0], reference[0].shape[1])
        camera = camera_of(view, recording.cameras[view.name], shape)
        rest = AtRest.of(reference, recording.method, view.full_scale, averaged)
        return cls(view, camera, rest, recording.masks, view.drawn("region", shape), view.drawn("mask", shape),
                   recording.pictures)

    def measure(
        self, numbers: Sequence[int], say: Callable[[str], None] = lambda line: None
    ) -> tuple[DisplacementMap, Bool[np.ndarray, "row column"] | None]:
        """Return the displacement, averaged over flow pictures of these numbers, and the flow mask.

        Raises
        ------
        InputError
            If a picture cannot be read, or no pixel holds.
        """
        frames, full = self.view.open("flow"), self.rest.full_scale
        pictures = []
        for i in numbers:
            pictures.append(self.view.cropped(frames[i], frames.name(i)))
            exposure = check_exposure(pictures[-1], full, frames.name(i))
            if exposure:
                say(f"note: {exposure}")
        found = measure_against(self.rest, pictures, self.region, self.pictures)
        if not found.valid.any():
            method = self.rest.settings
            raise InputError(
                f"{frames.name(numbers[0])}: no pixel holds (noise above {method.max_sigma:g} px or correlation below "
                f"{method.min_correlation:g} everywhere); do the pictures show the same pattern, in focus?"
            )
        if self.drawn is not None or self.masks is None:
            return found, self.drawn
        return found, flow_mask(np.where(found.valid[..., None], found.displacement, np.nan), found.sigma, self.masks)


def camera_of(view: View, calibrated: CalibratedCamera, shape: tuple[int, int]) -> Camera:
    """Return the camera of a view's pictures, which may be a crop of those it was calibrated with.

    Raises
    ------
    InputError
        If pictures and calibration do not fit, or the camera has no background to see displaced.
    """
    if calibrated.background is None:
        raise InputError(
            f"view '{view.name}': its camera has no background plane, which displacements need; calibrate it with a "
            "target laid on the background, or give nerif calibrate --background-distance"
        )
    crop, frame = view.crop, view.open("flow").shape
    turned = crop is not None and bool(crop.flip or crop.rotate)
    if calibrated.image_size is None and crop is not None and (turned or frame != shape):
        raise InputError(
            f"view '{view.name}': its pictures are a part of their frames, or turned (views.toml), and its camera has "
            "no image size, so it does not show whether it was calibrated with the same part; give it one: nerif "
            f"calibrate FILE --image-size {shape[0]} {shape[1]} for the part, {frame[0]} {frame[1]} for the whole frame"
        )
    if calibrated.image_size in (None, shape):
        return calibrated.camera(image_size=shape)
    if crop is not None and calibrated.image_size == frame and not turned:
        return calibrated.camera().view(crop.row, crop.column, *shape)
    raise InputError(
        f"view '{view.name}': its pictures have {shape[0]} x {shape[1]} px (height x width), its camera was calibrated "
        f"with {calibrated.image_size}; calibrate with the same crop, or with the whole frame and no flip"
    )


def measure_instant(
    recording: Recording,
    numbers: Sequence[int] = (0,),
    say: Callable[[str], None] = lambda line: None,
    on_view: Callable[[int], None] = lambda done: None,
    processes: int | None = None,
) -> tuple[Measurement, dict[str, str]]:
    """Return the measurement of one instant, and by the name of each view where its noise comes from.

    Parameters
    ----------
    numbers : of the flow pictures, whose displacements are averaged
    say : is told which views and pictures had to be left out, and why
    on_view : called with the number of views done
    processes : 1 for none but this; by default as many as there are processors, if the pictures are large

    Raises
    ------
    InputError
        If no view can be used.
    """
    views = recording.views
    found: dict[int, Found] = {}
    lost = []
    tasks = [(view, tuple(numbers)) for view in views]
    if processes is None:
        processes = recording.processes(len(views), len(views))
    for done, (i, (result, lines)) in enumerate(work(_view, recording, tasks, processes), 1):
        for line in lines:
            say(line)
        if isinstance(result, InputError):
            lost.append(str(result))
            say(f"view '{views[i].name}' left out: {result}")
        else:
            found[i] = result
        on_view(done)
    if not found:
        raise InputError(f"displacement: no view could be used; the first: {lost[0]}")
    order = sorted(found)
    noise = {views[i].name: found[i][1].noise_from for i in order}
    kept = recording.pictures and len(numbers) == 1
    return join_views((found.pop(i) for i in order), recording.scene, kept), noise


def _view(recording: Recording, task: tuple[View, Sequence[int]]) -> tuple[Found | InputError, list[str]]:
    """One view at one instant, or why it cannot be used; and what there is to say."""
    view, numbers = task
    lines: list[str] = []
    try:
        there = len(view.open("flow"))
        if not 0 <= min(numbers) <= max(numbers) < there:
            raise InputError(
                f"frame, average: expected numbers within the {there} flow pictures of view '{view.name}', got "
                f"{min(numbers)} to {max(numbers)}"
            )
        resting = RestingView.of(recording, view, len(numbers), lines.append)
        return (resting.camera, *resting.measure(numbers, lines.append)), lines
    except InputError as error:
        return error, lines
