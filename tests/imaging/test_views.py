"""The images of an experiment: where they are, their quality and crops; one bad image does not cost the others."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import tifffile

from nerif.common.conventions import InputError
from nerif.imaging.calibration.target_images import find_targets, pose_names
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.quality.image_quality import image_quality, jpeg_address, shrink
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.image_files import Tiff
from nerif.imaging.readers.open import open_frames
from nerif.imaging.readers.views import BEFORE, find_views, good_images, write_crops
from refusals import refused

SHAPE = (20, 30)


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, image)


def test_the_folders_that_are_expected_are_named_by_a_path_that_works(tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path / "run")
    for folder in (Path(), Path("../run"), tmp_path / "run"):
        expected = f"expected folders such as {folder / 'cam1' / 'reference'} and"
        with pytest.raises(InputError, match=re.escape(expected)):
            find_views(folder)


@pytest.fixture
def folder(tmp_path):
    """Two views with three references and a flow image of 8 bit, whose corner is saturated."""
    rng = np.random.default_rng(0)
    for view in ("cam10", "cam2"):
        for i in range(3):
            save(tmp_path / view / "reference" / f"r{i}.tif", rng.integers(20, 200, SHAPE).astype(np.uint8))
        flow = rng.integers(20, 200, SHAPE).astype(np.uint8)
        flow[:5, :10] = 255
        save(tmp_path / view / "flow.tif", flow)
    (tmp_path / "notes").mkdir()
    return tmp_path


def test_folders_are_views_in_natural_order(folder):
    views = find_views(folder)
    assert [v.name for v in views] == ["cam2", "cam10"]
    assert set(views[0].sources) == {"reference", "flow"}
    assert len(views[0].open("reference")) == 3
    assert [v.name for v in find_views(folder, ["cam10"])] == ["cam10"]
    with refused("view 'cam2'"):
        views[0].open("target")
    (folder / "cam2" / "target.seq").touch()  # not read, but named
    with pytest.raises(InputError, match="of Norpix StreamPix: export it"):
        find_views(folder)[0].open("target")
    with refused("views"):
        find_views(folder, ["cam3"])
    for empty in ("nowhere", "notes"):
        with refused(folder / empty):
            find_views(folder / empty)


def test_crops_of_a_shared_sensor(folder, lines):
    whole = np.arange(40 * 60, dtype=np.uint16).reshape(40, 60)
    save(folder / "shared.tif", whole)
    (folder / "views.toml").write_text(
        'reference = "shared.tif"\nflow = "shared.tif"\nrow = 5\nheight = 20\nwidth = 25\n'
        '[views.left]\ncolumn = 2\n[views.right]\ncolumn = 30\nflip = "horizontal"\n'
    )
    left, right = find_views(folder)
    assert np.array_equal(good_images(left, "flow", lines.append)[0], whole[5:25, 2:27])
    assert np.array_equal(good_images(right, "flow", lines.append)[0], whole[5:25, 30:55][:, ::-1])


@pytest.mark.parametrize(
    "text",
    [
        "[views.a]\nrefrence = 'x'\n", "[views.a]\nrow = 'x'\n", "[views.a]\nframe_offset = 1.5\n", "views = 3\n",
        "[views.a\n", "reference = 'x'\n",
    ],
)  # fmt: skip
def test_invalid_views_file(folder, text):
    (folder / "views.toml").write_text(text)
    with refused(folder if text.startswith("reference") else folder / "views.toml"):
        find_views(folder)


def test_frame_offsets_of_the_file_are_read_and_overridden(folder):
    (folder / "views.toml").write_text(
        'flow = "cam2/flow"\nreference = "cam2/reference"\n[views.a]\nframe_offset = -2\n[views.b]\n'
    )
    assert [view.frame_offset for view in find_views(folder)] == [-2, None]
    assert [view.frame_offset for view in find_views(folder, frame_offsets={"b": 3})] == [-2, 3]
    assert [view.frame_offset for view in find_views(folder, frame_offsets={"a": 0})] == [0, None]
    write_crops(folder, {"a": Crop(row=1)})
    assert find_views(folder)[0].frame_offset == -2


def test_crops_are_written_for_folders_and_read_again(folder):
    crop = Crop(row=4, column=6, height=12, width=20, flip="horizontal", rotate=90)
    write_crops(folder, {"cam10": crop})
    first, second = find_views(folder)
    assert (first.crop, second.crop) == (None, crop)
    assert second.cropped(second.open("reference")[0], "p").shape == (20, 12)
    write_crops(folder, {"cam10": Crop()})
    assert find_views(folder)[1].crop is None


def test_crops_in_an_existing_file_keep_its_shared_entries_and_a_copy(folder):
    lines = ["# ours", 'flip = "vertical"', "[views.a]", 'reference = "cam10/reference"', "row = 2", "[views.b]"]
    text = "\n".join([*lines, 'flow = "cam2/flow"', ""])
    (folder / "views.toml").write_text(text)
    write_crops(folder, {"a": Crop(column=3)})
    a, b = find_views(folder)
    assert a.crop == Crop(column=3)  # overrides the shared flip
    assert b.crop == Crop(flip="vertical")
    assert (folder / BEFORE).read_text() == text
    with refused("crops"):
        write_crops(folder, {"c": Crop()})


def test_bad_images_are_reported_and_the_others_used(folder, lines):
    bad = folder / "cam2" / "reference" / "r1.tif"
    bad.write_bytes(b"II*\x00 broken")
    view = find_views(folder)[0]
    assert len(good_images(view, "reference", lines.append)) == 2
    assert any(line.startswith("left out:") and "r1.tif" in line for line in lines)
    quality = image_quality(view, "reference")
    assert (quality.count, quality.sampled, quality.shape, quality.first, quality.full) == (3, 3, SHAPE, 0, 255)
    ((name, why),) = quality.bad
    assert name == "cam2/reference/r1.tif"
    assert "cannot be read" in why
    assert quality.histogram.sum() == pytest.approx(1)
    for i in (0, 2):
        bad.with_name(f"r{i}.tif").write_bytes(b"")
    view = find_views(folder)[0]
    for evaluate in (lambda: good_images(view, "reference", lines.append), lambda: image_quality(view, "reference")):
        with refused("view 'cam2'"):
            evaluate()
    with refused("view 'cam2'"):
        image_quality(view, "target")


def test_over_exposed_images_are_reported(folder, lines):
    view = find_views(folder)[0]
    quality = image_quality(view, "flow")
    good_images(view, "flow", lines.append)
    assert quality.saturated == pytest.approx(5 * 10 / (20 * 30))
    for line in (quality.notes[0], lines[0]):
        assert "flow.tif" in line
        assert "over-exposed" in line


def test_notes_about_files_are_reported_once_per_source(folder, lines, monkeypatch):
    monkeypatch.setattr(Tiff, "notes", ("a time stamp in its first pixels",))
    view = find_views(folder)[0]
    good_images(view, "reference", lines.append)
    assert lines == ["note: cam2/reference/r0.tif: a time stamp in its first pixels"]
    assert lines[0] == f"note: {image_quality(view, 'reference').notes[0]}"
    assert len(open_frames(f"{folder}/cam2/reference[1:]").notes) == 1


def test_samples_of_many_images_are_evenly_spread(folder, lines):
    for i in range(3, 20):
        save(folder / "cam2" / "reference" / f"r{i}.tif", np.full(SHAPE, 10 * i, np.uint8) + np.eye(*SHAPE, dtype="u1"))
    images = good_images(find_views(folder)[0], "reference", lines.append, most=4)
    assert len(images) == 4
    assert images[-1].max() == 191


def test_images_are_shrunk_and_never_enlarged():
    image = np.arange(80 * 120, dtype=np.uint16).reshape(80, 120)
    assert shrink(image, 30).shape == (20, 30)
    assert shrink(image, 300) is image
    kind, _, data = jpeg_address(image, 60).partition(";base64,")
    assert kind == "data:image/jpeg"
    assert iio.imread(base64.b64decode(data)).shape == (40, 60)


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (["pose_007.tif", "pose_012.tif"], ["7", "12"]), (["stack8.tif"], ["0", "1"]), (["a.tif", "b.tif"], ["0", "1"]),
        (["a1.tif", "b1.tif"], ["0", "1"]), (["pose_-1.tif", "pose_1.tif"], ["-1", "1"]),
    ],
)  # fmt: skip
def test_poses_are_named_by_numbers_in_names(tmp_path, files, expected):
    for file in files:
        tifffile.imwrite(tmp_path / file, np.ones((3 - len(files), *SHAPE), np.uint8), photometric="minisblack")
    assert pose_names(open_frames(tmp_path)) == expected


def test_images_without_a_target_are_reported(folder, lines):
    rng = np.random.default_rng(1)
    target = CalibrationTarget("charuco", 8, 6, 5.0)
    board = (4000 * np.pad(target.raster(0.25), 20, constant_values=0.5)).astype(np.uint16)
    for i in range(3):
        image = rng.integers(0, 4000, board.shape).astype(np.uint16) if i else board
        save(folder / "cam2" / "target" / f"t{i}.tif", image)
    calls: list[int] = []
    images = find_targets(find_views(folder)[0], target, lines.append, lambda: calls.append(1))
    assert (list(images.poses), images.size, len(calls)) == (["0"], board.shape, 3)
    assert [f"t{i}.tif: no charuco of 8 x 6 found" in line for i, line in enumerate(lines, 1)] == [True, True]


def test_capital_letters_of_folders_endings_and_the_list_of_views(folder):
    (folder / "cam2" / "reference").rename(folder / "cam2" / "REFERENCE")
    (folder / "cam2" / "flow.tif").rename(folder / "cam2" / "Flow.TIF")
    (folder / "cam2" / "flow.txt").write_text("notes")
    view = find_views(folder)[0]
    assert (len(view.open("reference")), len(view.open("flow"))) == (3, 1)
    (folder / "cam2" / "REFERENCE" / "r1.tif").rename(folder / "cam2" / "REFERENCE" / "r1.TIF")
    assert len(open_frames("cam2/REFERENCE/r*.tif", folder)) == 3
    (folder / "Views.TOML").write_text('[views.a]\nreference = "cam10/reference"\n')
    assert [v.name for v in find_views(folder)] == ["a"]
    write_crops(folder, {"a": Crop(row=1)})
    assert find_views(folder)[0].crop == Crop(row=1)
    assert not (folder / "views.toml").exists()


@pytest.mark.parametrize("second", ["cam2/Flow.png", "cam2/flow/f.tif", "cam2/FLOW.TIF", "CAM2/flow.tif"])
def test_two_entries_that_differ_in_case_or_ending_are_refused(folder, second):
    save(folder / second, np.zeros(SHAPE, np.uint8))
    with refused(folder) as error:
        find_views(folder)
    assert "got both" in str(error.value)


def test_paths_of_windows_in_views_toml(folder):
    (folder / "views.toml").write_text("[views.a]\nreference = 'cam2\\reference\\*.tif'\nflow = 'cam2\\flow.tif[:1]'\n")
    (view,) = find_views(folder)
    assert (len(view.open("reference")), len(view.open("flow"))) == (3, 1)
    for path in ("'C:\\data\\flow'", '"cam2\\flow.tif"'):  # the second one has a form feed
        (folder / "views.toml").write_text(f"[views.a]\nflow = {path}\n")
        with refused(f"{folder / 'views.toml'}: flow of view 'a'"):
            find_views(folder)
