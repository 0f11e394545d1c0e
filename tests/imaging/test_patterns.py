"""Patterns to print: true size, true dots, the spectrum they are named for."""

from __future__ import annotations

import re
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.patterns import KINDS, MARGIN, Background, paper_for, print_pattern
from refusals import refused


@pytest.mark.parametrize("kind", KINDS)
def test_patterns_are_grey_reproducible_and_of_the_right_size(kind):
    a, b, c = (Background(kind, 60.0, 40.0, dot=1.2, seed=s).raster(0.2) for s in (1, 1, 2))
    assert a.shape == (200, 300)
    assert a.min() >= 0
    assert a.max() <= 1
    assert a.std() > 0.15
    assert np.array_equal(a, b)
    assert abs(np.corrcoef(a.ravel(), c.ravel())[0, 1]) < 0.2


def test_dots_cover_what_they_should_and_keep_apart():
    pattern = Background("dots", 90.0, 60.0, dot=1.0, fill=0.3)
    assert 1 - pattern.raster(0.1).mean() == pytest.approx(0.3, abs=0.03)
    assert cKDTree(pattern.dots()).query(pattern.dots(), k=2)[0][:, 1].min() > 0.9


@pytest.mark.parametrize("kind", KINDS)
def test_features_grow_with_the_dot(kind):
    def length(dot):
        x = Background(kind, 120.0, 80.0, dot=dot).raster(0.25)
        power = np.abs(np.fft.rfft2(x - x.mean())) ** 2
        frequency = np.hypot(np.fft.fftfreq(x.shape[0])[:, None], np.fft.rfftfreq(x.shape[1])[None])
        return 1 / np.average(frequency, weights=power)

    assert length(4.0) > 1.3 * length(1.5)


def test_wavelet_noise_has_one_band_and_multiscale_noise_many():
    shares = {}
    for kind in ("wavelet", "multiscale"):
        x = Background(kind, 128.0, 96.0, dot=1.0).raster(0.25)
        power = np.abs(np.fft.rfft2(x - x.mean())) ** 2
        # cycles a dot
        frequency = 4 * np.hypot(np.fft.fftfreq(x.shape[0])[:, None], np.fft.rfftfreq(x.shape[1])[None])
        shares[kind] = power[frequency < 0.12].sum() / power.sum()
    assert shares["wavelet"] < 0.05
    assert shares["multiscale"] > 0.5


@pytest.mark.parametrize(
    ("change", "words"),
    [({"kind": "stripes"}, "kind"), ({"width": 0.0}, "width"), ({"fill": 0.9}, "fill"), ({"dot": 30.0}, "quarter")],
)
def test_patterns_that_cannot_be(change, words):
    with pytest.raises(InputError, match=words):
        Background(**{"width": 60.0, "height": 40.0, "dot": 1.0, **change})
    with refused("pixel"):
        Background("dots", 60.0, 40.0, 1.0).raster(0.8)


def test_files_are_of_true_size(tmp_path):
    pattern = Background("wavelet", 60.0, 40.0, dot=2.0)
    print_pattern(tmp_path / "p.png", pattern, dpi=101.6)
    with Image.open(tmp_path / "p.png") as image:
        assert image.size[0] / image.info["dpi"][0] * 25.4 == pytest.approx(60.0, rel=1e-3)
        assert image.size[1] / image.info["dpi"][1] * 25.4 == pytest.approx(40.0, rel=1e-3)
    print_pattern(tmp_path / "p.pdf", pattern, dpi=101.6)
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", (tmp_path / "p.pdf").read_bytes())
    assert box is not None
    assert float(box[1]) / 72 * 25.4 == pytest.approx(60 + 2 * MARGIN, rel=1e-3)
    assert float(box[2]) / 72 * 25.4 == pytest.approx(40 + 2 * MARGIN, rel=1e-3)
    with refused("out"):
        print_pattern(tmp_path / "p.gif", pattern)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.pdf", "p.png"]


def test_paper_is_the_smallest_on_which_it_fits():
    pattern = Background(width=290.0, height=205.0)
    assert paper_for(Path("p.png"), pattern) == "A4"
    assert paper_for(Path("p.pdf"), pattern) == "A3"  # it has a margin for its scale bar
    assert paper_for(Path("p.png"), Background(width=2000.0, height=500.0)) == "a plotter"


@pytest.mark.parametrize("kind", ["dots", "chessboard", "charuco", "circles"])
def test_the_command_writes_each_kind(tmp_path, capsys, kind):
    out = tmp_path / "p.png"
    size = ["--width", "70", "--height", "50"] if kind == "dots" else ["--columns", "8", "--rows", "7", "--pitch", "6"]
    size += ["--dpi", "150"]
    assert main(["pattern", "--kind", kind, "-o", str(out), *size]) == 0
    said = capsys.readouterr().out
    assert "fits on A4" in said
    if kind != "dots":
        target = CalibrationTarget(kind, 8, 7, 6.0)
        found = target.detect(iio.imread(out))
        assert found is not None
        assert len(found.ids) == len(target.points)
    assert main(["pattern", "--kind", kind, "-o", str(out), *size]) == 2
    assert "exists already" in capsys.readouterr().err


def test_the_command_writes_a_page_and_refuses_what_cannot_be(tmp_path):
    assert main(["pattern", "-o", str(tmp_path / "p.pdf"), "--width", "50", "--height", "40"]) == 0
    assert (tmp_path / "p.pdf").stat().st_size > 1000
    assert main(["pattern", "-o", str(tmp_path / "q.pdf"), "--kind", "zebra"]) == 2
    assert main(["pattern", "-o", str(tmp_path / "q.pdf"), "--kind", "charuco", "--dot", "2"]) == 2  # of backgrounds
    assert main(["pattern", "-o", str(tmp_path / "q.svg")]) == 2
    assert main(["pattern", "-o", str(tmp_path / "q.pdf"), "--width", "9000", "--height", "9000", "--dot", "0.3"]) == 2
    assert main(["pattern", "-o", str(tmp_path / "q.pdf"), "--dpi", "0"]) == 2
