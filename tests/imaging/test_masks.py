"""Flow masks: by threshold or drawn, and that what is not known does not carve the visual hull."""

from __future__ import annotations

from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import Scaled, make_phantom
from nerif.forward.emission import Emission
from nerif.geometry import Box, Grid, Ring
from nerif.imaging.masks import MaskSettings, drawn_masks, flow_mask, with_flow_masks
from nerif.imaging.readers.open import read_mask
from nerif.reconstruction.gauge import visual_hull
from nerif.simulation.simulate import simulate
from refusals import refused

SHAPE = (60, 90)
BOX = Box((-25.0, -25.0, -25.0), (25.0, 25.0, 25.0))


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    bump = np.exp(-(((rows - 28) / 9) ** 2) - ((columns - 50) / 13) ** 2)
    return np.stack([2.0 * bump, -1.2 * bump * (columns - 50) / 13], axis=-1)


@pytest.fixture(scope="module")
def measured(truth) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return (
        (truth + 0.05 * rng.standard_normal(truth.shape)).astype(np.float32),
        np.full(truth.shape, 0.05, dtype=np.float32),
    )


def test_a_mask_holds_the_flow_and_little_else(truth, measured):
    d, sigma = measured
    mask = flow_mask(d, sigma)
    strong = np.linalg.norm(truth, axis=-1)
    assert mask[strong > 0.25].all()
    assert mask[strong < 0.005].mean() < 0.02
    assert flow_mask(d, sigma, MaskSettings(grow=8)).sum() > mask.sum()
    assert not flow_mask(0 * d, sigma).any()


@pytest.mark.parametrize("unknown", ["displacement", "sigma", "no noise"])
def test_what_is_not_known_is_inside_and_its_surroundings_are_as_before(measured, unknown):
    d, sigma = (x.copy() for x in measured)
    before = flow_mask(d, sigma)
    hidden = np.zeros(SHAPE, dtype=bool)
    hidden[20:40, 40:52] = hidden[2, 3] = True  # in the middle of the flow, and far from it
    if unknown == "displacement":
        d[hidden] = np.nan
    else:
        sigma[hidden] = np.nan if unknown == "sigma" else 0
    mask = flow_mask(d, sigma)
    assert mask[hidden].all()
    known = ~hidden
    assert (mask[known] == before[known]).mean() > 0.995
    assert mask[before].mean() > 0.98


def test_the_little_of_an_island_that_is_seen_beside_unknown_pixels_is_kept(measured):
    d, sigma = (x.copy() for x in measured)
    d[:, 36:] = np.nan  # leaves a narrow strip of the flow
    strip = np.zeros(SHAPE, dtype=bool)
    strip[26:31, 34:36] = True
    assert flow_mask(d, sigma, MaskSettings(grow=0))[strip].all()


@pytest.mark.parametrize("name", ["threshold", "smooth", "smallest", "grow"])
def test_settings_that_cannot_be_right(name):
    with pytest.raises(InputError, match=name):
        MaskSettings(**{name: -1})


@pytest.fixture(scope="module")
def four() -> Measurement:
    """A ball of hot gas seen by four views, the smaller image of the last one padded."""
    ring = Ring(views=4, arc=(0.0, 135.0), image_size=(64, 64), pixel_pitch=0.0625)
    cameras = ring.cameras()
    cameras = (*cameras[:3], cameras[3].view(4, 4, 56, 56))
    return simulate(make_phantom("gaussians", BOX, 1), cameras, BOX, 1.00027, noise=0.02, seed=0, steps=30)


def test_a_hidden_block_in_one_view_carves_nothing_from_the_hull(four):
    grid = Grid.of_resolution(BOX, 32)
    before = visual_hull(with_flow_masks(four), grid)
    assert 0.05 < float(before.float().mean()) < 0.95
    valid = four.usable.clone()
    valid[1, 22:42, 22:42] = False
    after = visual_hull(with_flow_masks(replace(four, valid=valid)), grid)
    assert bool(after[before].all())
    assert int(after.sum()) < 1.3 * int(before.sum())


def test_drawn_masks_are_taken_as_they_are(four, tmp_path):
    image = np.zeros((64, 64), np.uint8)
    image[10:50, 20:40] = 255
    name = four.names[1]
    iio.imwrite(tmp_path / f"{name}.png", image)
    valid = four.usable.clone()
    valid[1, :5] = False
    masked = with_flow_masks(replace(four, valid=valid), drawings=drawn_masks(tmp_path, four.names)).flow_mask
    assert masked is not None
    assert torch.equal(masked[1], torch.from_numpy(image > 0))
    with pytest.raises(InputError, match="no such folder"):
        drawn_masks(tmp_path / "none", four.names)
    with pytest.raises(InputError, match="images named as the views"):
        drawn_masks(tmp_path, ["other"])


def test_masks_need_noise_and_flow(four):
    with refused("sigma"):
        with_flow_masks(replace(four, sigma=None))
    assert with_flow_masks(replace(four, sigma=None), sigma=0.02).flow_mask is not None
    valid = four.usable.clone()
    valid[0, 0, 0] = False  # unknown is no flow
    with refused("threshold"):
        with_flow_masks(replace(four, valid=valid), MaskSettings(threshold=1000.0))


@pytest.fixture(scope="module")
def glowing() -> Measurement:
    """A ball that gives off light."""
    cameras = Ring(views=3, image_size=(40, 44), pixel_pitch=0.1).cameras()
    field = make_phantom("gaussians", BOX, 1)
    return simulate(Scaled(field, -1e3), cameras, BOX, 1.0, noise=0.02, seed=0, steps=20, techniques=[Emission])


def test_every_technique_has_masks_by_threshold_or_drawn(glowing, tmp_path, capsys):
    found = with_flow_masks(glowing).flow_mask
    radiance = glowing.maps["radiance"]
    assert bool(found[radiance > 0.1 * radiance.max()].all())
    assert 0.02 < float(found.float().mean()) < 0.9
    with refused("sigma"):
        with_flow_masks(replace(glowing, maps={"radiance": radiance}))
    glowing.write(tmp_path / "m.nc")
    folder = tmp_path / "drawn"
    folder.mkdir()
    for name, mask in zip(glowing.names, found.numpy(), strict=True):
        iio.imwrite(folder / f"{name}.png", mask.astype(np.uint8) * 255)
    assert main(["mask", str(tmp_path / "m.nc"), "-o", str(tmp_path / "k.nc"), "--drawn", str(folder)]) == 0
    assert "the masks over |radiance|" in capsys.readouterr().out
    assert (tmp_path / "k.masks.png").is_file()
    assert torch.equal(Measurement.read(tmp_path / "k.nc").flow_mask, found)


def test_of_two_techniques_either_shows_the_flow(four):
    """Fringes that one view alone has, of something at its edge that the displacement does not show."""
    fringes, rows = torch.full(four.shape, torch.nan), slice(0, 64)
    fringes[0, rows] = 0.0
    fringes[0, 4:20, 4:20] = 9.0
    maps = {"fringes": fringes, "fringes_sigma": torch.full(four.shape, 0.1)}
    combined = with_flow_masks(replace(four, maps=maps, wavelength_nm=532.0)).flow_mask
    alone = with_flow_masks(four).flow_mask
    assert bool(combined[alone].all())
    assert bool(combined[0, 4:20, 4:20].all())
    assert not bool(alone[0, 4:12, 4:12].any())
    assert torch.equal(combined[1:], alone[1:])
    with refused("sigma"):
        with_flow_masks(replace(four, maps=maps, wavelength_nm=532.0), sigma=0.1)


def test_drawn_masks_are_read(tmp_path):
    image = np.zeros((30, 40), np.uint8)
    image[5:10, 20:30] = 255
    iio.imwrite(tmp_path / "cam1.png", image)
    assert np.array_equal(read_mask(tmp_path / "cam1.png", (30, 40)), image > 0)
    with pytest.raises(InputError, match=r"cam1.png: expected a mask of 40 x 30 px"):
        read_mask(tmp_path / "cam1.png", (40, 30))
    iio.imwrite(tmp_path / "black.png", 0 * image)
    with pytest.raises(InputError, match="one grey"):
        read_mask(tmp_path / "black.png", (30, 40))
