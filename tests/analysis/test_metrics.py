"""Metrics against their formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest

from nerif.analysis.metrics import correlation, psnr, slice_metrics, ssim, view_metrics, volume_metrics

RNG = np.random.default_rng(0)
TRUTH = -2e-4 * RNG.random((20, 11, 13))
TEST = TRUTH + 1e-5 * RNG.standard_normal(TRUTH.shape)


def test_volume_metrics():
    m = volume_metrics(TRUTH, TEST, n_ambient=1.00027)
    error = math.sqrt(((TRUTH - TEST) ** 2).sum())
    assert m["l2"] == pytest.approx(error / math.sqrt(((TRUTH + 2.7e-4) ** 2).sum()), rel=1e-6)
    assert m["l2_variation"] == pytest.approx(error / math.sqrt((TRUTH**2).sum()))
    assert m["cc"] == pytest.approx(np.corrcoef(TRUTH.ravel(), TEST.ravel())[0, 1])
    assert m["psnr"] == pytest.approx(10 * math.log10(np.ptp(TRUTH) ** 2 / ((TRUTH - TEST) ** 2).mean()))
    assert ssim(TRUTH, TRUTH) == pytest.approx(1)
    assert m["ssim"] < 0.999
    offset = volume_metrics(TRUTH, TRUTH + 1e-5, 1.00027)  # an error of the gauge counts
    assert offset["l2_variation"] > 0.01
    assert offset["cc"] == pytest.approx(1)


def test_perfect_constant_and_small_input():
    flat = np.zeros_like(TRUTH)
    assert psnr(TRUTH, TRUTH) == math.inf
    undefined = (correlation(flat, TEST), psnr(flat, TEST), volume_metrics(flat, TEST, 1.00027)["l2_variation"])
    assert all(math.isnan(x) for x in (*undefined, ssim(TRUTH[:3], TEST[:3])))  # smaller than the window


def test_ten_slices_across_z():
    slices = slice_metrics(TRUTH, TEST, np.arange(20) - 9.5)
    assert [s["z_mm"] for s in slices] == [-8.5, -6.5, -4.5, -2.5, -0.5, 1.5, 3.5, 5.5, 7.5, 9.5]
    assert slices[3]["cc"] == pytest.approx(correlation(TRUTH[7], TEST[7]))


def test_view_metrics_ignore_invalid_pixels():
    measured = RNG.standard_normal((15, 17, 2)).astype(np.float32)
    valid = np.ones((15, 17), dtype=bool)
    valid[4:6, 2:9] = False
    clean = view_metrics(measured, measured + 0.1, valid)
    assert clean["rms"] == pytest.approx(0.1, rel=1e-4)
    assert clean["cc"] == pytest.approx(1, abs=1e-6)
    spoilt = np.where(valid[..., None], measured, np.float32(1e6))
    assert view_metrics(spoilt, measured + 0.1, valid) == pytest.approx(clean)
    assert all(math.isnan(v) for v in view_metrics(measured, measured, valid & False).values())
