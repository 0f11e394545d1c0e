"""From the files of vectors of all views to a measurement, or to one for each instant of a film."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.image_names import FOLDER_SUFFIXES
from nerif.data.cameras_file import CalibratedCamera
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence, check_instants
from nerif.geometry import Box
from nerif.imaging.calibration.importers.importers import box_to_reconstruct, import_cameras
from nerif.imaging.calibration.importers.names import cameras_by_view
from nerif.imaging.displacement.displacement import DisplacementMap
from nerif.imaging.imaging_settings import Surroundings
from nerif.imaging.recording import Scene, ViewMeasurement, join_views, silent
from nerif.imaging.vectors.array_vectors import read_array_vectors
from nerif.imaging.vectors.davis import SETS, davis_frames
from nerif.imaging.vectors.program import ProgramVectors
from nerif.imaging.vectors.text_vectors import read_text_vectors
from nerif.imaging.vectors.vector_map import VectorMap, neighbour_noise
from nerif.imaging.vectors.vector_settings import VectorSettings

__all__ = ["VectorFilm", "VectorView", "read_vectors"]

TEXT, ARRAYS, DAVIS = (".txt", ".dat", ".csv", ".vec", ".tsv", ".asc"), (".mat", ".npz", ".nc"), (".vc7", *SETS)
ENDINGS = (*TEXT, *ARRAYS, *DAVIS)
NUMBER = re.compile(r"[ _.\-]*\d+(?:-[\d.]+)?$")
"""Number of a frame at the end of a file name, of Dynamic Studio with its time."""
NAME = "vectors"
"""Attribute of a store with the settings of its measurement."""
MIN_REPEATS = 3
REPEAT_WINDOW = 5  # vectors, edge of the square over which the variance of repeated frames is averaged
LEAST_SIGMA = 0.01  # px of the images

Frame = Callable[[], ProgramVectors]


@dataclass(frozen=True)
class VectorView:
    """Vectors of a view over its instants, and its camera."""

    name: str
    frames: tuple[Frame, ...]
    camera: CalibratedCamera
    settings: VectorSettings

    def __len__(self) -> int:
        return len(self.frames)

    def map(self, index: int) -> VectorMap:
        """Return the vectors of one instant on the grid of the flow image, in px of the images."""
        place = f"view '{self.name}'"
        height = None if self.camera.image_size is None else self.camera.image_size[0]
        flow_first = self.settings.first_image == "flow"
        return self.frames[index]().stated(self.settings).map(height, place, flow_first).on_flow_image()

    def measure(self, numbers: Sequence[int]) -> ViewMeasurement:
        """Return camera, mean displacement over these instants, and its noise."""
        place = f"view '{self.name}'"
        maps = [self.map(i) for i in numbers]
        for other in maps[1:]:
            if (other.displacement.shape, other.origin, other.step) != (
                maps[0].displacement.shape, maps[0].origin, maps[0].step,
            ):  # fmt: skip
                raise InputError("expected all frames on one grid, got another in a later frame", field=place)
        vectors = maps[0]
        if len(maps) > 1:
            vectors = replace(vectors, displacement=_mean([m.displacement for m in maps]))
        if not vectors.valid.any():
            raise InputError("no vector that its flags allow", field=place)
        sigma, source = self._noise(maps, vectors)
        d, scaled = replace(vectors, sigma=sigma).scaled()
        assert scaled is not None
        valid = vectors.valid & np.isfinite(scaled).all(axis=-1)
        return ViewMeasurement(vectors.camera(self.camera, place), DisplacementMap(d, scaled, valid, source), None)

    def _noise(self, maps: Sequence[VectorMap], mean: VectorMap) -> tuple[np.ndarray, str]:
        """Return the standard deviation of the mean, px of the images, and where it comes from."""
        wanted, shape = self.settings.noise, mean.displacement.shape
        if self.settings.sigma:
            return np.full(shape, self.settings.sigma, dtype=np.float32), "--sigma"
        stated = [m.sigma for m in maps if m.sigma is not None]
        if wanted in ("auto", "file") and len(stated) == len(maps):
            variance = np.square(np.stack(stated)).sum(axis=0) / len(maps) ** 2
            return np.maximum(np.sqrt(variance), LEAST_SIGMA).astype(np.float32), "file"
        if wanted == "file":
            raise InputError("expected an uncertainty beside the vectors, got none; choose another", field="noise")
        if wanted in ("auto", "repeats") and len(maps) >= MIN_REPEATS:
            return _scatter([m.displacement for m in maps]), "repeats"
        if wanted == "repeats":
            raise InputError(
                f"expected at least {MIN_REPEATS} frames to average, got {len(maps)}; give --average", field="noise"
            )
        sigma = np.array(neighbour_noise(mean.displacement, mean.windowed / mean.pixel), dtype=np.float32)
        return np.broadcast_to(sigma, shape).copy(), "neighbours"


def _mean(maps: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean over frames; NaN where a vector is missing in most of them."""
    stack = np.stack(maps)
    count = np.isfinite(stack).sum(axis=0)
    total = np.nansum(stack, axis=0)
    return np.where(2 * count > len(maps), total / np.maximum(count, 1), np.nan).astype(np.float32)


def _scatter(maps: Sequence[np.ndarray]) -> np.ndarray:
    """Return the standard deviation of the mean by the variance between frames, averaged over neighbours."""
    from scipy.ndimage import uniform_filter

    stack = np.stack(maps).astype(np.float64)
    count = np.isfinite(stack).sum(axis=0)
    squares = np.nansum(np.square(stack - _mean(maps)), axis=0)
    size = (REPEAT_WINDOW, REPEAT_WINDOW, 1)
    freedom = uniform_filter(np.maximum(count - 1.0, 0.0), size)
    variance = uniform_filter(np.where(count > 1, squares, 0.0), size) / np.maximum(freedom, 1e-9)
    variance /= np.maximum(count, 1)
    return np.sqrt(np.maximum(variance, LEAST_SIGMA**2)).astype(np.float32)


@dataclass(frozen=True)
class VectorFilm:
    """Vectors of all views over their instants."""

    views: tuple[VectorView, ...]
    scene: Scene
    notes: tuple[str, ...] = field(default=())  #: how the files were read, a line each

    def __len__(self) -> int:
        return min(len(view) for view in self.views)

    @classmethod
    def open(
        cls, source: str | os.PathLike[str], calibration: str | os.PathLike[str],
        settings: VectorSettings | None = None, box: Box | None = None, surroundings: Surroundings | None = None,
        views: Sequence[str] = (), say: Callable[[str], None] = silent,
    ) -> VectorFilm:  # fmt: skip
        """Find the vectors of each view, and its camera.

        Parameters
        ----------
        source : a folder with a folder or a file for each view, or numbered files of its film; or one file of all views
        calibration : of `import_cameras`
        box : to reconstruct, mm; None: that of the calibration
        views : to use; all if empty
        """
        source, calibration = Path(source), Path(calibration)
        settings, cameras = settings or VectorSettings(), import_cameras(calibration)
        scene = Scene(box_to_reconstruct(box, calibration), surroundings or Surroundings())
        frames = _frames_by_view(source, settings, [camera.name for camera in cameras])
        by_view = cameras_by_view([*frames], cameras, say)
        if unknown := [name for name in views or frames if name not in frames]:
            raise InputError(f"expected views out of {', '.join(frames)}, got '{unknown[0]}'", field="views")
        opened = []
        for name in views or frames:
            if name not in by_view:
                raise InputError(
                    f"no camera named '{name}', only {', '.join(by_view)}; give the file or folder of each view "
                    "the name of its camera, or choose --views",
                    field=calibration,
                )
            opened.append(VectorView(name, frames[name], by_view[name], settings))
        words = {view.name: view.frames[0]().stated(settings).words for view in opened}
        notes = [words[opened[0].name]] if len(set(words.values())) == 1 else [f"{n}: {w}" for n, w in words.items()]
        lengths = {len(view) for view in opened}
        if len(lengths) > 1:
            counts = ", ".join(f"{view.name} {len(view)}" for view in opened)
            notes.append(f"note: views have different numbers of frames ({counts}); the first {min(lengths)} are used")
        return cls(tuple(opened), scene, tuple(notes))

    def measure(
        self, numbers: Sequence[int] = (0,), on_view: Callable[[int], None] = lambda count: None
    ) -> tuple[Measurement, dict[str, str]]:
        """Return the measurement averaged over these instants, and the source of the noise by view."""
        last = max(numbers)
        if last >= len(self):
            raise InputError(f"expected frames 0 to {len(self) - 1}, got {last}", field="frame, average")
        noise: dict[str, str] = {}

        def results() -> Iterator[ViewMeasurement]:
            for count, view in enumerate(self.views, 1):
                result = view.measure(numbers)
                noise[view.name] = result.result.noise_source
                yield result
                on_view(count)

        return join_views(results(), self.scene), noise

    def smaller_grids(self, measurement: Measurement) -> str:
        """Return which views have fewer vectors than others of the same image size, as of cut files; "" if none."""
        sizes = {view.name: view.camera.image_size for view in self.views}
        grids = {camera.name: camera.image_size for camera in measurement.cameras}
        most = {size: max(grids[name] for name in grids if sizes[name] == size) for size in sizes.values()}
        small = [f"{name} {grids[name]} of {most[sizes[name]]}" for name in grids if grids[name] != most[sizes[name]]]
        return (
            f"views with fewer rows or columns of vectors than others: {', '.join(small)}; are their files cut?"
            if small
            else ""
        )

    def write(
        self, out: str | os.PathLike[str], frame_rate: float, numbers: Sequence[int] | None = None, force: bool = False,
        on_frame: Callable[[int], None] = lambda count: None, settings: Mapping[str, Any] | None = None,
    ) -> MeasurementSequence:  # fmt: skip
        """Write a measurement for each instant to a Zarr store, or those that it lacks.

        Parameters
        ----------
        frame_rate : 1/s
        settings : stored; a store with others is not continued
        """
        numbers = range(len(self)) if numbers is None else numbers
        if not frame_rate > 0:
            raise InputError(
                "expected frames per second, as files of vectors have no times; got none", field="frame_rate"
            )
        times = [i / frame_rate for i in numbers]
        check_instants(times, "frames")
        entries = json.loads(json.dumps({**(settings or {}), "times": times}, default=str))
        if Path(out).exists() and not force:
            sequence = MeasurementSequence.resumed(Path(out), NAME, entries)
            sequence.check_cameras(self.measure((numbers[0],))[0].cameras)
        else:
            sequence = MeasurementSequence.create(out, times, self.measure((numbers[0],))[0], force)
            sequence.record(NAME, entries)
        for index, number in enumerate(numbers):
            if not sequence.is_written(index):
                sequence.write_frame(index, self.measure((number,))[0])
            on_frame(index + 1)
        return sequence


def read_vectors(
    source: str | os.PathLike[str], calibration: str | os.PathLike[str], settings: VectorSettings | None = None,
    frame: int = 0, average: int = 1, box: Box | None = None,
) -> Measurement:  # fmt: skip
    """Return the measurement of vectors that another program computed (docs/vectors.md).

    Parameters
    ----------
    source : a folder with a folder or a file for each view, or one file of all views
    calibration : cameras with the names of the views
    frame, average : first instant, and number of instants whose vectors are averaged
    box : to reconstruct, mm; None: that of the calibration
    """
    return VectorFilm.open(source, calibration, settings, box).measure(range(frame, frame + average))[0]


def _frames_by_view(source: Path, settings: VectorSettings, cameras: Sequence[str]) -> dict[str, tuple[Frame, ...]]:
    """Return the frames of each view by its name."""
    if not source.exists():
        raise InputError("no such file or folder; expected vectors of all views", field=source)
    if source.is_file():
        maps = read_array_vectors(source, settings) if ending(source) in ARRAYS else []
        if len(maps) != len(cameras):
            raise InputError(
                f"expected a folder with the vectors of each view, or one file ({' '.join(ARRAYS)}) with those of all "
                f"{len(cameras)} cameras, got {f'{len(maps)} maps' if maps else 'a file of one view'}",
                field=source,
            )
        return {name: (partial(_same, vectors),) for name, vectors in zip(cameras, maps, strict=True)}
    depths = ("*", "*/*", "*/*/*")
    has = {ending(path) for depth in depths for path in source.glob(depth)}
    files = {name: paths for name, paths in _files(source, cameras).items() if paths}
    if not files or (has & {*FOLDER_SUFFIXES} and not has & {*TEXT, *DAVIS, ".mat"} and not {*files} & {*cameras}):
        got = "images; nerif displacement evaluates those" if has & {*FOLDER_SUFFIXES} else "none"
        raise InputError(f"expected files of vectors ({' '.join(ENDINGS)}) for each view, got {got}", field=source)
    return {name: tuple(f for path in paths for f in _of_file(path, settings)) for name, paths in files.items()}


def _same(vectors: ProgramVectors) -> ProgramVectors:
    return vectors


def _of_file(path: Path, settings: VectorSettings) -> list[Frame]:
    kind = ending(path)
    if kind in DAVIS:
        return [*davis_frames(path)]
    if kind in ARRAYS:
        return [partial(_same, vectors) for vectors in read_array_vectors(path, settings)]

    return [partial(read_text_vectors, path, settings)]


def _files(folder: Path, cameras: Sequence[str]) -> dict[str, list[Path]]:
    """Return the files of each view in the order of their numbers: in a folder of its own, or with its name first."""
    entries = sorted(folder.iterdir(), key=_order)
    sets = {entry.stem for entry in entries if ending(entry) in SETS}  # a set is a file and a folder
    files: dict[str, list[Path]] = {}
    for entry in entries:
        if entry.is_dir():
            if entry.name not in sets and (inside := sorted(filter(_is_vectors, entry.iterdir()), key=_order)):
                files.setdefault(entry.name, []).extend(inside)
        elif _is_vectors(entry):
            files.setdefault(_view_of(entry.stem, cameras), []).append(entry)
    for name, paths in files.items():
        kinds = {ending(path): path for path in reversed(paths)}
        if len(kinds) > 1:
            names = " and ".join(path.name for path in kinds.values())
            raise InputError(f"expected one file or film of view '{name}', got {names}; remove one", field=folder)
    return files


def _is_vectors(path: Path) -> bool:
    return path.is_file() and ending(path) in ENDINGS and not path.name.startswith(".")


def _order(path: Path) -> tuple[tuple[str, int], ...]:
    """Key by which file 10 is behind file 9."""
    return tuple((text, int(number or -1)) for text, number in re.findall(r"(\D*)(\d*)", path.name))


def _view_of(stem: str, cameras: Sequence[str]) -> str:
    """Return the camera whose name a file has, alone or before the number of its frame; else the stem."""
    if stem in cameras:
        return stem
    named = [name for name in cameras if stem.startswith(name) and NUMBER.fullmatch(stem[len(name) :])]
    if named:
        return max(named, key=len)
    return stem
