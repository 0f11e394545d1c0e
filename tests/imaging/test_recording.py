"""From the folders of an experiment to measurements: views left out, masks, sequences, number of file accesses."""

from __future__ import annotations

import multiprocessing
import os
import pickle
from collections import Counter
from dataclasses import replace

import h5py
import numpy as np
import pytest
import tifffile
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from imaging_files import write_cine
from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera
from nerif.data.measurement import Measurement
from nerif.geometry import Box, Lens, Plane, Ring
from nerif.imaging import workers
from nerif.imaging.imaging_settings import DisplacementSettings, MaskSettings
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import View, find_views, paired
from nerif.imaging.recording import Recording, Scene, ViewReference, camera_of, measure_instant
from nerif.imaging.recording_sequence import frame_numbers, instants_of, measure_recording
from refusals import refused

SHAPE = (60, 72)
BLANK = np.zeros((4, 5), np.uint8)
BOX = Box((-25.0, -25.0, -25.0), (25.0, 25.0, 25.0))


def write_experiment(folder, frames: int = 3, shift: int = 0, spot: bool = False) -> Recording:
    """Images of a 12-bit camera in three views, shifted up by `shift` bits: dots, displaced by 0.8 px in the middle."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    bump = 0.8 * np.exp(-(((rows - 30) / 8) ** 2) - ((columns - 36) / 10) ** 2)
    cameras = Ring(views=3, arc=(0.0, 120.0), image_size=SHAPE, pixel_pitch=0.06).cameras()
    for camera in cameras:
        dots = gaussian_filter((rng.random((SHAPE[0] + 20, SHAPE[1] + 20)) < 0.06).astype(float), 1.1)
        dots = np.clip(dots / np.percentile(dots, 99), 0, 1)
        for source, d, count in (("reference", 0 * bump, 3), ("flow", bump, frames)):
            pattern = map_coordinates(dots, [rows + 10 - d, columns + 10], order=3)
            grey = 300 + 2200 * pattern + 12 * rng.standard_normal((count, *SHAPE))
            if spot:
                grey[:, 10:20, 50:62] = 5000
            path = folder / camera.name / f"{source}.tif"
            path.parent.mkdir(parents=True, exist_ok=True)
            tifffile.imwrite(path, np.clip(grey, 0, 4095).astype(np.uint16) << shift, photometric="minisblack")
    calibrated = {c.name: CalibratedCamera.from_camera(c) for c in cameras}
    return Recording(find_views(folder), calibrated, Scene(BOX), DisplacementSettings("dis"))  # the fastest


@pytest.fixture
def recording(tmp_path) -> Recording:
    return write_experiment(tmp_path)


def test_views_that_cannot_be_used_are_left_out(recording, tmp_path, lines):
    path = recording.views[1].folder / recording.views[1].sources["flow"]
    tifffile.imwrite(path, tifffile.imread(path)[:1])
    cameras = {**recording.cameras, "0deg": replace(recording.cameras["0deg"], background=None)}
    short = replace(recording, views=find_views(tmp_path), cameras=cameras)
    measurement, _ = measure_instant(short, (2,), lines.append)
    assert measurement.names == ("120deg",)
    assert any("'0deg' left out: view '0deg': its camera has no background plane" in line for line in lines)
    assert any(
        "'60deg' left out" in line and "within 0 to 0, those of view '60deg' (1 flow images)" in line for line in lines
    )
    del cameras["0deg"]
    with refused("calibration"):
        replace(recording, cameras=cameras)


def test_a_film_gives_the_measurement_of_its_images(recording, tmp_path, lines):
    view = recording.views[0]
    folder = tmp_path / view.name
    images = np.concatenate([tifffile.imread(folder / f"{source}.tif") for source in ("reference", "flow")])
    write_cine(folder / "run.cine", [image[::-1].tobytes() for image in images], *SHAPE, flip=1)
    sources = {"reference": f"{view.name}/run.cine[:3]", "flow": f"{view.name}/run.cine[3:]"}
    film = ViewReference.of(recording, replace(view, sources=sources), say=lines.append)
    (note,) = lines  # once, though two sources have it
    assert note.startswith(f"note: {view.name}/run.cine: shown flipped")
    stack = ViewReference.of(recording, view)
    ours, theirs = film.measure([1]).result, stack.measure([1]).result
    np.testing.assert_array_equal(ours.displacement, theirs.displacement)
    np.testing.assert_array_equal(ours.valid, theirs.valid)


def test_a_sequence_of_one_frame_equals_the_measurement(recording, tmp_path):
    single, noise = measure_instant(replace(recording, images=False))
    frame = measure_recording(recording, range(1), [0.0], tmp_path / "film.zarr").frame(0)
    assert noise == dict.fromkeys(single.names, "repeats")
    assert frame.names == single.names
    for name in ("displacement", "sigma", "valid"):
        assert torch.equal(getattr(frame, name).nan_to_num(), getattr(single, name).nan_to_num()), name


def test_instant_i_is_flow_image_i_plus_the_offset_of_the_view(recording, tmp_path):
    offsets = {"60deg": -2, "120deg": 1}
    shifted = replace(recording, views=find_views(tmp_path, frame_offsets=offsets))
    one = replace(shifted, views=shifted.views[:2], images=False)
    numbers = frame_numbers("all", one.views)
    assert numbers == (2,)  # of three flow images each
    assert instants_of(numbers, one.views[1], 10.0) == (0.2,)
    plain = [measure_instant(replace(recording, images=False), (i,))[0].displacement for i in range(3)]
    assert not torch.equal(plain[0].nan_to_num(), plain[2].nan_to_num())
    single, _ = measure_instant(one, numbers)
    film = measure_recording(one, numbers, [0.2], tmp_path / "film.zarr")
    for measurement in (single, film.frame(0)):
        assert measurement.frame_offsets.get("60deg") == -2
        assert torch.equal(measurement.displacement[0].nan_to_num(), plain[2][0].nan_to_num())
        assert torch.equal(measurement.displacement[1].nan_to_num(), plain[0][1].nan_to_num())
    single.write(tmp_path / "m.nc")
    read = Measurement.read(tmp_path / "m.nc")
    assert read.frame_offsets == {"60deg": -2}
    assert read.select(["0deg"]).frame_offsets.get("0deg", 0) == 0
    with pytest.raises(InputError, match="other settings; give another --out, or --force"):
        measure_recording(replace(one, views=recording.views[:2]), numbers, [0.2], tmp_path / "film.zarr")


def test_instants_without_a_flow_image_in_some_view_are_refused(recording, tmp_path, lines):
    views = find_views(tmp_path, frame_offsets={"60deg": -2, "120deg": 1})
    with pytest.raises(InputError, match=r"got none in common \(0deg 0 to 2, 60deg 2 to 4, 120deg 0 to 1\)"):
        frame_numbers("all", views)
    with pytest.raises(
        InputError, match=r"within 2 to 4, those of view '60deg' \(3 flow images, frame offset -2\), got 1 to 2"
    ):
        frame_numbers("1:3", views)
    measurement, _ = measure_instant(replace(recording, views=views), (1,), lines.append)
    assert measurement.names == ("0deg", "120deg")
    assert any("'60deg' left out: frame, average: expected numbers within 2 to 4" in line for line in lines)
    with refused("frame_offset"):
        find_views(tmp_path, frame_offsets={"61deg": 1})
    view = find_views(tmp_path, ["60deg"], {"60deg": 9})[0]
    assert not view.instants
    with pytest.raises(InputError, match="within none, those of view '60deg'"):
        view.check_instants([0], "frames")
    assert pickle.loads(pickle.dumps(view)) == view  # for another process


ALL = range(8)
NO_4 = [0, 1, 2, 3, 5, 6, 7]


@pytest.mark.parametrize(
    ("first", "second", "instants", "words"),
    [
        (ALL, NO_4, (ALL, NO_4), ["view 'b' has no flow image 4;"]),
        (ALL, range(1, 9), (ALL, ALL), ["b 1 to 8); paired from the first ones, as by --frame-offset b 1"]),
        ([k + 1 for k in NO_4], ALL, (NO_4, ALL), ["--frame-offset a 1;", "view 'a' has no flow image 5;"]),
        (ALL, range(1, 8), (ALL, range(1, 8)), ["are one instant: a 0 to 7, b 1 to 7"]),  # it dropped its first one
        (ALL, range(5, 13), (ALL, range(5, 13)), ["are one instant: a 0 to 7, b 5 to 12"]),
        (ALL, [500 + k for k in NO_4], (ALL, NO_4), ["--frame-offset b 500;", "has no flow image 504;"]),
        ([0, 1, 2, 10, 11, 12], [0, 1, 10, 11, 12], ([0, 1, 2, 10, 11, 12], [0, 1, 10, 11, 12]),
         ["view 'b' has no flow image 2;", "no view has flow image 3 to 9: a gap in time"]),
        (range(-3, 3), range(-3, 3), (range(6), range(6)), []),
        (range(0, 80, 10), [10 * k for k in NO_4], (ALL, NO_4), ["view 'b' has no flow image 40;"]),
        ([1000, 1033, 1067], [1001, 1034, 1066], (range(3), range(3)), ["do not count them", "in the order of their"]),
        (["a", "c"], ["x", "y"], (range(2), range(2)), ["in the order of their names"]),
    ],
)  # fmt: skip
def test_flow_images_are_paired_by_the_numbers_in_their_names(tmp_path, first, second, instants, words):
    for name, numbers in (("a", first), ("b", second)):
        for number in numbers:
            (tmp_path / name / "flow").mkdir(parents=True, exist_ok=True)
            tifffile.imwrite(tmp_path / name / "flow" / f"run2_{number:03}.tif".replace("00-", "-00"), BLANK)
    views = paired(find_views(tmp_path))
    for view, expected, names in zip(views, instants, (first, second), strict=True):
        assert view.instants == tuple(expected)
        name = view.flow_image(view.instants[-1])[1]
        assert str(names[-1]) in name
    lines = views[0].count.lines
    assert len(lines) == len(words)
    for line, text in zip(lines, words, strict=True):
        assert text in line
    everything = sorted({*views[0].instants} | {*views[1].instants})
    common = [i for i in everything if max(x.instants[0] for x in views) <= i <= min(x.instants[-1] for x in views)]
    numbers = frame_numbers("all", views)
    assert numbers == tuple(common)
    assert instants_of(numbers, views[0], 100.0) == pytest.approx([i / 100 for i in common])
    assert paired(views) == views


@pytest.mark.parametrize(("second", "remedy"), [(range(500, 503), "--frame-offset VIEW"), ("xyz", "number the files")])
def test_flow_images_that_nothing_pairs_are_refused(tmp_path, second, remedy):
    for name, numbers in (("a", range(2)), ("b", second)):
        for number in numbers:
            (tmp_path / name / "flow").mkdir(parents=True, exist_ok=True)
            tifffile.imwrite(tmp_path / name / "flow" / f"{number}.tif", BLANK)
    with pytest.raises(InputError, match=remedy):
        paired(find_views(tmp_path))
    stated = paired(find_views(tmp_path, frame_offsets={"b": 0 if second == "xyz" else 500}))
    assert [len(view.instants) for view in stated] == [2, 3]


def test_a_film_of_dropped_frames_has_the_images_of_each_instant(recording, tmp_path, lines):
    """Two cameras, of which one counts from 1, and dropped its third frame; both were stopped for two frames."""
    for k, name in enumerate(("0deg", "60deg")):
        path = tmp_path / name / "flow.tif"
        images = tifffile.imread(path)
        path.unlink()
        (tmp_path / name / "flow").mkdir()
        for number, image in zip((0, 1, 2, 5), (images[0], images[1], images[2], images[0]), strict=True):
            if (name, number) != ("60deg", 2):
                tifffile.imwrite(tmp_path / name / "flow" / f"f{number + k}.tif", image)
    dropping = replace(recording, views=find_views(tmp_path, ["0deg", "60deg"]), images=False)
    plain = [measure_instant(dropping, (i,))[0].displacement[-1].nan_to_num() for i in (0, 1)]
    numbers = frame_numbers("all", dropping.views)
    film = measure_recording(dropping, numbers, instants_of(numbers, dropping.views[0], 100.0), tmp_path / "f.zarr",
                             say=lines.append)  # fmt: skip
    assert film.times == (0.0, 0.01, 0.02, 0.05)
    assert film.frame(2).names == ("0deg",)
    assert torch.equal(film.frame(3).displacement[1].nan_to_num(), plain[0])
    assert not torch.equal(plain[0], plain[1])
    assert any("frame 2: left out: view '60deg': no flow image of instant 2" in line for line in lines)
    assert film.frame(0).frame_offsets == {"60deg": 1}
    lines.clear()
    mean, _ = measure_instant(dropping, range(1, 4), lines.append)
    assert mean.names == ("0deg", "60deg")
    assert sum("no flow image of instant" in line for line in lines) == 3


def test_frames_missing_in_the_times_of_a_film_are_gaps(tmp_path):
    for name, dropped in (("a", 3), ("b", 5)):
        (tmp_path / name).mkdir()
        with h5py.File(tmp_path / name / "flow.h5", "w") as file:
            remaining = np.delete(np.arange(8), dropped)
            file["images"] = np.broadcast_to(remaining[:, None, None], (7, *BLANK.shape)).astype(np.uint8)
            file["times"] = 12.5 + 0.002 * remaining + 1e-5 * np.sin(remaining)
    views = paired(find_views(tmp_path))
    assert [int(view.flow_image(6)[0][0, 0]) for view in views] == [6, 6]
    numbers = frame_numbers("all", views)
    assert instants_of(numbers, views[0], 0.0) == pytest.approx([12.5 + 0.002 * k for k in range(8)], abs=2e-5)


OTHER = {
    "background": Plane(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), -400.0),
    "translation": torch.tensor([0.0, 0.001, 900.0], dtype=torch.float64),
    "distortion": torch.tensor([1e-6, 0, 0, 0, 0], dtype=torch.float64),
    "tilt": torch.tensor([1e-6, 0], dtype=torch.float64),
    "lens": Lens(3.0),
    "pose_sigma": torch.ones(6, dtype=torch.float64),
}


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A recording of one view, and its sequence."""
    folder = tmp_path_factory.mktemp("film")
    whole = write_experiment(folder, frames=1)
    recording = replace(whole, views=whole.views[:1])
    measure_recording(recording, range(1), [0.0], folder / "film.zarr")
    return recording, folder / "film.zarr"


@pytest.mark.parametrize("what", [*OTHER, "views"])
def test_a_sequence_is_not_continued_with_other_cameras(begun, what):
    recording, out = begun
    view, words = recording.views[0], what
    if what == "views":
        other = replace(recording, views=(replace(view, name="60deg"),))
    else:
        camera, words = replace(recording.cameras[view.name], **{what: OTHER[what]}), f"{what} of view '{view.name}'"
        other = replace(recording, cameras={**recording.cameras, view.name: camera})
    with pytest.raises(InputError, match=rf"other {words}.*--out, or --force") as error:
        measure_recording(other, range(1), [0.0], out)
    assert error.value.field == str(out)


def test_a_sequence_is_continued_in_spite_of_rounding_errors(begun, lines):
    recording, out = begun
    near = {
        name: replace(camera, rotation=camera.rotation + 1e-13, lens=Lens(0.0, 900.0))
        for name, camera in recording.cameras.items()
    }
    measure_recording(replace(recording, cameras=near), range(1), [0.0], out, say=lines.append)
    assert any("1 of 1 frames exist already" in line for line in lines)


@pytest.mark.parametrize(
    ("crop", "shape"), [(Crop(column=10), (60, 62)), (Crop(flip="vertical"), SHAPE), (Crop(rotate=180), SHAPE)]
)
def test_a_crop_needs_the_image_size_of_the_calibration(tmp_path, crop, shape):
    (whole,) = Ring(views=1, arc=(0.0, 120.0), image_size=SHAPE, pixel_pitch=0.06).cameras()
    tifffile.imwrite(tmp_path / "flow.tif", np.zeros(SHAPE, np.uint16))
    view = View("left", tmp_path, {"flow": "flow.tif"}, crop)
    unsized = replace(CalibratedCamera.from_camera(whole), image_size=None)
    with refused("view 'left'"):
        camera_of(view, unsized, shape)
    assert camera_of(view, replace(unsized, image_size=shape), shape).image_size == shape
    assert camera_of(replace(view, crop=Crop()), unsized, SHAPE).image_size == SHAPE


def test_exchanged_rows_and_columns_are_recognised_by_the_calibration(tmp_path):
    (whole,) = Ring(views=1, arc=(0.0, 120.0), image_size=SHAPE, pixel_pitch=0.06).cameras()
    tifffile.imwrite(tmp_path / "flow.tif", np.zeros(SHAPE[::-1], np.uint16))
    view, calibrated = View("left", tmp_path, {"flow": "flow.tif"}), CalibratedCamera.from_camera(whole)
    with pytest.raises(InputError, match='rotate = 90, flip = "vertical"'):
        camera_of(view, calibrated, SHAPE[::-1])
    assert camera_of(replace(view, crop=Crop(rotate=90, flip="vertical")), calibrated, SHAPE).image_size == SHAPE


@pytest.mark.slow
def test_several_processes_give_the_results_of_one(recording, tmp_path):
    recording = replace(recording, images=False)  # whose pixels that are not valid are NaN
    single, _ = measure_instant(recording, processes=1)
    several, _ = measure_instant(recording, processes=2)
    assert torch.equal(several.displacement.nan_to_num(), single.displacement.nan_to_num())
    film = measure_recording(recording, range(3), [0.0, 1.0, 2.0], tmp_path / "film.zarr", processes=2)
    single, _ = measure_instant(replace(recording, images=False), processes=1)
    assert torch.equal(film.frame(0).displacement.nan_to_num(), single.displacement.nan_to_num())
    assert all(film.is_written(i) for i in range(3))


def test_processes_start_without_a_fork_server(monkeypatch):
    assert workers.start_method() in multiprocessing.get_all_start_methods()
    monkeypatch.setattr(workers, "get_all_start_methods", lambda: ["spawn"])  # as on Windows
    assert workers.start_method() == "spawn"


def end_process(common, task):
    os._exit(9)


def test_a_killed_process_is_refused():
    with refused("processes"):
        list(workers.work(end_process, None, [1, 2], 2))


@pytest.mark.slow
def test_spawned_processes_give_the_results_of_one(recording, monkeypatch):
    monkeypatch.setattr(workers, "get_all_start_methods", lambda: ["spawn"])
    one, two = (measure_instant(recording, processes=n)[0].displacement.nan_to_num() for n in (1, 2))
    assert torch.equal(one, two)


def test_averaging_lowers_sigma(recording):
    one, three = (measure_instant(recording, numbers)[0] for numbers in ((0,), (0, 1, 2)))
    assert float(three.sigma.median()) < 0.9 * float(one.sigma.median())


@pytest.mark.parametrize(("shift", "film"), [(4, False), (0, True)])
def test_saturated_pixels_are_not_valid_and_inside_the_flow_mask(tmp_path, shift, film):
    recording = replace(write_experiment(tmp_path, 1, shift, spot=True), masks=MaskSettings(smallest=16))
    if film:
        measurement = measure_recording(recording, range(1), [0.0], tmp_path / "film.zarr").frame(0)
    else:
        measurement, _ = measure_instant(recording)
    usable, mask = measurement.usable, measurement.flow_mask
    assert not usable[:, 10:20, 50:62].any()
    assert float(usable[:, 25:, 5:65].float().mean()) > 0.95
    assert bool(mask[~usable].all())
    assert float(mask[usable].float().mean()) < 0.4
    assert bool(mask[:, 25:35, 31:41].all())


def test_files_are_opened_once_and_each_page_read_once(tmp_path, monkeypatch):
    pages = 120
    recording = write_experiment(tmp_path, frames=pages)
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
    view = replace(recording.views[0])  # not opened yet
    for number in range(pages):
        frames = view.open("flow")
        view.cropped(frames[number], frames.name(number))
    assert set(opens.values()) == {1}
    assert sum(reads.values()) <= pages + 5 + 3  # five determine the layout, and three that of the reference
    reference = ViewReference.of(recording, view)
    opens.clear()
    for number in range(2):
        reference.measure([number])
    assert not opens
