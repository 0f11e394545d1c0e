"""A field belongs to techniques of its quantity: commands that take both refuse others."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerif.analysis.consistency import binned, open_faces
from nerif.analysis.evaluation import evaluate
from nerif.analysis.gains import fit_gains, with_gains
from nerif.analysis.prediction import predict
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import GaussianBalls
from nerif.forward.absorption import Absorption
from nerif.forward.emission import Emission
from nerif.geometry import Box, Ring
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import REPROJECTION, ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.simulation.simulation import Simulation
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings
from refusals import refused

RING = Ring(views=4, image_size=(14, 17), pixel_pitch=0.26)
QUICK = Tikhonov(voxels=8, basis="linear", iterations=5, regularisation=1e-3, device="cpu")


def simulated(folder: Path, name: str) -> Path:
    measurement, _ = Simulation("gaussians", (name,), noise=0.05, steps=20, truth_voxels=8)(RING.cameras())
    measurement.write(folder / f"{name}.nc")
    return folder / f"{name}.nc"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Measurements by technique, each with a result beside it of the same name; that of deflection by curved rays."""
    folder = tmp_path_factory.mktemp("techniques")
    measurements = {name: simulated(folder, name) for name in ("deflection", "emission", "interferometry")}
    for name in ("deflection", "emission"):
        reconstruct_into(folder / name, measurements[name], QUICK, RunSettings(report=False))
    return measurements


def test_fields_of_another_quantity_are_refused(files, tmp_path, capsys):
    """When a result is scored, projected, or the start of a reconstruction."""
    results = {name: path.with_suffix("") for name, path in files.items()}
    before = (results["emission"] / REPROJECTION).read_bytes()
    message = r"deflection.nc: expected a technique .* the field of radiance per length \(emission\), got deflec"
    with pytest.raises(InputError, match=message):
        evaluate(results["emission"], measurement=files["deflection"])
    assert (results["emission"] / REPROJECTION).read_bytes() == before
    out = tmp_path / "p.nc"
    assert main(["project", str(results["deflection"]), "-o", str(out), "--technique", "absorption"]) == 2
    error = capsys.readouterr().err
    assert "technique: expected a technique" in error
    assert "the field of refractive index (deflection, interfero" in error
    assert not out.exists()
    field, box, n_ambient = ResultDirectory(results["deflection"]).field()
    with refused("technique"):
        predict(field, RING.cameras(), box, n_ambient, technique=Absorption, quantity="index_excess")
    run = RunSettings(start_from=results["deflection"], report=False)
    with pytest.raises(InputError, match=r"start_from .*deflection: expected a technique .*, got emission"):
        reconstruct_into(tmp_path / "r", files["emission"], QUICK, run)
    assert not (tmp_path / "r").exists()


def test_settings_of_another_technique_do_not_apply(files, tmp_path, monkeypatch):
    """The model of the run stays with its technique, and the wavelength comes with the cameras of a file."""
    result, out = files["deflection"].with_suffix(""), tmp_path / "p.nc"
    original = ResultDirectory.settings
    monkeypatch.setattr(ResultDirectory, "settings", lambda self: {**original(self), "model": "curved"})
    words = ["project", str(result), "-o", str(out), "--technique", "interferometry", "--force"]
    assert main([*words, "--wavelength-nm", "532"]) == 0
    assert main([*words, "--cameras", str(files["interferometry"])]) == 0
    assert Measurement.read(out).wavelength_nm == Measurement.read(files["interferometry"]).wavelength_nm
    assert main([*words, "--cameras", str(files["interferometry"]), "--model", "curved"]) == 2


# -- gains of cameras ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_gains_are_part_of_the_result(files, tmp_path):
    """Scores and views evaluated again from the same file are those of the run."""
    even = Measurement.read(files["emission"])
    gains = dict(zip(even.names, (0.5, 1.6, 1.0, 1.25), strict=True))
    uneven = tmp_path / "uneven.nc"
    with_gains(even, {name: 1 / gain for name, gain in gains.items()}).write(uneven)
    out = ResultDirectory(tmp_path / "r")
    reconstruct_into(out.path, uneven, QUICK, RunSettings(fit_gains=True, report=False))
    about = tomllib.loads((out / "run.toml").read_text())["about"]
    assert about["gains"] == pytest.approx(fit_gains(Measurement.read(uneven)), rel=1e-6)
    before, views = out.metrics().views, out.reprojection()
    evaluate(out.path, measurement=uneven)
    after = out.metrics().views
    assert [v["rms"] for v in after] == pytest.approx([v["rms"] for v in before], rel=1e-5)
    torch.testing.assert_close(out.reprojection().measurement.maps["radiance"], views.measurement.maps["radiance"])
    settings = {k: v for k, v in out.settings().items() if k != "about"}
    out.write_settings(settings, {"gains": {"0deg": 0}})
    with refused("gains of run.toml"):
        evaluate(out.path, measurement=uneven)
    out.write_settings(settings)  # without them the views are not those that were fitted
    evaluate(out.path, measurement=uneven)
    assert out.metrics().views[0]["rms"] > 1.5 * before[0]["rms"]


@pytest.mark.parametrize("left", [0.0, 1e-3])
def test_a_dark_view_is_refused(files, left):
    even = Measurement.read(files["emission"])
    radiance = even.maps["radiance"].clone()
    radiance[2] *= left
    with refused("fit_gains"):
        fit_gains(replace(even, maps={"radiance": radiance}))


# -- commands ------------------------------------------------------------------------------------------------------


def test_technique_and_peak_of_a_simulation_and_units_of_info(files, tmp_path, capsys):
    assert main(["simulate", "--technique", "-o", str(tmp_path / "m.nc")]) == 2
    assert "technique: expected one or more of deflection" in capsys.readouterr().err
    for name, head in (("deflection", "rms displacement [px]"), ("emission", "rms radiance [1]")):
        assert main(["info", str(files[name])]) == 0
        assert head in capsys.readouterr().out
    with refused("peak"):
        Simulation(peak=0.1)
    with refused("peak"):
        Simulation("mine.nc", ("emission",), peak=0.1)
    measurement, truth = Simulation("gaussians", ("emission",), peak=0.1, steps=10, truth_voxels=16)(RING.cameras())
    assert 0.05 < float(truth.values.max()) <= 0.1
    assert float(measurement.maps["radiance"].nan_to_num().max()) > 0


def test_flow_that_leaves_through_a_face_is_reported_without_a_gauge():
    """The default faces of a file are no gauge of an emission: it may leave through them."""
    wide, box = Box((-25.0, -10.0, -10.0), (15.0, 10.0, 10.0)), Box((-5.0, -10.0, -10.0), (15.0, 10.0, 10.0))
    inside, outside = torch.tensor([[6.0, 1.0, 1.0]]), torch.tensor([[-8.0, 0.0, 0.0]])
    ball = GaussianBalls(inside, torch.tensor([2.0]), torch.tensor([0.1]))
    both = GaussianBalls(torch.cat([inside, outside]), torch.tensor([2.0, 2.0]), torch.tensor([0.1, 0.1]))
    cameras = Ring(views=6, arc=(0.0, 150.0), image_size=(20, 36), pixel_pitch=0.16).cameras()
    small = replace(simulate(both, cameras, wide, 1.00027, steps=30, techniques=[Emission]), box=box)
    assert "x-" in small.ambient_faces
    [finding] = open_faces(ball, small)
    assert finding.code == "open_face"
    assert "x-" in finding.sentence
    assert open_faces(both, replace(small, box=wide)) == []


def test_negative_noise_is_no_mistake_in_a_check():
    """Most pixels of a view may be noise about 0; binned images have no sigma."""
    simulation = Simulation("flame", ("emission",), noise=0.3, steps=10, truth_voxels=8)
    measurement, _ = simulation(replace(RING, image_size=(36, 37), pixel_pitch=0.11).cameras())
    assert float(measurement.maps["radiance"].min()) < 0
    assert float(binned(measurement, 48).maps["radiance"].min()) == 0
