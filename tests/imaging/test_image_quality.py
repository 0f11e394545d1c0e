"""What is said of a view's images, and what of a crop gets into views.toml."""

from __future__ import annotations

import base64
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from nerif.imaging.image_quality import image_quality, jpeg_address, shrink
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import BEFORE, find_views, write_crops
from refusals import refused


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two views of 40 x 56 px: four references of which one is broken, a flow image with a saturated corner."""
    rng = np.random.default_rng(1)
    for view in ("cam1", "cam2"):
        for source, count in (("reference", 4), ("flow", 1)):
            (tmp_path / view / source).mkdir(parents=True)
            for i in range(count):
                image = rng.integers(20, 200, (40, 56), dtype=np.uint8)
                if source == "flow":
                    image[:10, :14] = 255
                iio.imwrite(tmp_path / view / source / f"p{i}.png", image)
    (tmp_path / "cam1" / "reference" / "p2.png").write_bytes(b"no image")
    return tmp_path


def test_bad_images_are_named_with_the_reason(folder):
    look = image_quality(find_views(folder)[0], "reference")
    assert (look.count, look.sampled, look.shape, look.first) == (4, 4, (40, 56), 0)
    ((name, why),) = look.bad
    assert name == "cam1/reference/p2.png"
    assert "cannot be read" in why
    assert look.histogram.sum() == pytest.approx(1)
    assert look.full == 255


def test_what_is_saturated_is_told(folder):
    look = image_quality(find_views(folder)[1], "flow")
    assert look.saturated == pytest.approx(10 * 14 / (40 * 56))
    assert "over-exposed" in look.notes[0]


def test_a_source_without_a_good_image_is_refused(folder):
    (folder / "cam1" / "flow" / "p0.png").write_bytes(b"")
    with refused("view 'cam1'"):
        image_quality(find_views(folder)[0], "flow")
    with refused("view 'cam1'"):
        image_quality(find_views(folder)[0], "target")


def test_images_are_reduced_and_never_enlarged():
    image = np.arange(80 * 120, dtype=np.uint16).reshape(80, 120)
    assert shrink(image, 30).shape == (20, 30)
    assert shrink(image, 300) is image
    kind, _, coded = jpeg_address(image, 60).partition(";base64,")
    assert kind == "data:image/jpeg"
    assert iio.imread(base64.b64decode(coded)).shape == (40, 60)


def test_crops_are_written_for_folders_and_read_again(folder):
    crop = Crop(row=4, column=6, height=20, width=30, flip="horizontal", rotate=90)
    write_crops(folder, {"cam2": crop})
    first, second = find_views(folder)
    assert (first.crop, second.crop) == (None, crop)
    assert second.cropped(second.open("reference")[0], "p").shape == (30, 20)
    write_crops(folder, {"cam2": Crop()})
    assert find_views(folder)[1].crop is None


def test_a_file_that_somebody_wrote_keeps_its_shared_lines_and_its_first_text(folder):
    lines = ["# ours", 'flip = "vertical"', "[views.a]", 'reference = "cam1/reference"', "row = 2", "[views.b]"]
    text = "\n".join([*lines, 'flow = "cam2/flow"', ""])
    (folder / "views.toml").write_text(text)
    write_crops(folder, {"a": Crop(column=3)})
    a, b = find_views(folder)
    assert a.crop == Crop(column=3)  # the shared flip does not hold for it any more
    assert b.crop == Crop(flip="vertical")
    assert (folder / BEFORE).read_text() == text
    with refused("crops"):
        write_crops(folder, {"c": Crop()})
