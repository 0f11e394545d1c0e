"""Every example runs, and what it writes can be used."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from line_scans import LineScan

from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.geometry import Grid
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from refusals import refused

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_own_data(tmp_path, monkeypatch):
    """The made-up displacements are those of the made-up flow: it is reconstructed from them."""
    path = tmp_path / "mine.nc"
    monkeypatch.setattr(sys, "argv", ["own_data.py", str(path)])
    names = runpy.run_path(str(EXAMPLES / "own_data.py"), run_name="__main__")
    m = Measurement.read(path)
    assert m.names == ("0deg", "45deg", "90deg", "135deg")
    result = Tikhonov(voxels=24, device="cpu")(m)
    grid = Grid.of_resolution(m.box, 24)
    slope = torch.from_numpy(names["gradient"](grid.points(torch.float64).numpy()))
    reconstructed = result.field.gradient(grid.points().reshape(-1, 3)).reshape(slope.shape).detach()
    inside = (slice(5, -5),) * 3
    cc = float(torch.corrcoef(torch.stack([slope[inside].flatten(), reconstructed[inside].double().flatten()]))[0, 1])
    assert cc > 0.9


def test_own_algorithm(tmp_path, monkeypatch, capsys):
    """Landweber finds most of the flame, and total variation more of it."""
    monkeypatch.setattr(sys, "argv", ["own_algorithm.py", "--out", str(tmp_path / "mine.vti")])
    runpy.run_path(str(EXAMPLES / "own_algorithm.py"), run_name="__main__")
    first, second = (float(x) for x in re.findall(r"error ([\d.]+)%", capsys.readouterr().out))
    assert second < 0.9 * first < 25
    assert read_volume(tmp_path / "mine.vti").grid.shape == (16, 18, 20)


def test_particles(tmp_path, monkeypatch, capsys):
    words = ["--pixels", "64", "--depth", "16", "--displacement", "2", "--window", "12"]
    monkeypatch.setattr(sys, "argv", ["particles.py", str(tmp_path), *words])
    runpy.run_path(str(EXAMPLES / "particles.py"), run_name="__main__")
    quality, error = map(float, re.findall(r"Q ([\d.]+), rms error ([\d.]+)", capsys.readouterr().out)[0])
    assert quality > 0.75
    assert error < 0.15
    assert Measurement.read(tmp_path / "after.nc").names == ("left below", "right below", "left above", "right above")
    assert (tmp_path / "particles.png").is_file()


@pytest.mark.slow
def test_from_images(tmp_path):
    """Images alone, to a field that correlates with the truth by 0.98 or more."""
    script = [sys.executable, str(EXAMPLES / "from_images.py"), str(tmp_path)]
    done = subprocess.run(script, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    metrics = json.loads((tmp_path / "result" / "metrics.json").read_text())
    assert metrics["cc"] >= 0.98
    assert len(metrics["views"]) == 9


@pytest.mark.slow
def test_knocked_camera(tmp_path):
    """The camera is named, and the field as good as with the calibration of where it stands, within a tenth."""
    script = [sys.executable, str(EXAMPLES / "knocked_camera.py"), str(tmp_path)]
    done = subprocess.run(script, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "FOUND: view 85deg is not where its calibration says" in done.stdout
    row = r"^(good|knocked|refined) +[\d.]+% +([\d.]+)%"
    errors = {name: float(aligned) for name, aligned in re.findall(row, done.stdout, re.M)}
    assert errors["knocked"] > 1.1 * errors["good"]
    assert errors["refined"] < 1.1 * errors["good"]


def test_line_scans():
    """Offset, noise, saturation, axis and misplaced angles of a scan through two columns; its slice is upright."""
    axis, offset, k, columns = -0.31, -0.6, 0.05, ((-1.5, 0.8, 0.6, 1.1), (2.0, -0.5, 0.5, 0.8))  # x, y, width, mu
    angles, positions = np.radians(np.arange(0, 180, 12.0)), -6 + 0.25 * np.arange(47)
    total = np.zeros((len(angles), len(positions)))
    for x, y, width, extinction in columns:
        distance = positions - axis - (x * np.cos(angles) + y * np.sin(angles))[:, None]
        total += extinction * width * np.sqrt(2 * np.pi) * np.exp(-((distance / width) ** 2) / 2)
    noise = np.random.default_rng(0).normal(0, 1e-3, total.shape)
    estimate = LineScan(angles, positions, LineScan.saturate(total, k) + offset + noise).estimate()
    assert estimate.offset == pytest.approx(offset, abs=5e-4)
    assert estimate.noise == pytest.approx(1e-3, rel=0.3)
    assert estimate.saturation == pytest.approx(k, abs=0.005)
    assert estimate.corrected_scatter < 0.3 * estimate.scatter
    assert estimate.axis == pytest.approx(axis, abs=0.01)
    scan = LineScan(angles, positions, total)
    measurement = scan.measurement(axis)
    assert measurement.names[:3] == ("0deg", "12deg", "24deg")
    result = Tikhonov(voxels=32, basis="linear", regularisation=1e-6, iterations=60, device="cpu")(measurement)
    for x, y, _, extinction in columns:
        values = result.field(torch.tensor([[x, y, 0.0], [-x, y, 0.0], [x, -3 * y, 0.0]]))
        np.testing.assert_allclose(values.flatten(), [extinction, 0, 0], atol=0.2)
    shifted, cut = total.copy(), total.copy()
    shifted[4] = np.interp(positions - 0.05, positions, total[4])
    assert LineScan(angles, positions, shifted).shifts()[4] == pytest.approx(0.05, rel=0.2)
    cut[3, :5] = 0.4
    assert 3 not in LineScan(angles, positions, cut).complete
    with refused("angles"):
        LineScan(np.where(angles == angles[3], angles[4], angles), positions, total).measurement(axis)
    with refused("positions"):
        LineScan(angles, positions**3, total)
    for call in (scan.select([0, 1, 2, 3]).without_offset(-1.0).saturation, lambda: scan.select([0, 1])):
        with refused("readings"):
            call()


SPRAY = Path(__file__).parents[2] / "shared" / "data" / "spray_absorption" / "spray_Re6700.hdf5"


@pytest.mark.slow
@pytest.mark.skipif(not SPRAY.is_file(), reason="the data of the spray are not beside the project (shared/data)")
def test_spray(tmp_path, monkeypatch, capsys):
    """Two jets of water have the density of water."""
    arguments = ["--slice", "jets", "--method", "nerif", "--steps", "20", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["spray.py", str(SPRAY), *arguments])
    example = runpy.run_path(str(EXAMPLES / "spray.py"), run_name="__main__")
    assert "axis at -0.27" in capsys.readouterr().out
    assert (tmp_path / "jets-nerif.png").stat().st_size > 20_000
    method = example["TotalVariation"](voxels=40, basis="linear", regularisation=2e-3, iterations=30, device="cpu")
    _, _, result, estimate = example["reconstruct"](example["read"](SPRAY, "jets"), example["WITHHELD"], method)
    density = result.volume(Grid.of_resolution(result.box, 50)).values / example["WATER"] * 1e3
    inside = density[density > 0.5]
    assert 0.95 < float(inside.median()) < 1.1  # mg/mm3
    assert estimate.corrected_scatter < 0.5 * estimate.scatter


@pytest.mark.slow
@pytest.mark.skipif(not SPRAY.is_file(), reason="the data of the spray are not beside the project (shared/data)")
@pytest.mark.parametrize("name", ["impingement", "jets", "near"])
def test_axis_of_a_spray_by_refinement(name):
    """The axis of rotation by refinement of the rig is that of the centres of mass."""
    example = runpy.run_path(str(EXAMPLES / "spray.py"))
    scan = example["read"](SPRAY, name)
    estimate = scan.estimate()
    axis = example["refined_axis"](scan, estimate, example["TotalVariation"](voxels=40, basis="linear", device="cpu"))
    assert abs(axis - estimate.axis) < 0.03  # mm; the readings are 0.2 to 0.4 mm apart
    assert -0.36 < axis < -0.24


JET = Path(__file__).parents[2] / "shared" / "data" / "bos_pairs"


def test_shock_cells_are_as_long_as_they_were_made():
    jet = runpy.run_path(str(EXAMPLES / "jet.py"))
    h, random = np.linspace(0, 73, 400), np.random.default_rng(0)
    signal = np.cos(2 * np.pi * h / 24.4) + 0.3 * np.sin(4 * np.pi * h / 24.4) + 0.01 * h
    spacing = jet["spacing"](h, signal + 0.2 * random.standard_normal(400), 10.0, 40.0)
    assert abs(spacing.length - 24.4) < 4 * spacing.sigma
    assert 0.01 < spacing.sigma < 0.5
    assert spacing.explained > 0.8


@pytest.mark.slow
@pytest.mark.skipif(not JET.is_dir(), reason=f"{JET.name}: the images are not there")
def test_jet(tmp_path):
    """The half that was not seen is predicted, and the shock cells are those of the displacement."""
    pair = [str(JET / "jet_reference.tif"), str(JET / "jet_flow.tif")]
    script = [sys.executable, str(EXAMPLES / "jet.py"), *pair, "--out", str(tmp_path / "jet"), "--seconds", "60"]
    done = subprocess.run(script, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    u, v = map(float, re.findall(r"right: predicted .* u ([\d.]+), v ([\d.]+)", done.stdout)[0])
    assert min(u, v) > 0.93
    lengths = [float(x) for x in re.findall(r"shock cells by .*?: ([\d.]+) \+-", done.stdout)]
    assert max(lengths) - min(lengths) < 1.0
    assert (tmp_path / "jet" / "jet.png").is_file()


def test_examples_are_all_tested():
    tested = {
        "nerif_in_one_page.py",
        "own_algorithm.py",
        "own_data.py",
        "from_images.py",
        "knocked_camera.py",
        "particles.py",
        "line_scans.py",
        "spray.py",
        "jet.py",
    }
    assert {p.name for p in EXAMPLES.glob("*.py")} == tested
