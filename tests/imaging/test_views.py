"""Where the images of an experiment are found, and that one bad image does not cost the others."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from nerif.common.conventions import InputError
from nerif.imaging.calibration.target_images import find_targets
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.readers.views import find_views, good_images
from refusals import refused


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, image)


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(0)
    for view in ("cam10", "cam2"):
        for i in range(3):
            save(tmp_path / view / "reference" / f"r{i}.tif", rng.integers(0, 4000, (20, 30)).astype(np.uint16))
        save(tmp_path / view / "flow.tif", rng.integers(0, 4000, (20, 30)).astype(np.uint16))
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


def test_a_file_tells_crops_of_a_shared_sensor(folder):
    save(folder / "shared.tif", np.arange(40 * 60, dtype=np.uint16).reshape(40, 60))
    (folder / "views.toml").write_text(
        'reference = "shared.tif"\nflow = "shared.tif"\n'
        "[views.left]\nrow = 5\ncolumn = 2\nheight = 20\nwidth = 25\n"
        '[views.right]\nrow = 5\ncolumn = 30\nheight = 20\nwidth = 25\nflip = "horizontal"\n'
    )
    left, right = find_views(folder)
    whole = np.arange(40 * 60, dtype=np.uint16).reshape(40, 60)
    said: list[str] = []
    assert np.array_equal(good_images(left, "flow", said.append)[0], whole[5:25, 2:27])
    assert np.array_equal(good_images(right, "flow", said.append)[0], whole[5:25, 30:55][:, ::-1])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[views.a]\nrefrence = 'x'\n", "unknown key 'refrence'; the nearest known one is 'reference'"),
        ("[views.a]\nrow = 'x'\n", "'row' of view 'a': expected int, got 'x'"),
        ("views = 3\n", r"expected a table \[views.NAME\]"),
        ("[views.a\n", "not a TOML file"),
        ("reference = 'x'\n", "no view found"),
    ],
)
def test_a_file_that_cannot_be_right(folder, text, words):
    (folder / "views.toml").write_text(text)
    with pytest.raises(InputError, match=words):
        find_views(folder)


def test_no_folder_no_view_no_such_view(tmp_path, folder):
    with pytest.raises(InputError, match="no such folder"):
        find_views(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no view found"):
        find_views(folder / "notes")
    with refused("views"):
        find_views(folder, ["cam3"])


def test_good_images_are_kept_and_bad_ones_named(folder):
    (folder / "cam2" / "reference" / "r1.tif").write_bytes(b"II*\x00 broken")
    said: list[str] = []
    images = good_images(find_views(folder)[0], "reference", said.append)
    assert len(images) == 2
    assert any(line.startswith("left out:") and "r1.tif" in line for line in said)
    for i in (0, 2):
        (folder / "cam2" / "reference" / f"r{i}.tif").write_bytes(b"")
    with refused("view 'cam2'"):
        good_images(find_views(folder)[0], "reference", said.append)


def test_over_exposed_images_are_told(folder):
    save(folder / "cam2" / "flow.tif", np.full((20, 30), 65535, np.uint16))
    said: list[str] = []
    good_images(find_views(folder)[0], "flow", said.append)
    assert any("flow.tif" in line and "over-exposed" in line for line in said)


def test_many_images_are_thinned_evenly(folder):
    for i in range(3, 20):
        save(
            folder / "cam2" / "reference" / f"r{i}.tif",
            np.full((20, 30), 100 * i, np.uint16) + np.eye(20, 30, dtype=np.uint16),
        )
    images = good_images(find_views(folder)[0], "reference", lambda line: None, most=4)
    assert len(images) == 4
    assert images[-1].max() == 1901


def test_pose_numbers_come_from_names():
    assert _pose_keys(["cam2/pose_007.png", "cam2/pose_012.png"]) == ["7", "12"]
    assert _pose_keys(["rec.cihx frame 0", "rec.cihx frame 1"]) == ["0", "1"]
    assert _pose_keys(["a.tif", "b.tif"]) == ["0", "1"]
    assert _pose_keys(["a1.tif", "b1.tif"]) == ["0", "1"]


def test_images_without_a_target_are_named(folder):
    rng = np.random.default_rng(1)
    for i in range(2):
        save(folder / "cam2" / "target" / f"t{i}.tif", rng.integers(0, 4000, (120, 160)).astype(np.uint16))
    said: list[str] = []
    seen: list[int] = []
    target = CalibrationTarget("charuco", 8, 6, 5.0)
    found = find_targets(find_views(folder)[0], target, said.append, lambda: seen.append(1))
    assert not found.poses
    assert found.size == (120, 160)
    assert len(seen) == 2
    assert sum("no charuco of 8 x 6 found" in line for line in said) == 2
