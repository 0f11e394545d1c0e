"""Printed backgrounds and targets: size, reproducibility, scales, and their command."""

from __future__ import annotations

import re
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from nerif.cli.cli import main
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.patterns import KINDS, MARGIN, Background, paper_for, print_pattern
from refusals import refused


def spectrum(raster, pixel=1.0):
    """Frequencies and power of a pattern."""
    power = np.abs(np.fft.rfft2(raster - raster.mean())) ** 2
    return np.hypot(np.fft.fftfreq(raster.shape[0])[:, None], np.fft.rfftfreq(raster.shape[1])[None]) / pixel, power


@pytest.mark.parametrize("kind", KINDS)
def test_patterns_are_grey_reproducible_and_of_the_right_size(kind):
    a, b, c = (Background(kind, 60.0, 40.0, dot=1.2, seed=s).raster(0.2) for s in (1, 1, 2))
    assert a.shape == (200, 300)
    assert 0 <= a.min() < a.max() <= 1
    assert a.std() > 0.15
    assert np.array_equal(a, b)
    assert abs(np.corrcoef(a.ravel(), c.ravel())[0, 1]) < 0.2
    coarse, fine = (spectrum(Background(kind, 120.0, 80.0, dot=dot).raster(0.25)) for dot in (4.0, 1.5))
    assert np.average(fine[0], weights=fine[1]) > 1.3 * np.average(coarse[0], weights=coarse[1])


def test_dots_have_their_coverage_and_distance():
    pattern = Background("dots", 90.0, 60.0, dot=1.0, fill=0.3)
    assert 1 - pattern.raster(0.1).mean() == pytest.approx(0.3, abs=0.03)
    assert cKDTree(pattern.dots()).query(pattern.dots(), k=2)[0][:, 1].min() > 0.9


def test_wavelet_noise_has_one_band_and_multiscale_noise_many():
    shares = {}
    for kind in ("wavelet", "multiscale"):
        frequency, power = spectrum(Background(kind, 128.0, 96.0, dot=1.0).raster(0.25), 0.25)  # per dot
        shares[kind] = power[frequency < 0.12].sum() / power.sum()
    assert shares["wavelet"] < 0.05
    assert shares["multiscale"] > 0.5


def test_files_are_of_true_size(tmp_path):
    pattern = Background("wavelet", 60.0, 40.0, dot=2.0)
    print_pattern(tmp_path / "p.png", pattern, dpi=101.6)
    with Image.open(tmp_path / "p.png") as image:
        size = [n / dpi * 25.4 for n, dpi in zip(image.size, image.info["dpi"], strict=True)]
    assert size == pytest.approx([60.0, 40.0], rel=1e-3)
    print_pattern(tmp_path / "p.pdf", pattern, dpi=101.6)
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", (tmp_path / "p.pdf").read_bytes())
    assert [float(n) / 72 * 25.4 for n in box.groups()] == pytest.approx([60 + 2 * MARGIN, 40 + 2 * MARGIN], rel=1e-3)
    with refused("out"):
        print_pattern(tmp_path / "p.gif", pattern)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.pdf", "p.png"]


@pytest.mark.parametrize(
    ("name", "size", "paper"),
    [("p.png", (290.0, 205.0), "A4"), ("p.pdf", (290.0, 205.0), "A3"), ("p.png", (2000.0, 500.0), "a plotter")],
)
def test_smallest_paper(name, size, paper):
    assert paper_for(Path(name), Background("dots", *size)) == paper


@pytest.mark.parametrize("kind", ["dots", "chessboard", "charuco", "circles"])
def test_the_command_writes_each_kind(tmp_path, capsys, kind):
    out = tmp_path / "p.png"
    size = ["--width", "70", "--height", "50"] if kind == "dots" else ["--columns", "8", "--rows", "7", "--pitch", "6"]
    words = ["pattern", "--kind", kind, "-o", str(out), *size, "--dpi", "150"]
    assert main(words) == 0
    assert "fits on A4" in capsys.readouterr().out
    if kind != "dots":
        target = CalibrationTarget(kind, 8, 7, 6.0)
        assert len(target.detect(iio.imread(out)).ids) == len(target.points)
    assert main(words) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("p.pdf --width 50 --height 40", 0),
        ("q.pdf --kind zebra", 2),
        ("q.pdf --kind charuco --dot 2", 2),  # an option of backgrounds
        ("q.svg", 2),
        ("q.pdf --width 9000 --height 9000 --dot 0.3", 2),
        ("q.pdf --dpi 0", 2),
    ],
)
def test_the_command_writes_a_page_and_refuses_invalid_options(tmp_path, monkeypatch, words, code):
    monkeypatch.chdir(tmp_path)
    assert main(["pattern", "-o", *words.split()]) == code
    assert [p.name for p in tmp_path.iterdir()] == ["p.pdf"] * (code == 0)
