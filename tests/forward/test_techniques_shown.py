"""Report, figures, notebooks and files have the names, units, colours and quantities of each technique."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerif.analysis.consistency import everywhere, image_remarks, of_one_view
from nerif.analysis.evaluation import score_lines
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.data.quantity_names import INDEX, field_of
from nerif.data.volume import Volume, write_netcdf
from nerif.data.volume_file import read_volume
from nerif.forward.absorption import Absorption
from nerif.geometry import Box, Grid
from nerif.physics.gas import GasSettings
from nerif.plotting import drawing
from nerif.report import packing
from nerif.report.journal_figures import error_of, figures_of, view
from nerif.report.result_plots import residuals_over_sigma
from nerif.report.view_images import view_images
from nerif.results.directory import ResultDirectory
from nerif.workflow.sequence.plan import SequenceSettings
from refusals import refused

RIG = ["--image-size", "14", "17", "--pixel-pitch", "0.26", "--views", "3", "--steps", "20", "--truth-voxels", "8"]
QUICK = ["--method", "tikhonov", "--voxels", "8", "--iterations", "5", "--regularisation", "1e-4"]


def simulated(folder: Path, *techniques: str) -> Path:
    path = folder / f"{'_'.join(techniques)}.nc"
    words = ["--phantom", "gaussians", "--noise", "0.05", "-o", str(path), *RIG]
    assert main(["simulate", "--technique", *techniques, *words]) == 0
    return path


def reconstructed(path: Path) -> Path:
    out = path.with_suffix("")
    assert main(["reconstruct", str(path), "-o", str(out), "--withhold", "85deg", "--no-report", *QUICK]) == 0
    assert main(["evaluate", str(out), "--truth", str(path.with_name(f"{path.stem}.truth.nc"))]) == 0
    assert main(["report", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def absorption(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small result of absorption."""
    return reconstructed(simulated(tmp_path_factory.mktemp("absorption"), "absorption"))


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small result of deflection and interferometry together."""
    return reconstructed(simulated(tmp_path_factory.mktemp("both"), "deflection", "interferometry"))


def words_of(page: Path) -> str:
    """What is written on a page, without its scripts, styles and tags."""
    text = re.sub(r"<(script|style)\b.*?</\1>", "", page.read_text(), flags=re.DOTALL)
    return re.sub(r"<[^>]*>", " ", text)


def test_the_report_of_absorption_speaks_of_nothing_else(absorption):
    words, _, settings = words_of(absorption / "report.html").partition("Settings and versions")
    assert "gas." not in settings
    for expected in ("Absorption tomography", "Extinction coefficient", "mm⁻¹", "absorbance", "withheld"):
        assert expected in words, expected
    for strange in ("isplacement", " px =", "n − 1", "Density", "Temperature", "mbient", "ackground", "NaN"):
        assert strange not in words, strange


def test_the_report_of_two_techniques_shows_both(both):
    words = words_of(both / "report.html")
    assert "Background-oriented schlieren tomography and interferometric tomography" in words
    for expected in ("displacement in px and fringes", "Withheld view, displacement", "Withheld view, fringes",
                     "Residuals of displacement over the noise", "Residuals of fringes", "n − 1",
                     "cameras and backgrounds"):  # fmt: skip
        assert expected in words, expected
    metrics = json.loads((both / "metrics.json").read_text())
    first, *_, last = (" ".join(line.split(":")[0].split()[1:]) for line in score_lines(metrics["views"]))
    assert (first, last) == ("fitted views, displacement", "withheld view, fringes")


def test_views_have_a_row_for_each_component_and_colours_for_what_it_measures(absorption, both):
    reprojections = [ResultDirectory(out).read().reprojection for out in (absorption, both)]
    assert reprojections[0] is not None
    assert reprojections[1] is not None
    views, [scale] = view_images(reprojections[0], [])
    assert [*views[0].rows] == ["absorbance"]
    assert scale.limits[0] == 0 < scale.limits[1]
    assert scale.difference_limits[0] == -scale.difference_limits[1]
    views, [pixels, fringes] = view_images(reprojections[1], [])
    assert [*views[0].rows] == ["u", "v", "fringes"]
    assert (pixels.unit, fringes.unit) == ("px", "")
    assert fringes.limits[0] == -fringes.limits[1]
    assert drawing.map_colours(scale.limits) != drawing.map_colours(fringes.limits)
    assert [*residuals_over_sigma(reprojections[1])] == ["displacement", "fringes"]


def test_figures_have_the_labels_and_units_of_the_technique(absorption, monkeypatch):
    result = ResultDirectory(absorption).read()
    assert error_of(result) is not None
    labels = {}
    for name, figure in figures_of(result, 90, 190):
        labels[name] = " ".join(a.get_ylabel() + a.get_xlabel() + a.get_title() for a in figure.axes)
    assert {"slices_extinction", "comparison", "isosurface_extinction", "residuals", "rig"} <= set(labels)
    assert "extinction coefficient [mm⁻¹]" in labels["slices_extinction"]
    assert "error of extinction coefficient [mm⁻¹]" in labels["comparison"]
    assert "absorbance [1]" in labels["view_0deg"]
    assert not any("displacement" in text or "kg" in text for text in labels.values())
    monkeypatch.setattr(Absorption, "unit", "dB")
    assert "residual [dB]" in [axes.get_ylabel() for axes in view(result.reprojection, 0, 190).axes]


def test_files_name_their_field(absorption, both, tmp_path, capsys):
    volume = read_volume(absorption / "volume.nc")
    assert (volume.quantity, volume.unit) == ("extinction", "mm-1")
    assert volume.attributes["title"] == "Field of extinction coefficient"
    assert not {"n_ambient", "gas", "wavelength_nm", "pressure_pa"} & set(volume.attributes)
    assert "gas" not in (absorption / "run.toml").read_text()
    assert read_volume(both / "volume.nc").attributes["title"] == "Field of refractive index"
    capsys.readouterr()
    assert main(["export", str(absorption), "-o", str(tmp_path / "a.vti"), "--voxels", "6"]) == 0
    assert "extinction on 6 x 6 x 6" in capsys.readouterr().out
    assert main(["export", str(absorption), "-o", str(tmp_path / "b.nc"), "--quantities", "density"]) == 2
    assert "expected one of extinction, got 'density'" in capsys.readouterr().err
    assert main(["info", str(absorption)]) == 0
    output = capsys.readouterr().out
    assert "reconstruction of extinction coefficient" in output
    assert "n_ambient" not in output
    # the field is recognised among its statistics
    write_netcdf(tmp_path / "e.nc", [replace(volume, quantity=f"extinction{ending}") for ending in ("", "_std")])
    assert read_volume(tmp_path / "e.nc").quantity == "extinction"
    assert field_of(["density", "temperature"]) is None
    relation = packing.relation("extinction", {})  # packed unchanged
    assert (relation["offset"], relation["factor"], relation["lower"], relation["upper"]) == (0, 1, None, None)
    grid = Grid(Box.cube(4.0), (2, 3, 4))  # only an index has an ambient
    assert Volume.of(torch.zeros(grid.shape), grid, "emission", 1.00027).attributes == {}
    assert Volume.of(torch.zeros(grid.shape), grid, INDEX, 1.00027).n_ambient == 1.00027


@pytest.mark.slow
def test_notebooks_show_each_technique(both, absorption):
    combined, alone = (Measurement.read(p.with_suffix(".nc"))._repr_html_() for p in (both, absorption))
    assert "Displacement u and v of each view, in px" in combined
    assert "Fringes of each view" in combined
    assert "Absorbance of each view" in alone
    assert "Ambient" not in alone
    assert "mm⁻¹" in read_volume(absorption / "volume.nc")._repr_html_()


def test_mistakes_considered_are_those_that_a_technique_can_have(both, absorption):
    combined, alone = (Measurement.read(p.with_suffix(".nc")) for p in (both, absorption))
    pairs = [(o, m.cameras) for m in (combined, alone) for o in m.observations]
    texts = [[c.words for c in of_one_view(0, o, cameras)] for o, cameras in pairs]
    assert "u and v are swapped" in texts[0]
    assert texts[1] == [*texts[2], "the sign is flipped"]
    assert not any("u" in words.split() for words in texts[2])
    assert len(everywhere(alone.observations[0], alone.cameras)) == 2
    values = combined.observations[1].values
    for correction in of_one_view(1, combined.observations[1], combined.cameras):
        changed = correction.undo(values, combined.cameras)
        assert not torch.equal(changed[1], values[1])
        assert torch.equal(correction.undo(changed, combined.cameras).nan_to_num(), values.nan_to_num())


def test_an_observation_alone_is_a_measurement_of_its_views(both):
    combined = Measurement.read(both.with_suffix(".nc"))
    fringes = combined.maps["fringes"].clone()
    fringes[0] = torch.nan
    fewer = replace(combined, maps={**combined.maps, "fringes": fringes})
    alone = fewer.observations[1].alone(fewer)
    assert alone.names == combined.names[1:]
    assert alone.displacement is None
    assert all(c.background is None for c in alone.cameras)
    assert fewer.observations[0].alone(fewer).names == combined.names


def test_an_offset_of_the_background_is_reported(absorption):
    alone = Measurement.read(absorption.with_suffix(".nc"))
    shifted = replace(alone, maps={**alone.maps, "absorbance": alone.maps["absorbance"] + 0.4})
    first = image_remarks(shifted, shifted, [1.0] * 3)[0]
    assert "absorbance at the border 0." in first
    assert "subtract it as the offset of the background" in first
    assert image_remarks(alone, alone, [1.0] * 3) == []


@pytest.mark.slow
def test_check_names_the_view_whose_sign_is_flipped(tmp_path, capsys):
    path = tmp_path / "fringes.nc"
    words = ["--phantom", "gaussians", "--noise", "0.05", "--seed", "1", "-o", str(path), *RIG]
    assert main(["simulate", "--technique", "interferometry", *words]) == 0
    clean = Measurement.read(path)
    fringes = clean.maps["fringes"].clone()
    fringes[1] *= -1
    replace(clean, maps={**clean.maps, "fringes": fringes}).write(path)
    assert main(["check", str(path), "--voxels", "10", "--strict"]) == 1
    assert "FOUND: view 85deg: the sign is flipped" in capsys.readouterr().out


def test_quantities_of_a_sequence_follow_from_the_measurement(both, absorption):
    combined, alone = (Measurement.read(p.with_suffix(".nc")) for p in (both, absorption))
    assert SequenceSettings().for_measurement(combined).quantities == (INDEX, "density")
    assert SequenceSettings().for_measurement(alone).quantities == ("extinction",)
    with refused("quantities"):
        SequenceSettings(quantities=("density",), gas=GasSettings()).for_measurement(alone)
    water = replace(combined, n_ambient=1.333)
    assert SequenceSettings().for_measurement(water).quantities == (INDEX,)
    with refused("quantities"):
        SequenceSettings(quantities=("temperature",)).for_measurement(water)


def test_maps_that_cannot_be_negative_begin_at_zero():
    values = np.array([-0.1, 0.5, np.nan, 2.0])
    assert drawing.map_range(values, signed=False) == (0.0, 2.0)
    assert drawing.map_range(values, signed=True) == (-2.0, 2.0)
    assert drawing.map_range(np.array([np.nan]), signed=True) == (-1.0, 1.0)
