"""Views whose flow images do not show the scene of their references, or have few valid pixels: the cause is named."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
import tifffile
from scipy.ndimage import map_coordinates

import imaging_files
from nerif.data.cameras_file import CalibratedCamera
from nerif.geometry import Box, Ring
from nerif.imaging.imaging_settings import DisplacementSettings
from nerif.imaging.readers.views import find_views
from nerif.imaging.recording import Recording, Scene, ViewReference, measure_instant
from nerif.imaging.recording_sequence import measure_recording

SHAPE = (110, 130)
CAMERAS = Ring(views=3, arc=(0.0, 120.0), image_size=SHAPE, pixel_pitch=0.06).cameras()
NAMES = [camera.name for camera in CAMERAS]
BOX = Box((-25.0, -25.0, -25.0), (25.0, 25.0, 25.0))


dots = partial(imaging_files.dots, shape=SHAPE)


def recording(folder, scenes: dict[str, list[np.ndarray]]) -> Recording:
    """Three views of a 12-bit camera; `scenes` replaces images of "VIEW/SOURCE"."""
    rng = np.random.default_rng(0)
    for i, name in enumerate(NAMES):
        for source in ("reference", "flow"):
            images = scenes.get(f"{name}/{source}", [dots(i)] * 2)
            grey = [150 + 2500 * image + 15 * rng.standard_normal(SHAPE) for image in images]
            (folder / name).mkdir(exist_ok=True)
            stack = np.clip(grey, 0, 4095).astype(np.uint16)
            tifffile.imwrite(folder / name / f"{source}.tif", stack, photometric="minisblack")
    calibrated = {c.name: CalibratedCamera.from_camera(c) for c in CAMERAS}
    return Recording(find_views(folder), calibrated, Scene(BOX), DisplacementSettings("dis"))


A, B, C = NAMES
OTHERS = {
    "exchanged flow images": (
        {f"{A}/flow": [dots(1)] * 2, f"{B}/flow": [dots(0)] * 2},
        f"references of view '{A}', but with those of view '{B}'; exchanged?",
    ),
    "a flow image of another scene": ({f"{A}/flow": [dots(7), dots(0)]}, "but other flow images do; another scene"),
    "references of another run": ({f"{A}/reference": [dots(7)] * 2}, "are the references of another run or camera"),
    "references of another view, whose own are lost": (
        {f"{A}/reference": [dots(1)] * 2, f"{B}/reference": [dots(8)] * 2},
        f"these match the flow images of view '{B}'; references exchanged?",
    ),
}


@pytest.mark.parametrize("case", OTHERS)
def test_a_view_of_unrelated_images_is_left_out_with_the_cause(tmp_path, case, lines):
    scenes, cause = OTHERS[case]
    measurement, _ = measure_instant(recording(tmp_path, scenes), say=lines.append)
    assert A not in measurement.names
    (line,) = (line for line in lines if line.startswith(f"view '{A}' left out"))
    assert f"{A}/flow.tif" in line
    assert cause in line


def test_the_bad_one_of_several_averaged_images_is_left_out(tmp_path, lines):
    recorded = recording(tmp_path, {f"{A}/flow": [dots(0), dots(7)]})
    reference = ViewReference.of(recorded, recorded.views[0])
    both, one = (reference.measure(numbers, lines.append)[1] for numbers in ([0, 1], [0]))
    (line,) = (line for line in lines if line.startswith("left out"))
    assert line.startswith(f"left out: {A}/flow.tif frame 1: does not correlate")
    assert np.array_equal(both.displacement, one.displacement)


def test_few_valid_pixels_are_reported_with_their_causes(tmp_path):
    hidden, lit = np.copy(dots(0)), np.copy(dots(1))
    hidden[:, :90] = 0.4
    lit[:70] = 2
    recorded, lines = recording(tmp_path, {f"{A}/flow": [hidden] * 2, f"{B}/flow": [lit] * 2}), []
    measurement, _ = measure_instant(recorded, say=lines.append)
    assert measurement.names == tuple(NAMES)
    first, second = (line for line in lines if "of its pixels are valid" in line)
    assert first.startswith(f"note: view '{A}': ")
    assert "uncorrelated" in first.split(";")[1].split(",")[0]
    assert second.startswith(f"note: view '{B}': ")
    assert "over-exposed" in second.split(";")[1].split(",")[0]
    film: list[str] = []
    measure_recording(recorded, range(2), [0.0, 1.0], tmp_path / "film.zarr", say=film.append)
    assert sum("of its pixels are valid" in line for line in film) == 2  # once per view, not per frame


def test_losses_are_shares_of_the_visible_background(tmp_path):
    hidden = np.copy(dots(0))
    hidden[:, :90] = 0.4
    recorded = recording(tmp_path, {f"{A}/flow": [hidden] * 2})
    tifffile.imwrite(
        tmp_path / A / "region.tif", np.where(np.arange(130) < 90, 0, 255).astype(np.uint8) * np.ones(SHAPE, np.uint8)
    )
    (view, *_) = find_views(tmp_path)
    result = ViewReference.of(recorded, view).measure([0]).result
    assert sum(result.losses.values()) == pytest.approx(1 - result.valid[:, 90:].mean())
    assert sum(result.losses.values()) < 0.6  # of all pixels more are lost


def test_a_background_that_repeats_is_reported_and_lines_are_refused(tmp_path):
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)

    def grid(shift: float) -> list[np.ndarray]:
        x, y = (0.5 + 0.5 * np.cos(2 * np.pi * v / 12) for v in (columns - shift, rows))
        return [x * y] * 2

    def lines(shift: float) -> list[np.ndarray]:
        return [0.5 + 0.5 * np.cos(2 * np.pi * (columns - shift) / 12)] * 2

    scenes = {f"{A}/reference": grid(0), f"{A}/flow": grid(5.5), f"{B}/reference": lines(0), f"{B}/flow": lines(1)}
    notes: list[str] = []
    measurement, _ = measure_instant(recording(tmp_path, scenes), say=notes.append)
    assert B not in measurement.names
    assert any(f"'{A}': its background repeats every 12.0 px along x and every 12.0 px along y" in n for n in notes)
    assert any(f"'{A}': displacements reach 5." in line and "from 6.0 px on, half the period" in line for line in notes)
    (left,) = (line for line in notes if f"view '{B}' left out" in line)
    assert "has lines along y, and no shift along them can be measured" in left


@pytest.mark.parametrize("width", [0, 20])
def test_a_camera_that_moved_is_reported_with_its_shift(tmp_path, width):
    scenes = {f"{A}/flow": [np.roll(dots(0), (9, -14), (0, 1))] * 2}
    recorded, lines = recording(tmp_path, scenes), []
    recorded = dataclasses.replace(recorded, method=DisplacementSettings("dis", shake_border=width))
    measurement, _ = measure_instant(recorded, say=lines.append)
    (line,) = (line for line in lines if "moved" in line)
    assert f"view '{A}': the whole image moved by about (-14, 9) px between reference and flow" in line
    assert ("--shake-border 20 removes it" if width else "give --shake-border N") in line
    expected = [0, 0] if width else [-14, 9]
    assert measurement.displacement[0][30:80, 30:100].mean(dim=(0, 1)).tolist() == pytest.approx(expected, abs=0.05)
    assert bool(measurement.valid[0][30:80, 30:100].all())


@pytest.mark.parametrize("source", ["rows", "a jet along the rows", "roll of the camera"])
def test_rows_that_moved_together_are_reported(tmp_path, source):
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    u = {
        "rows": 0.8 * np.sin(rows / 8),
        "a jet along the rows": 1.5 * np.exp(-(((rows - 50) / 9) ** 2)),
        "roll of the camera": 0.02 * (rows - 55),
    }[source]
    flow = map_coordinates(dots(0), [rows, columns - u], order=3, mode="nearest")
    recorded, lines = recording(tmp_path, {f"{A}/flow": [flow] * 2}), []
    ViewReference.of(recorded, recorded.views[0]).measure([0], lines.append)
    assert [line.split(",")[0] for line in lines] == (
        [f"note: view '{A}': its rows moved together"] if source == "rows" else []
    )
