"""References that differ from the others are left out by name; those that the camera's vibration shifts are not."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import tifffile
from scipy.ndimage import shift as moved

import imaging_files
from nerif.imaging.quality.image_quality import image_quality
from nerif.imaging.quality.reference_outliers import outliers, without_outliers
from nerif.imaging.quality.thumbnails import Thumbnail, match
from nerif.imaging.readers.views import View, good_images

SHAPE = (100, 130)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]]


dots = partial(imaging_files.dots, shape=SHAPE)
PATTERN = dots(0)
FLOW = moved(PATTERN, (0, 1.5)) * (COLUMNS < 50) + PATTERN * (COLUMNS >= 50)
HAND = np.where(ROWS < 40, 0.4, PATTERN)
BAD = {
    "shifted by (3.2, -0.4) px": moved(PATTERN, (-0.4, 3.2), mode="reflect"),
    "another scene": dots(1),
    "nearly black": 0 * PATTERN,
    "over-exposed": 3 * PATTERN,
    "displaced by": FLOW,
    "without correlation": HAND,
}


def shot(scene: np.ndarray, seed: int) -> np.ndarray:
    """Image of a 12-bit camera."""
    grey = 150 + 2500 * scene + 15 * np.random.default_rng(seed).standard_normal(SHAPE)
    return np.clip(grey, 0, 4095).astype(np.uint16)


def write(folder, references, flow=PATTERN) -> View:
    """A view with these scenes as references."""
    for source, scenes in (("reference", references), ("flow", [flow])):
        for i, scene in enumerate(scenes):
            (folder / "cam1" / source).mkdir(parents=True, exist_ok=True)
            tifffile.imwrite(folder / f"cam1/{source}/{source[:3]}_{i:03}.tif", shot(scene, i))
    return View("cam1", folder, {"reference": "cam1/reference", "flow": "cam1/flow"})


def check(view: View, lines: list[str]) -> list[str]:
    """Names of the references in use."""
    images = without_outliers(view, good_images(view, "reference", lambda line: None), lines.append)
    return [images.name(i).split("/")[-1] for i in range(len(images))]


@pytest.mark.parametrize(("reason", "count"), [*zip(BAD, [3, 6] * 3, strict=True)])
def test_one_bad_reference_is_left_out_by_name_with_the_reason(tmp_path, reason, count, lines):
    scenes = [PATTERN] * count
    scenes[1] = BAD[reason]
    assert len(check(write(tmp_path, scenes), lines)) == count - 1
    (line,) = lines
    assert line.startswith("left out: cam1/reference/ref_001.tif: ")
    assert reason in line
    quality = image_quality(write(tmp_path, scenes), "reference")
    assert [name for name, why in quality.bad if reason in why] == ["cam1/reference/ref_001.tif"]


def test_the_flow_image_decides_between_two_references(tmp_path, lines):
    for bad in (dots(1), moved(PATTERN, (0, 5), mode="reflect")):
        assert check(write(tmp_path, [bad, PATTERN]), lines) == ["ref_001.tif"]
    assert "does not correlate" in lines[0]
    assert "shifted by 5.0 px from the other reference and the flow images" in lines[1]


def test_the_quality_of_references_needs_no_flow_images(tmp_path):
    view = write(tmp_path, [dots(1), dots(2)])
    quality = image_quality(replace(view, sources={"reference": "cam1/reference"}), "reference")
    assert quality.bad == ()
    (note,) = quality.notes
    assert note.startswith("view 'cam1': the 2 references do not correlate")


def test_references_that_nothing_decides_between_are_named_and_used(tmp_path, lines):
    assert len(check(write(tmp_path, [dots(1), dots(2)], PATTERN), lines)) == 2
    assert len(check(write(tmp_path, [moved(PATTERN, (0, 5)), PATTERN], moved(PATTERN, (5, 9))), lines)) == 2
    assert lines[0].startswith("note: view 'cam1': the 2 references do not correlate with one another")
    assert "references are shifted by up to 5.0 px from one another" in lines[1]


@pytest.mark.parametrize("vibration", [0.1, 0.5])
def test_references_of_a_vibrating_camera_are_used(vibration):
    rng = np.random.default_rng(0)
    for count in (3, 4, 8):
        for _ in range(3):
            scenes = [moved(PATTERN, shift, mode="reflect") for shift in rng.normal(0, vibration, (count, 2))]
            images = [Thumbnail.of(shot(scene, i)) for i, scene in enumerate(scenes)]
            assert outliers(images, [0.0] * count, lambda: None).reasons == {}


def test_noise_that_hides_the_pattern_makes_no_outliers():
    images = [Thumbnail.of(np.random.default_rng(i).random(SHAPE)) for i in range(6)]
    result = outliers(images[:5], [0.0] * 5, lambda: images[5])
    assert result.reasons == {}
    assert "5 references do not correlate" in result.note


@pytest.mark.parametrize("size", [1, 4])
def test_match_measures_the_shift(size):
    large = np.kron(PATTERN, np.ones((size, size)))
    first, second = (Thumbnail.of(part) for part in (large[:, 4:], large[:, :-4]))
    correlation, shift = match(first, second)
    assert correlation > 0.8
    assert shift == pytest.approx([4, 0], abs=0.15 * size)
    assert match(first, Thumbnail.of(np.kron(dots(1), np.ones((size, size)))[:, 4:]))[0] < 0.3


def test_the_flow_image_is_read_only_where_references_contradict_one_another(tmp_path, lines):
    view = write(tmp_path, [PATTERN] * 3)
    view = replace(view, sources={**view.sources, "flow": "cam1/reference"})
    assert len(check(view, lines)) == 3
    assert not lines
