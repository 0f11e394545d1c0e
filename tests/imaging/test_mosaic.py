"""Raw Bayer mosaics: recognised in images of any format, not in grey images, and binned to those of a grey camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates, zoom

from calibration_images import camera_at_origin, imaged
from imaging_files import packed, write_cv, write_images, write_photron, write_tiff
from nerif.data.cameras_file import CalibratedCamera
from nerif.geometry import Ring
from nerif.imaging.calibration.simple_rig import find_image
from nerif.imaging.calibration.target_images import find_targets
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.displacement.displacement import Reference
from nerif.imaging.imaging_settings import DisplacementSettings
from nerif.imaging.quality.image_quality import image_quality
from nerif.imaging.readers.binning import Binning
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.exposure import saturated
from nerif.imaging.readers.mosaic import PATTERNS, bayer_pattern
from nerif.imaging.readers.open import open_frames, read_mask
from nerif.imaging.readers.views import View, find_views, good_images
from nerif.imaging.recording import camera_of
from refusals import refused

H, W = 128, 160
GAINS = {"R": 0.5, "G": 1.0, "B": 0.65}


def filters(pattern: str, shape: tuple[int, int], gains: dict[str, float] = GAINS) -> np.ndarray:
    """Transmission of the colour filter of each pixel."""
    cell = np.array([gains[colour] for colour in pattern]).reshape(2, 2)
    return np.tile(cell, (shape[0] // 2 + 1, shape[1] // 2 + 1))[: shape[0], : shape[1]]


def dots(rng: np.random.Generator, shape: tuple[int, int] = (H, W), size: float = 1.1) -> np.ndarray:
    """Light of dark paper with bright dots, 0 to 1."""
    x = gaussian_filter((rng.random(shape) < 0.06).astype(float), size)
    return 0.15 + 0.85 * np.clip(x / np.percentile(x, 99), 0, 1)


def exposed(light: np.ndarray, rng: np.random.Generator, bits: int = 12, exposure: float = 0.7) -> np.ndarray:
    """Grey values, with vignetting, shot noise of 8000 electrons and read noise."""
    rows, columns = (np.linspace(-1, 1, n) for n in light.shape)
    electrons = 8000 * exposure * light * (1 - 0.25 * np.add.outer(rows**2, columns**2))
    values = (rng.poisson(electrons) + rng.normal(0, 15, light.shape)) / 8000 * 2**bits + 0.02 * 2**bits
    return np.clip(np.rint(values), 0, 2**bits - 1).astype(np.uint8 if bits == 8 else np.uint16)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


SCENES = {
    "dots": dots,
    "paper": lambda rng, shape: np.full(shape, 0.6),
    "noise": lambda rng, shape: np.clip(0.5 + 0.6 * gaussian_filter(rng.standard_normal(shape), 1.5), 0, 1),
    "chessboard": lambda rng, shape: 0.1 + 0.8 * (np.add.outer(*(np.arange(n) // 23 for n in shape)) % 2),
}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("bits", [8, 12])
def test_a_mosaic_is_recognised(rng, scene, pattern, bits):
    shape = (H + 13, W + 6)
    image = exposed(SCENES[scene](rng, shape) * filters(pattern, shape), rng, bits)
    assert pattern in bayer_pattern(image).split(" or ")
    assert bayer_pattern(image[:60, :100]) == ""  # less than four tiles


@pytest.mark.parametrize(
    "gains", [{"R": 0.9, "G": 1, "B": 0.94}, {"R": 0.1, "G": 1, "B": 0.1}, {"R": 3, "G": 1, "B": 0.2}]
)
def test_a_mosaic_is_recognised_in_light_of_any_colour(rng, gains):
    light = dots(rng) / max(gains.values())
    assert bayer_pattern(exposed(light * filters("GBRG", (H, W), gains), rng))


def row_offset(image: np.ndarray) -> np.ndarray:
    return np.where(np.arange(len(image))[:, None] % 2, 0.9 * image, image)


def regular(pitch: int, share: float, shape: tuple[int, int] = (H, W)) -> np.ndarray:
    rows, columns = ((np.arange(n) % pitch) / pitch for n in shape)
    return 0.9 * (np.add.outer((rows - 0.5) ** 2, (columns - 0.5) ** 2) < (share / 2) ** 2)


GREY = {
    **SCENES,
    "two taps, rows": lambda rng, shape: row_offset(dots(rng, shape)),
    "two taps, columns": lambda rng, shape: row_offset(dots(rng, shape[::-1])).T,
    "squares of 2 px": lambda rng, shape: 0.1 + 0.8 * (np.add.outer(*(np.arange(n) // 2 for n in shape)) % 2),
    "squares of 3 px": lambda rng, shape: 0.1 + 0.8 * (np.add.outer(*(np.arange(n) // 3 for n in shape)) % 2),
    "dots every 6 px": lambda rng, shape: regular(6, 0.5, shape),
    "dots every 10 px": lambda rng, shape: 0.9 - regular(10, 0.5, shape),
    "gradient": lambda rng, shape: np.add.outer(*(np.arange(n) / n / 2 for n in shape)),
    "enlarged, nearest": lambda rng, shape: np.kron(dots(rng, (shape[0] // 2, shape[1] // 2)), np.ones((2, 2))),
    "enlarged, cubic": lambda rng, shape: np.clip(zoom(dots(rng, (shape[0] // 2, shape[1] // 2), 0.6), 2), 0, 1),
    "white noise": lambda rng, shape: rng.random(shape),
    "black": lambda rng, shape: np.zeros(shape),
}


@pytest.mark.parametrize("scene", GREY)
@pytest.mark.parametrize("bits", [8, 12])
def test_grey_images_are_no_mosaics(rng, scene, bits):
    light = GREY[scene](rng, (H, W))
    assert bayer_pattern(exposed(light, rng, bits)) == ""
    assert bayer_pattern(np.rint(light * (2**bits - 1)).astype(np.uint16)) == ""  # without noise


def write_raw(folder: Path, light: np.ndarray, pattern: str, rng: np.random.Generator, flow: np.ndarray | None = None):
    """A view cam1 with three reference images and a flow image of a 12-bit colour camera."""
    for source, image, count in (("reference", light, 3), ("flow", light if flow is None else flow, 1)):
        stack = np.stack([exposed(image * filters(pattern, image.shape), rng) for _ in range(count)])
        (folder / "cam1").mkdir(parents=True, exist_ok=True)
        write_tiff(folder / "cam1" / f"{source}.tif", stack, photometric="minisblack")
    return find_views(folder)[0]


@pytest.mark.parametrize(
    "name", ["raw.tif", "raw.png", "raw.bmp", "raw.npy", "raw.h5", "rec.mraw", "raw.tif[1:]", "folder"]
)
def test_every_format_is_binned_and_the_note_reported_once(tmp_path, rng, lines, name):
    deep = np.stack([exposed(dots(rng) * filters("GRBG", (H, W)), rng) for _ in range(3)])
    shallow = (deep >> 4).astype(np.uint8)
    stack = shallow if name.endswith(("png", "bmp")) else deep
    path = tmp_path / name.partition("[")[0]
    if name == "folder":
        write_images(path, stack)
    elif name == "rec.mraw":
        write_photron(tmp_path, packed(stack), 3, H, W)
    elif name == "raw.npy":
        np.save(path, stack)
    elif name == "raw.h5":
        with h5py.File(path, "w") as file:
            file["x"] = stack
    elif path.suffix == ".tif":
        write_tiff(path, stack, photometric="minisblack")
    else:
        write_cv(path, stack[0])
    images = good_images(View("cam1", tmp_path, {"reference": name}), "reference", lines.append)
    first = stack[1 if "[" in name else 0]
    assert lines == [
        f"note: {name}: raw Bayer mosaic (GRBG or GBRG), binned to {H // 2} x {W // 2} px; "
        'mosaic = "none" in views.toml keeps all pixels'
    ]
    assert images[0].shape == (H // 2, W // 2)
    assert images[0].dtype == stack.dtype
    assert float(images[0].mean()) == pytest.approx(float(first.mean()), rel=0.01)
    assert open_frames(tmp_path / name).shape == (H, W)  # masks, for example, are never binned


def test_uniform_light_becomes_a_uniform_image():
    binning = Binning((1000.0, 2000.0, 2000.0, 1300.0), 4095.0)
    image = np.tile(np.array([[1000, 2000], [2000, 1300]], np.uint16), (4, 5))[:7, :9]
    assert np.array_equal(binning(image), np.full((3, 4), 1575))
    assert np.array_equal(replace(binning, means=(0.0,) * 4)(image), np.full((3, 4), 1575))  # of black frames
    scaled = binning(image.astype(np.float32) * 0.5)
    assert scaled.dtype == np.float32
    np.testing.assert_allclose(scaled, 1575 / 2, rtol=1e-6)


def test_every_filter_has_the_same_weight_but_a_nearly_dark_one():
    means = np.array([500.0, 2000.0, 2000.0, 10.0])
    binning = Binning(tuple(means), np.inf)
    changes = [binning((means + 100 * np.eye(4)[k] * means / 1000).reshape(2, 2).astype(np.float32)) for k in range(4)]
    first, second, third, fourth = (
        float(x[0, 0]) - float(binning(means.reshape(2, 2).astype("f4"))[0, 0]) for x in changes
    )
    assert first == pytest.approx(second, rel=1e-4) == third
    assert 0 < fourth < 0.05 * first


@pytest.mark.parametrize("shift", [0, 4])
def test_a_cell_with_a_saturated_pixel_is_saturated(shift):
    full = float(4095 << shift)
    image = np.full((20, 30), 2000 << shift, np.uint16)
    image[::2, ::2] = 800 << shift
    image[4, 6] = image[11, 19] = 4095 << shift
    image[8:10, 20:22] = 4094 << shift
    grey = Binning((800.0, 2000.0, 2000.0, 2000.0), full)(image)
    assert np.argwhere(saturated(grey, full)).tolist() == [[2, 3], [5, 9]]
    plateau = np.random.default_rng(0).normal(2000, 60, (80, 80)).astype(np.uint16)
    plateau[20:40, 21:41] = 3800  # a sensor that saturates below the top of its range
    over = saturated(Binning((1.0,) * 4, full)(plateau), full)
    assert over[10:20, 10:21].all()
    assert over.sum() == 10 * 11


def test_reference_and_flow_have_the_same_bins(tmp_path, rng, lines):
    view = write_raw(tmp_path, dots(rng), "BGGR", rng, flow=0 * dots(rng))
    assert not open_frames(tmp_path / "cam1" / "flow.tif").layout.pattern  # black
    reference, flow = view.open("reference"), view.open("flow")
    assert reference.binning is flow.binning
    assert flow[0].shape == reference.shape == flow.shape == (H // 2, W // 2)
    view.check_alike()
    quality = image_quality(view, "reference")
    assert (quality.shape, quality.full) == ((H // 2, W // 2), 4095)
    assert any("RGGB or BGGR" in note for note in quality.notes)
    assert np.array_equal(replace(view).open("flow")[0], flow[0])


def test_the_pattern_in_the_metadata_or_of_views_toml(tmp_path, rng, monkeypatch, lines):
    write_raw(tmp_path, dots(rng), "RGGB", rng)
    grey = exposed(dots(rng), rng)
    write_tiff(tmp_path / "grey.tif", grey)
    raw = '[views.a]\nreference = "cam1/reference.tif"\nmosaic = "none"\n'
    text = raw + '[views.b]\nreference = "grey.tif"\nmosaic = "GRBG"\n'
    (tmp_path / "views.toml").write_text(text)
    a, b = find_views(tmp_path)
    assert a.open("reference").shape == (H, W)
    assert np.array_equal(a.open("reference")[1], open_frames(tmp_path / "cam1" / "reference.tif")[1])
    assert (b.open("reference").shape, b.notes("reference")) == (
        (H // 2, W // 2), ("grey.tif: raw Bayer mosaic (GRBG), binned to 64 x 80 px",)
    )  # fmt: skip
    (tmp_path / "views.toml").write_text(text.replace("GRBG", "RGB"))
    with refused(tmp_path / "views.toml"):
        find_views(tmp_path)
    plain = View("c", tmp_path, {"reference": "grey.tif"})
    assert plain.open("reference").binning is None
    monkeypatch.setattr("nerif.imaging.readers.image_files.FileFrames.cfa", "GBRG")
    good_images(replace(plain), "reference", lines.append)
    assert "(GBRG), binned to 64 x 80 px" in lines[0]


def test_crops_are_those_of_the_binned_image(tmp_path, rng):
    view = write_raw(tmp_path, dots(rng), "RGGB", rng)
    crop = replace(view, crop=Crop(row=4, column=10, height=40, width=50))
    images = [good_images(v, "flow", lambda line: None)[0] for v in (view, crop)]
    assert np.array_equal(images[1], images[0][4:44, 10:60])


def test_the_camera_of_full_images_fits_the_binned_ones(tmp_path, rng):
    view = write_raw(tmp_path, dots(rng), "RGGB", rng)
    (whole,) = Ring(views=1, arc=(0.0, 120.0), image_size=(H, W), pixel_pitch=0.06).cameras()
    whole = replace(whole, distortion=torch.tensor([-0.2, 0.1, 0.001, -0.002, 0], dtype=torch.float64))
    calibrated = CalibratedCamera.from_camera(whole)
    points = torch.tensor(rng.uniform(-8, 8, (50, 3)))
    binned = camera_of(view, calibrated, (H // 2, W // 2))
    assert binned.image_size == (H // 2, W // 2)
    expected = (whole.project(points) + 0.5) / 2 - 0.5
    torch.testing.assert_close(binned.project(points), expected)
    cropped = camera_of(replace(view, crop=Crop(row=4, column=10, height=40, width=50)), calibrated, (40, 50))
    torch.testing.assert_close(cropped.project(points), expected - torch.tensor([10.0, 4.0], dtype=torch.float64))
    # calibrated with images that were binned as well
    same = camera_of(view, replace(calibrated.binned()), (H // 2, W // 2))
    torch.testing.assert_close(same.project(points), expected)
    with refused("view 'cam1'") as error:
        camera_of(view, replace(calibrated, image_size=None), (H // 2, W // 2))
    assert "--image-size" in str(error.value)
    with refused("view 'cam1'") as error:
        camera_of(replace(view, mosaic="none"), calibrated.binned(), (H, W))
    assert "mosaic" in str(error.value)


def test_targets_in_raw_images_are_detected_where_they_are(tmp_path, rng, lines):
    target, camera = CalibrationTarget("chessboard", 8, 7, pitch=7.0), camera_at_origin()
    image, truth = imaged(target, camera, (15, -10, 5), filters=filters("RGGB", (240, 320)))
    (tmp_path / "cam1" / "target").mkdir(parents=True)
    write_tiff(tmp_path / "cam1" / "target" / "pose_0.tif", image)
    images = find_targets(find_views(tmp_path)[0], target, lines.append)
    assert images.size == (120, 160)
    assert "note: cam1/target: raw Bayer mosaic (RGGB or BGGR), binned to 120 x 160 px" in lines[0]
    error = images.poses["0"].pixels - ((truth[images.poses["0"].ids] + 0.5) / 2 - 0.5)
    assert len(error) > 0.8 * len(truth)
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.02  # the centre of the cells, whatever the colours


def test_masks_drawn_on_the_full_image(tmp_path, rng, lines):
    view = write_raw(tmp_path, dots(rng), "RGGB", rng)
    mask = np.zeros((H, W), np.uint8)
    mask[21:60, 30:101] = 255  # its upper and right edge cut through cells
    write_cv(tmp_path / "cam1" / "mask.png", mask)
    view = find_views(tmp_path)[0]
    half = view.mask("mask", (H // 2, W // 2), lines.append)
    expected = np.zeros((H // 2, W // 2), bool)
    expected[11:30, 15:50] = True
    assert np.array_equal(half, expected)
    assert "mask.png: drawn at twice the size" in lines[0]
    with refused(tmp_path / "cam1" / "mask.png"):
        replace(view, mosaic="none").mask("mask", (H // 2, W // 2), lines.append)
    with refused(tmp_path / "cam1" / "mask.png"):
        read_mask(tmp_path / "cam1" / "mask.png", (H // 2, W // 2))


def test_a_simple_rig_refers_to_the_files(tmp_path, rng):
    view = write_raw(tmp_path, dots(rng), "RGGB", rng)
    assert find_image(tmp_path) == ("cam1", (H, W)) == ("cam1", find_image(tmp_path / "cam1" / "flow.tif")[1])
    (tmp_path / "views.toml").write_text('[views.cam1]\nreference = "cam1/reference.tif"\nwidth = 20\n')
    with refused(f"view '{view.name}'"):
        find_image(tmp_path)
    assert find_image(tmp_path, image_size=(H, W))[1] == (H, W)


def rendered(pattern: np.ndarray, shift: np.ndarray, binning: int) -> np.ndarray:
    """Light of pixels of 3 x 3 (binned: 6 x 6) points of a pattern, shifted by (u, v) px."""
    rows, columns = np.mgrid[: 3 * H, : 3 * W].astype(np.float32)
    points = map_coordinates(pattern, [rows + 30 - 3 * shift[1], columns + 30 - 3 * shift[0]], order=1)
    size = 3 * binning
    return points.reshape(3 * H // size, size, 3 * W // size, size).mean((1, 3))


def test_displacements_have_the_error_of_a_grey_camera_of_half_the_size(tmp_path, rng):
    shift, method = np.array([0.3, -0.15]), DisplacementSettings()
    pattern = dots(rng, (3 * H + 60, 3 * W + 60), 3.3).astype(np.float32)
    still, moved = (rendered(pattern, d, 1) for d in (0 * shift, shift))
    small = [rendered(pattern, d, 2) for d in (0 * shift, shift)]
    raw = write_raw(tmp_path / "raw", still, "RGGB", rng, flow=moved)
    for source, light in zip(("reference", "flow"), small, strict=True):
        (tmp_path / "half" / "cam1").mkdir(parents=True, exist_ok=True)
        stack = np.stack([exposed(light, rng) for _ in range(3 if source == "reference" else 1)])
        write_tiff(tmp_path / "half" / "cam1" / f"{source}.tif", stack, photometric="minisblack")

    def evaluate(view: View) -> tuple[float, float]:
        """Rms error in px of the sensor, and in units of sigma."""
        images = [good_images(view, source, lambda line: None) for source in ("reference", "flow")]
        result = Reference.of(images[0], method, view.full_scale).measure([images[1][0]])
        pixel = H / result.valid.shape[0]
        error = (result.displacement - shift / pixel)[8:-8, 8:-8]
        good = result.valid[8:-8, 8:-8]
        sigma = result.sigma[8:-8, 8:-8]
        return pixel * float(np.sqrt(np.mean(error[good] ** 2))), float(np.sqrt(np.mean((error / sigma)[good] ** 2)))

    (as_grey, _), (binned, honest) = evaluate(replace(raw, mosaic="none")), evaluate(raw)
    grey_camera, _ = evaluate(find_views(tmp_path / "half")[0])
    assert binned < 0.7 * as_grey
    assert binned < 1.1 * grey_camera
    assert 0.3 < honest < 1.5
