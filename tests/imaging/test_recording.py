"""From the folders of an experiment to measurements: what is left out, what is masked, how often files are read."""

from __future__ import annotations

import multiprocessing
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import tifffile
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from nerif.common.conventions import InputError
from nerif.geometry import Box, Lens, Plane, Ring
from nerif.imaging import workers
from nerif.imaging.calibration.cameras_file import CalibratedCamera
from nerif.imaging.displacement.displacement import DisplacementSettings
from nerif.imaging.masks import MaskSettings
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import View, find_views
from nerif.imaging.recording import Recording, Scene, ViewReference, camera_of, measure_instant
from nerif.imaging.recording_sequence import RecordingReference, measure_recording
from refusals import refused

SHAPE = (60, 72)
BOX = Box((-25.0, -25.0, -25.0), (25.0, 25.0, 25.0))
VIEWS = 3


def write_experiment(folder, frames: int = 3, shift: int = 0, spot: bool = False) -> Recording:
    """Images of a 12-bit camera, moved up by `shift`: dots, displaced by 0.8 px in the middle; maybe a reflection."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    bump = 0.8 * np.exp(-(((rows - 30) / 8) ** 2) - ((columns - 36) / 10) ** 2)
    cameras = Ring(views=VIEWS, arc=(0.0, 120.0), image_size=SHAPE, pixel_pitch=0.06).cameras()
    for camera in cameras:
        seeds = (rng.random((SHAPE[0] + 20, SHAPE[1] + 20)) < 0.06).astype(float)
        dots = gaussian_filter(seeds, 1.1)
        dots = np.clip(dots / np.percentile(dots, 99), 0, 1)

        def shot(d, count, dots=dots):
            seen = map_coordinates(dots, [rows + 10 - d, columns + 10], order=3)
            noise = 12 * rng.standard_normal((count, *SHAPE))
            grey = 300 + 2200 * seen + noise
            if spot:
                grey[:, 10:20, 50:62] = 5000
            return np.clip(grey, 0, 4095).astype(np.uint16) << shift

        for source, images in (("reference", shot(0 * bump, 3)), ("flow", shot(bump, frames))):
            path = folder / camera.name / f"{source}.tif"
            path.parent.mkdir(parents=True, exist_ok=True)
            tifffile.imwrite(path, images, photometric="minisblack")
    calibrated = {c.name: CalibratedCamera.from_camera(c) for c in cameras}
    return Recording(find_views(folder), calibrated, Scene(BOX), DisplacementSettings("dis"))  # the fastest


@pytest.fixture
def recording(tmp_path) -> Recording:
    return write_experiment(tmp_path)


def test_a_view_without_a_background_shows_no_displacement(recording):
    blind = replace(recording.cameras["0deg"], background=None)
    lines: list[str] = []
    found, _ = measure_instant(replace(recording, cameras={**recording.cameras, "0deg": blind}), say=lines.append)
    assert found.names == ("60deg", "120deg")
    assert any("'0deg' left out: view '0deg': its camera has no background plane" in line for line in lines)


def test_a_film_of_one_instant_is_the_measurement(recording, tmp_path):
    single, noise = measure_instant(replace(recording, images=False))
    film = measure_recording(recording, range(1), [0.0], tmp_path / "film.zarr")
    assert noise == dict.fromkeys(single.names, "repeats")
    frame = film.frame(0)
    assert frame.names == single.names
    for name in ("displacement", "sigma", "valid"):
        assert torch.equal(getattr(frame, name).nan_to_num(), getattr(single, name).nan_to_num()), name


OTHER = {
    "background": Plane(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), -400.0),
    "translation": torch.tensor([0.0, 0.001, 900.0], dtype=torch.float64),
    "distortion": torch.tensor([1e-6, 0, 0, 0, 0], dtype=torch.float64),
    "lens": Lens(3.0),
    "pose_sigma": torch.ones(6, dtype=torch.float64),
}


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A recording of one view, and a film of it."""
    folder = tmp_path_factory.mktemp("film")
    whole = write_experiment(folder, frames=1)
    recording = replace(whole, views=whole.views[:1])
    measure_recording(recording, range(1), [0.0], folder / "film.zarr")
    return recording, folder / "film.zarr"


@pytest.mark.parametrize("what", [*OTHER, "views"])
def test_a_film_begun_with_other_cameras_is_not_gone_on_with(begun, what):
    recording, out = begun
    view, words = recording.views[0], what
    if what == "views":
        other = replace(recording, views=(replace(view, name="60deg"),))
    else:
        camera, words = replace(recording.cameras[view.name], **{what: OTHER[what]}), f"{what} of view '{view.name}'"
        other = replace(recording, cameras={**recording.cameras, view.name: camera})
    with pytest.raises(InputError, match=f"film.zarr: expected the cameras .* got other {words}.*--out, or --force"):
        measure_recording(other, range(1), [0.0], out)


def test_a_film_is_gone_on_with_whatever_rounding_did_to_its_cameras(begun):
    recording, out = begun
    near = {
        name: replace(camera, rotation=camera.rotation + 1e-13, lens=Lens(0.0, 900.0))
        for name, camera in recording.cameras.items()
    }
    lines: list[str] = []
    measure_recording(replace(recording, cameras=near), range(1), [0.0], out, say=lines.append)
    assert any("1 of 1 frames are there already" in line for line in lines)


@pytest.mark.parametrize(
    ("crop", "shape"), [(Crop(column=10), (60, 62)), (Crop(flip="vertical"), SHAPE), (Crop(rotate=180), SHAPE)]
)
def test_a_part_of_the_frames_needs_the_image_size_of_the_calibration(tmp_path, crop, shape):
    (whole,) = Ring(views=1, arc=(0.0, 120.0), image_size=SHAPE, pixel_pitch=0.06).cameras()
    tifffile.imwrite(tmp_path / "flow.tif", np.zeros(SHAPE, np.uint16))
    view = View("left", tmp_path, {"flow": "flow.tif"}, crop)
    unsized = replace(CalibratedCamera.from_camera(whole), image_size=None)
    with refused("view 'left'"):
        camera_of(view, unsized, shape)
    assert camera_of(view, replace(unsized, image_size=shape), shape).image_size == shape
    assert camera_of(replace(view, crop=Crop()), unsized, SHAPE).image_size == SHAPE


@pytest.mark.slow
def test_several_processes_find_what_one_does(recording, tmp_path):
    single, _ = measure_instant(recording, processes=1)
    several, _ = measure_instant(recording, processes=2)
    assert torch.equal(several.displacement, single.displacement)
    film = measure_recording(recording, range(3), [0.0, 1.0, 2.0], tmp_path / "film.zarr", processes=2)
    assert torch.equal(film.frame(0).displacement, single.displacement)
    assert all(film.is_written(i) for i in range(3))


def test_processes_start_where_there_is_no_fork_server(monkeypatch):
    monkeypatch.setattr(workers, "get_all_start_methods", lambda: ["spawn"])  # as on Windows
    assert workers.start_method() == "spawn"
    monkeypatch.setattr(workers, "get_all_start_methods", multiprocessing.get_all_start_methods)
    assert workers.start_method() in multiprocessing.get_all_start_methods()


def test_average_lowers_the_noise_that_is_stated(recording):
    one, _ = measure_instant(recording, (0,))
    three, _ = measure_instant(recording, (0, 1, 2))
    assert three.sigma is not None
    assert one.sigma is not None
    assert float(three.sigma.median()) < 0.9 * float(one.sigma.median())


def test_numbers_that_a_view_lacks_cost_the_view_alone(recording):
    said: list[str] = []
    path = recording.views[1].folder / recording.views[1].sources["flow"]
    tifffile.imwrite(path, tifffile.imread(path)[:1])
    measurement, _ = measure_instant(recording, (2,), said.append)
    assert measurement.names == (recording.views[0].name, recording.views[2].name)
    assert any("expected numbers within the 1 flow images" in line for line in said)


def test_views_without_a_camera_are_named(recording):
    _, *others = recording.cameras
    with refused("calibration"):
        replace(recording, cameras={name: recording.cameras[name] for name in others})


@pytest.mark.parametrize("shift", [0, 4])
def test_saturated_pixels_are_not_valid_whichever_side_the_bits_are_on(tmp_path, shift):
    measurement, _ = measure_instant(write_experiment(tmp_path, shift=shift, spot=True))
    valid = measurement.usable
    assert not valid[:, 10:20, 50:62].any()
    assert float(valid[:, 25:, 5:65].float().mean()) > 0.95


@pytest.mark.parametrize("film", [False, True])
def test_pixels_that_are_not_valid_are_inside_the_flow_mask(tmp_path, film):
    recording = replace(write_experiment(tmp_path, spot=True), masks=MaskSettings(smallest=16))
    measurement = RecordingReference.of(recording).measure(0)[0] if film else measure_instant(recording)[0]
    assert measurement.flow_mask is not None
    usable = measurement.usable
    assert not bool(usable.all())
    assert bool(measurement.flow_mask[~usable].all())
    assert float(measurement.flow_mask[usable].float().mean()) < 0.4
    assert bool(measurement.flow_mask[:, 25:35, 31:41].all())


def test_a_film_is_opened_once_and_each_page_read_once(tmp_path, monkeypatch):
    """Each page is parsed when the pages are counted or read, never those before it once more."""
    pages = 240
    view = write_experiment(tmp_path, frames=pages).views[0]
    opens, reads = Counter[str](), Counter[int]()
    tiff, read = tifffile.TiffFile.__init__, tifffile.TiffPage.asarray

    def counting_open(self, file, *args, **kwargs):
        opens[file.name] += 1
        tiff(self, file, *args, **kwargs)

    def counting_read(self, *args, **kwargs):
        reads[self.index] += 1
        return read(self, *args, **kwargs)

    monkeypatch.setattr(tifffile.TiffFile, "__init__", counting_open)
    monkeypatch.setattr(tifffile.TiffPage, "asarray", counting_read)
    for number in range(pages):
        frames = view.open("flow")
        assert len(frames) == pages
        view.cropped(frames[number], frames.name(number))
    assert set(opens.values()) == {1}
    assert sum(reads.values()) <= pages + 5  # five tell the layout


def test_a_view_is_measured_without_opening_its_files_again(recording, monkeypatch):
    resting = ViewReference.of(recording, recording.views[0])
    opens: list[str] = []
    opened = tifffile.TiffFile.__init__

    def counted(self, file, *arguments, **more):
        opens.append(file.name)
        opened(self, file, *arguments, **more)

    monkeypatch.setattr(tifffile.TiffFile, "__init__", counted)
    for number in range(3):
        resting.measure([number])
    assert not opens
