"""Scans by parallel rays: what they tell of themselves, and that the slice they become is the right way round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerif.imaging.line_scans import LineScan
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from refusals import refused

ANGLES = np.radians(np.arange(0, 180, 12.0))
POSITIONS = -6 + 0.25 * np.arange(47)  # not about the axis
AXIS, OFFSET, BEND = -0.31, -0.6, 0.05
BALLS = ((-1.5, 0.8, 0.6, 1.1), (2.0, -0.5, 0.5, 0.8))  # x, y, standard deviation, extinction

METHOD = Tikhonov(voxels=44, basis="linear", regularisation=1e-6, iterations=200, device="cpu")


def true_scan() -> LineScan:
    """Integrals along lines through two Gaussian columns."""
    at = POSITIONS - AXIS
    total = np.zeros((len(ANGLES), len(at)))
    for x, y, width, extinction in BALLS:
        away = at - (x * np.cos(ANGLES) + y * np.sin(ANGLES))[:, None]
        total += extinction * width * np.sqrt(2 * np.pi) * np.exp(-((away / width) ** 2) / 2)
    return LineScan(ANGLES, POSITIONS, total)


@pytest.fixture(scope="module")
def measured() -> LineScan:
    """With an offset, saturation and noise."""
    scan = true_scan()
    noise = np.random.default_rng(0).normal(0, 1e-3, scan.readings.shape)
    return replace(scan, readings=LineScan.bent(scan.readings, BEND) + OFFSET + noise)


def test_a_scan_tells_its_offset_axis_and_saturation(measured):
    assert measured.offset == pytest.approx(OFFSET, abs=5e-4)
    assert measured.noise == pytest.approx(1e-3, rel=0.3)
    scan = measured.without_offset(measured.offset)
    assert len(scan.complete) == len(ANGLES)
    bend, before, after = scan.bend()
    assert bend == pytest.approx(BEND, abs=0.005)
    assert after < 0.3 * before
    assert scan.unbent(BEND).axis() == pytest.approx(AXIS, abs=0.01)
    told = measured.tell()
    assert (told.offset, told.noise) == (measured.offset, measured.noise)
    assert (told.bend, told.scatter, told.scatter_after) == (bend, before, after)
    assert told.axis == scan.unbent(bend).axis()
    assert str(told).startswith(f"offset {told.offset:.4f}, noise beside the medium")
    absorbances = np.linspace(0, 4, 9)
    bent = LineScan.bent(absorbances, BEND)
    assert np.allclose(bent + BEND * bent**2, absorbances)


def test_the_slice_is_the_right_way_round():
    scan = true_scan()
    result = METHOD(scan.measurement(AXIS))
    assert result.quantity == "extinction"
    for x, y, _, extinction in BALLS:
        at = result.field(_point(x, y))
        assert float(at) == pytest.approx(extinction, rel=0.2)
        assert abs(float(result.field(_point(-x, y)))) < 0.1
        assert abs(float(result.field(_point(x, -3 * y)))) < 0.1


def _point(x: float, y: float):
    import torch

    return torch.tensor([x, y, 0.0])


def test_an_angle_read_beside_its_place_is_told():
    scan = true_scan()
    moved = scan.readings.copy()
    moved[4] = np.interp(scan.positions - 0.05, scan.positions, moved[4])
    shifts = replace(scan, readings=moved).shifts()
    assert shifts.keys() == set(range(len(ANGLES)))
    assert shifts[4] == pytest.approx(0.05, rel=0.2)  # but for what it draws the sinusoid along
    assert max(abs(shift) for angle, shift in shifts.items() if angle != 4) < 0.01


def test_angles_that_are_cut_off_are_not_counted_on():
    scan = true_scan()
    cut = scan.readings.copy()
    cut[3, :5] = 0.4
    assert 3 not in replace(scan, readings=cut).complete
    with refused("readings"):
        replace(scan, readings=scan.readings + 1).bend()
    with refused("readings"):
        replace(scan, readings=np.where(np.arange(len(ANGLES))[:, None] < 2, scan.readings, 1.0)).axis()


def test_every_angle_has_a_name_of_its_own():
    assert true_scan().measurement(AXIS).names[:3] == ("0deg", "12deg", "24deg")
    degrees = 150 + 0.01 * np.arange(8)  # as of a scan of many angles
    scan = LineScan(np.radians(degrees), POSITIONS, np.ones((8, len(POSITIONS))))
    names = scan.measurement(AXIS).names
    assert [float(name.removesuffix("deg")) for name in names] == pytest.approx(degrees, abs=1e-6)
    assert len(set(names)) == len(names)
    twice = replace(scan, angles=np.radians([*degrees[:7], 150.0]))
    with refused("angles"):
        twice.measurement(AXIS)


@pytest.mark.usefixtures("unchecked")
def test_scans_that_cannot_be():
    scan = true_scan()
    with refused("readings"):
        LineScan(ANGLES[:-1], POSITIONS, scan.readings)
    with refused("positions"):
        LineScan(ANGLES, POSITIONS**3, scan.readings)
    with refused("readings"):
        scan.select([0, 1])
