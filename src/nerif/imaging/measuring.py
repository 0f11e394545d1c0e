"""From the images of an experiment to a measurement, of one instant or of many.

What follows from the reference images of a view is computed once (RestingView); each instant is compared with it. A
single measurement is a film of one instant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool

from nerif.common.conventions import AMBIENT_INDEX, DEFAULT_AMBIENT_FACES, InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Box, Camera
from nerif.imaging.calibration.cameras_file import CalibratedCamera
from nerif.imaging.displacement.displacement import AtRest, DisplacementMap, DisplacementSettings, measure_against
from nerif.imaging.displacement.exposure import check_exposure
from nerif.imaging.masks import MaskSettings, flow_mask
from nerif.imaging.readers.views import View, good_images
from nerif.imaging.workers import cores, work

__all__ = ["Recording", "RestingView", "Scene", "Surroundings", "camera_of", "join_views", "measure_instant"]

Mask = Bool[np.ndarray, "row column"]


@dataclass(frozen=True)
class Surroundings:
    """The gas around the flow, and the light through it."""

    n_ambient: float = AMBIENT_INDEX
    """Refractive index around the flow."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES
    """Faces of the box on which the index is ambient."""


@dataclass(frozen=True)
class Scene:
    """What a measurement holds beside its views: the box to reconstruct, and what is around the flow."""

    box: Box
    surroundings: Surroundings = Surroundings()


def join_views(
    views: Iterable[tuple[Camera, DisplacementMap, Mask | None]], scene: Scene, images: bool = False
) -> Measurement:
    """Return one measurement of all views; smaller images are padded.

    With images a pixel is valid where one of the two says something, and the other is NaN there.

    Parameters
    ----------
    views : camera, displacement and flow mask (or None) of each, held one at a time
    scene : box and surroundings
    images : whether to keep those that the displacements were found in
    """
    cameras: list[Camera] = []
    maps: dict[str, list[np.ndarray]] = {"displacement": [], "sigma": [], "valid": [], "flow_mask": []}
    masked = False
    for camera, found, mask in views:
        cameras.append(camera)
        everywhere = np.ones(found.valid.shape, dtype=bool)  # no mask says nothing about where the flow is
        masked |= mask is not None
        own = {"displacement": found.displacement, "sigma": found.sigma, "valid": found.valid}
        own["flow_mask"] = everywhere if mask is None else mask
        if images and found.pair is not None:
            own["displacement"] = np.where(found.valid[..., None], found.displacement, np.float32(np.nan))
            own["valid"] = found.valid | np.isfinite(found.pair.flow)
            own |= {"reference": found.pair.reference, "flow": found.pair.flow, "image_sigma": found.pair.sigma}
        for name, array in own.items():
            maps.setdefault(name, []).append(array)
    size = tuple(max(v.shape[k] for v in maps["valid"]) for k in range(2))

    def stack(name: str) -> torch.Tensor:
        arrays = maps[name]
        kind = arrays[0].dtype
        whole = np.full((len(arrays), *size, *arrays[0].shape[2:]), np.nan if kind.kind == "f" else 0, dtype=kind)
        for own in whole:
            array = arrays.pop(0)  # not kept beside its copy
            own[: array.shape[0], : array.shape[1]] = array
        return torch.from_numpy(whole)

    return Measurement(
        cameras=tuple(cameras),
        displacement=stack("displacement"),
        box=scene.box,
        n_ambient=scene.surroundings.n_ambient,
        sigma=stack("sigma"),
        valid=stack("valid"),
        maps={name: stack(name) for name in ("reference", "flow", "image_sigma") if name in maps},
        flow_mask=stack("flow_mask") if masked else None,
        wavelength_nm=scene.surroundings.wavelength_nm,
        ambient_faces=scene.surroundings.ambient_faces,
    )


WORTH_PROCESSES = 2**22  # pixels of all images together

Found = tuple[Camera, DisplacementMap, Bool[np.ndarray, "row column"] | None]


@dataclass(frozen=True)
class Recording:
    """Images of all views, and how they are to be measured.

    Parameters
    ----------
    views : where the images are (views.find_views)
    cameras : calibrated, by the names of the views (importers.import_cameras, cameras_file.read_cameras)
    scene : box and surroundings of the measurement
    method : of the displacements
    masks : of the flow, or None; views with a drawn mask have that
    references : most reference images to look at; 0 for all
    images : whether a measurement of one instant keeps the images beside the displacements
    """

    views: tuple[View, ...]
    cameras: Mapping[str, CalibratedCamera]
    scene: Scene
    method: DisplacementSettings = field(default_factory=DisplacementSettings)
    masks: MaskSettings | None = None
    references: int = 100
    images: bool = True

    def __post_init__(self) -> None:
        for view in self.views:
            if view.name not in self.cameras:
                raise InputError(
                    f"no camera named '{view.name}', only {', '.join(self.cameras)}; "
                    "rename the view's folder, or choose --views",
                    field="calibration",
                )
        if self.references < 0:
            raise InputError(f"expected 0 or more, got {self.references}", field="references")

    def processes(self, tasks: int, images: int) -> int:
        """Return how many processes are worth it for tasks on so many images in all."""
        sizes = [c.image_size for c in self.cameras.values() if c.image_size is not None]
        pixels = images * max((height * width for height, width in sizes), default=WORTH_PROCESSES)
        return min(cores(), tasks) if pixels >= WORTH_PROCESSES else 1


@dataclass(frozen=True)
class RestingView:
    """A view of which is known what it sees without flow.

    Parameters
    ----------
    view : where its images are
    camera : of its images
    rest : what the reference says
    masks : of the flow by threshold, or None
    region : (row, column) where the background is seen, or None
    drawn : (row, column) drawn mask of the flow, or None
    images : whether a displacement keeps the images that it was found in
    """

    view: View
    camera: Camera
    rest: AtRest
    masks: MaskSettings | None = None
    region: Bool[np.ndarray, "row column"] | None = None
    drawn: Bool[np.ndarray, "row column"] | None = None
    images: bool = True

    @classmethod
    def of(
        cls, recording: Recording, view: View, averaged: int = 1, say: Callable[[str], None] = lambda line: None
    ) -> RestingView:
        """Look at the reference images of a view.

        Parameters
        ----------
        averaged : number of flow images whose displacements will be averaged
        say : is told of images that cannot be used

        Raises
        ------
        InputError
            If none can be used, or they do not fit the flow images or the calibrated camera.
        """
        view.check_alike()
        reference = good_images(view, "reference", say, recording.references)
        shape = (reference[0].shape[0], reference[0].shape[1])
        camera = camera_of(view, recording.cameras[view.name], shape)
        rest = AtRest.of(reference, recording.method, view.full_scale, averaged)
        return cls(
            view,
            camera,
            rest,
            recording.masks,
            view.drawn("region", shape),
            view.drawn("mask", shape),
            recording.images,
        )

    def measure(
        self, numbers: Sequence[int], say: Callable[[str], None] = lambda line: None
    ) -> tuple[DisplacementMap, Bool[np.ndarray, "row column"] | None]:
        """Return the displacement, averaged over flow images of these numbers, and the flow mask.

        Raises
        ------
        InputError
            If an image cannot be read, or no pixel holds.
        """
        frames, full = self.view.open("flow"), self.rest.full_scale
        images = []
        for i in numbers:
            images.append(self.view.cropped(frames[i], frames.name(i)))
            exposure = check_exposure(images[-1], full, frames.name(i))
            if exposure:
                say(f"note: {exposure}")
        found = measure_against(self.rest, images, self.region, self.images)
        if not found.valid.any():
            method = self.rest.settings
            raise InputError(
                f"no pixel holds (noise above {method.max_sigma:g} px or correlation below "
                f"{method.min_correlation:g} everywhere); do the images show the same pattern, in focus?",
                field=frames.name(numbers[0]),
            )
        if self.drawn is not None or self.masks is None:
            return found, self.drawn
        return found, flow_mask(np.where(found.valid[..., None], found.displacement, np.nan), found.sigma, self.masks)


def camera_of(view: View, calibrated: CalibratedCamera, shape: tuple[int, int]) -> Camera:
    """Return the camera of a view's images, which may be a crop of those it was calibrated with.

    Raises
    ------
    InputError
        If images and calibration do not fit, or the camera has no background to see displaced.
    """
    if calibrated.background is None:
        raise InputError(
            "its camera has no background plane, which displacements need; calibrate it with a "
            "target laid on the background, or give nerif calibrate --background-distance",
            field=f"view '{view.name}'",
        )
    crop, frame = view.crop, view.open("flow").shape
    turned = crop is not None and bool(crop.flip or crop.rotate)
    if calibrated.image_size is None and crop is not None and (turned or frame != shape):
        raise InputError(
            f"its images are a part of their frames, or turned (views.toml), and its camera has "
            "no image size, so it does not show whether it was calibrated with the same part; give it one: nerif "
            f"calibrate FILE --image-size {shape[0]} {shape[1]} (the part) or {frame[0]} {frame[1]} (the whole frame)",
            field=f"view '{view.name}'",
        )
    if calibrated.image_size in (None, shape):
        return calibrated.camera(image_size=shape)
    if crop is not None and calibrated.image_size == frame and not turned:
        return calibrated.camera().view(crop.row, crop.column, *shape)
    raise InputError(
        f"its images have {shape[0]} x {shape[1]} px (height x width), its camera was calibrated "
        f"with {calibrated.image_size}; calibrate with the same crop, or with the whole frame and no flip",
        field=f"view '{view.name}'",
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
    numbers : of the flow images, whose displacements are averaged
    say : is told which views and images had to be left out, and why
    on_view : called with the number of views done
    processes : 1 for none but this; by default as many as there are processors, if the images are large

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
        raise InputError(f"no view could be used; the first: {lost[0]}", field="displacement")
    order = sorted(found)
    noise = {views[i].name: found[i][1].noise_from for i in order}
    kept = recording.images and len(numbers) == 1
    return join_views((found.pop(i) for i in order), recording.scene, kept), noise


def _view(recording: Recording, task: tuple[View, Sequence[int]]) -> tuple[Found | InputError, list[str]]:
    """One view at one instant, or why it cannot be used; and what there is to say."""
    view, numbers = task
    lines: list[str] = []
    try:
        there = len(view.open("flow"))
        if not 0 <= min(numbers) <= max(numbers) < there:
            raise InputError(
                f"expected numbers within the {there} flow images of view '{view.name}', got "
                f"{min(numbers)} to {max(numbers)}",
                field="frame, average",
            )
        resting = RestingView.of(recording, view, len(numbers), lines.append)
        return (resting.camera, *resting.measure(numbers, lines.append)), lines
    except InputError as error:
        return error, lines
