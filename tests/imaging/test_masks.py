"""Flow masks: by threshold or drawn; unknown pixels do not carve the visual hull."""

from __future__ import annotations

from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image

from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import Scaled, make_phantom
from nerif.forward.emission import Emission
from nerif.geometry import Box, Grid, Ring
from nerif.imaging.imaging_settings import MaskSettings
from nerif.imaging.masks import MaskShape, drawn_masks, flow_mask, mask_of, with_flow_masks, write_masks
from nerif.imaging.readers.open import read_mask
from nerif.reconstruction.gauge import visual_hull
from nerif.simulation.simulate import simulate
from refusals import refused

SHAPE = (60, 90)
BOX = Box((-25.0, -25.0, -25.0), (25.0, 25.0, 25.0))
SQUARE = MaskShape("polygon", ((4, 2), (11, 2), (11, 8), (4, 8)))


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    bump = np.exp(-(((rows - 28) / 9) ** 2) - ((columns - 50) / 13) ** 2)
    return np.stack([2.0 * bump, -1.2 * bump * (columns - 50) / 13], axis=-1)


@pytest.fixture
def noisy(truth) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and sigma."""
    d = truth + 0.05 * np.random.default_rng(0).standard_normal(truth.shape)
    return d.astype(np.float32), np.full(truth.shape, 0.05, dtype=np.float32)


def test_a_mask_holds_the_flow_and_little_else(truth, noisy):
    d, sigma = noisy
    mask = flow_mask(d, sigma)
    strength = np.linalg.norm(truth, axis=-1)
    assert mask[strength > 0.25].all()
    assert mask[strength < 0.005].mean() < 0.02
    assert flow_mask(d, sigma, MaskSettings(grow=8)).sum() > mask.sum()
    assert not flow_mask(0 * d, sigma).any()


@pytest.mark.parametrize("unknown", ["displacement", "sigma", "no noise"])
def test_unknown_pixels_are_inside_and_do_not_affect_the_others(noisy, unknown):
    d, sigma = noisy
    before = flow_mask(d, sigma)
    hidden = np.zeros(SHAPE, dtype=bool)
    hidden[20:40, 40:52] = hidden[2, 3] = True  # in the middle of the flow, and far from it
    if unknown == "displacement":
        d[hidden] = np.nan
    else:
        sigma[hidden] = np.nan if unknown == "sigma" else 0
    mask = flow_mask(d, sigma)
    assert mask[hidden].all()
    assert (mask == before)[~hidden].mean() > 0.995
    assert mask[before].mean() > 0.98


def test_the_visible_strip_of_a_hidden_island_remains(noisy):
    d, sigma = noisy
    d[:, 36:] = np.nan
    assert flow_mask(d, sigma, MaskSettings(grow=0))[26:31, 34:36].all()


@pytest.fixture(scope="module")
def four() -> Measurement:
    """A ball of hot gas in four views, the smaller image of the last one padded."""
    cameras = Ring(views=4, arc=(0.0, 135.0), image_size=(64, 64), pixel_pitch=0.0625).cameras()
    cameras = (*cameras[:3], cameras[3].view(4, 4, 56, 56))
    return simulate(make_phantom("gaussians", BOX, 1), cameras, BOX, 1.00027, noise=0.02, seed=0, steps=30)


def without(measurement: Measurement, *pixels) -> Measurement:
    """The measurement without some pixels, which are not valid."""
    valid = measurement.usable.clone()
    valid[pixels] = False
    return replace(measurement, valid=valid)


def test_a_hidden_block_in_one_view_carves_nothing_from_the_hull(four):
    grid = Grid.of_resolution(BOX, 32)
    before = visual_hull(with_flow_masks(four), grid)
    assert 0.05 < float(before.float().mean()) < 0.95
    after = visual_hull(with_flow_masks(without(four, 1, slice(22, 42), slice(22, 42))), grid)
    assert bool(after[before].all())
    assert int(after.sum()) < 1.3 * int(before.sum())


def test_drawn_masks_take_precedence(four, tmp_path):
    image = np.zeros((64, 64), np.uint8)
    image[10:50, 20:40] = 255
    iio.imwrite(tmp_path / f"{four.names[1]}.png", image)
    masks = with_flow_masks(without(four, 1, slice(0, 5)), drawings=drawn_masks(tmp_path, four.names)).flow_mask
    assert torch.equal(masks[1], torch.from_numpy(image > 0))
    for folder, names in ((tmp_path / "none", four.names), (tmp_path, ["other"])):
        with refused(folder):
            drawn_masks(folder, names)


def test_masks_drawn_at_twice_the_size_are_binned_and_reported(four, tmp_path, lines):
    image = np.zeros((128, 128), np.uint8)
    image[20:100, 41:80] = 255
    iio.imwrite(tmp_path / f"{four.names[1]}.png", image)
    drawings = drawn_masks(tmp_path, four.names)
    with refused(tmp_path / f"{four.names[1]}.png"):
        with_flow_masks(four, drawings=drawings)
    mask = with_flow_masks(four, drawings=drawings, say=lines.append).flow_mask[1]
    assert torch.equal(mask, torch.from_numpy(image[::2, ::2] > 0))  # without the column of which half is inside
    assert len(lines) == 1


@pytest.mark.parametrize("name", ["cam1.jpg", "cam1.PNG", "Cam1.png", "CAM1.TIFF"])
def test_drawings_with_any_ending_and_letters(tmp_path, name, lines):
    image = np.zeros((40, 40), np.uint8)
    image[8:32, 8:24] = 255
    iio.imwrite(tmp_path / name, image)
    iio.imwrite(tmp_path / "other.png", image)
    masks = drawn_masks(tmp_path, ["cam1", "cam2"], lines.append)
    assert {view: path.name for view, path in masks.items()} == {"cam1": name}
    assert any("other.png" in line for line in lines)
    assert any("cam2" in line for line in lines)


@pytest.mark.parametrize("mode", ["1", "P"])
@pytest.mark.parametrize("ending", ["png", "tif"])
def test_masks_of_one_bit_and_with_a_palette(tmp_path, mode, ending):
    image = np.zeros((20, 30), np.uint8)
    image[4:9, 5:20] = 255
    Image.fromarray(image).convert(mode).save(tmp_path / f"m.{ending}")
    np.testing.assert_array_equal(read_mask(tmp_path / f"m.{ending}", image.shape), image > 0)


def test_masks_need_noise_and_flow(four):
    with refused("sigma"):
        with_flow_masks(replace(four, sigma=None))
    assert with_flow_masks(replace(four, sigma=None), sigma=0.02).flow_mask is not None
    with refused("threshold"):
        with_flow_masks(without(four, 0, 0, 0), MaskSettings(threshold=1000.0))  # an unknown pixel is no flow


def test_masks_of_another_technique_by_threshold_or_drawn(tmp_path, capsys):
    cameras, field = Ring(views=3, image_size=(40, 44), pixel_pitch=0.1).cameras(), make_phantom("gaussians", BOX, 1)
    glow = simulate(Scaled(field, -1e3), cameras, BOX, 1.0, noise=0.02, seed=0, steps=20, techniques=[Emission])
    masks, radiance = with_flow_masks(glow).flow_mask, glow.maps["radiance"]
    assert bool(masks[radiance > 0.1 * radiance.max()].all())
    assert 0.02 < float(masks.float().mean()) < 0.9
    with refused("sigma"):
        with_flow_masks(replace(glow, maps={"radiance": radiance}))
    glow.write(tmp_path / "m.nc")
    folder = tmp_path / "drawn"
    folder.mkdir()
    for name, mask in zip(glow.names, masks.numpy(), strict=True):
        iio.imwrite(folder / f"{name}.png", mask.astype(np.uint8) * 255)
    assert main(["mask", str(tmp_path / "m.nc"), "-o", str(tmp_path / "k.nc"), "--drawings", str(folder)]) == 0
    assert "|radiance|" in capsys.readouterr().out
    assert (tmp_path / "k.masks.png").is_file()
    assert torch.equal(Measurement.read(tmp_path / "k.nc").flow_mask, masks)


def test_flow_of_either_of_two_techniques(four):
    """Fringes in one view only, at the edge, where the displacement is zero."""
    fringes = torch.full(four.shape, torch.nan)
    fringes[0, :64] = 0.0
    fringes[0, 4:20, 4:20] = 9.0
    maps = {"fringes": fringes, "fringes_sigma": torch.full(four.shape, 0.1)}
    both = replace(four, maps=maps, wavelength_nm=532.0)
    combined, alone = with_flow_masks(both).flow_mask, with_flow_masks(four).flow_mask
    assert bool(combined[alone].all())
    assert bool(combined[0, 4:20, 4:20].all())
    assert not bool(alone[0, 4:12, 4:12].any())
    assert torch.equal(combined[1:], alone[1:])
    with refused("sigma"):
        with_flow_masks(both, sigma=0.1)


def test_shapes_cover_one_another():
    mask = mask_of([SQUARE, MaskShape("brush", ((0, 5), (19, 5)), False, 3.0)], (12, 20))
    rows, columns = np.indices(mask.shape)
    inside = (rows >= 2) & (rows <= 8) & (columns >= 4) & (columns <= 11)
    assert np.array_equal(mask, inside & (abs(rows - 5) > 1))
    dot = mask_of([MaskShape("brush", ((10, 6),), True, 5.0)], (12, 20))
    assert 15 < dot.sum() < 26
    assert dot[6, 10]


def test_drawings_are_written_and_read(tmp_path):
    write_masks(tmp_path / "masks", {"a": [SQUARE], "b": []}, {"a": (12, 20), "b": (12, 20)})
    (path,) = drawn_masks(tmp_path / "masks", ["a", "b"]).values()
    assert np.array_equal(read_mask(path, (12, 20)), mask_of([SQUARE], (12, 20)))
    with refused(path):
        read_mask(path, (20, 12))
    iio.imwrite(tmp_path / "black.png", np.zeros((12, 20), np.uint8))
    with refused(tmp_path / "black.png"):
        read_mask(tmp_path / "black.png", (12, 20))


EMPTY = [SQUARE, MaskShape("polygon", SQUARE.points, False)]
WHOLE = [MaskShape("brush", ((0, 0), (19, 11)), True, 80.0)]


@pytest.mark.parametrize(
    ("name", "shapes", "field"),
    [("b", EMPTY, "mask of view 'b'"), ("b", WHOLE, "mask of view 'b'")]
    + [(name, [SQUARE], "view") for name in ("../../outside", "/tmp/outside", "a/b", "a\\b", "..", "")],
)
def test_invalid_drawings_write_nothing(tmp_path, name, shapes, field):
    with refused(field):
        write_masks(tmp_path / "project" / "masks", {"a": [SQUARE], name: shapes}, {"a": (12, 20), name: (12, 20)})
    assert list(tmp_path.rglob("*")) == []
