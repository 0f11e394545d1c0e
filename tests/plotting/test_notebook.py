"""Notebook display of measurements, volumes and results; names under `nerif`, loaded when first used."""

from __future__ import annotations

import base64
import io
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import nerif
from nerif.cli.cli import main
from nerif.common.conventions import percent, with_unit
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.field import Field
from nerif.geometry import Box, Grid
from nerif.plotting.notebook import VIEWS, number, panel, show_views
from nerif.reconstruction.reconstructor import Outcome
from nerif.reconstruction.voxels.tikhonov import Tikhonov


@pytest.mark.parametrize(
    ("share", "digits", "text"),
    [(0.0, 1, "0.0%"), (1e-9, 1, "under 0.1%"), (4e-4, 1, "under 0.1%"), (6e-4, 1, "0.1%"), (3e-5, 2, "under 0.01%"),
     (0.004, 0, "under 1%"), (0.33, 0, "33%"), (1.0, 2, "100.00%")],
)  # fmt: skip
def test_a_small_share_is_not_none(share, digits, text):
    assert percent(share, digits) == text


@pytest.mark.parametrize(("unit", "text"), [("grey value", "2510 grey values"), ("1", "2510"), ("px", "2510 px")])
def test_units_as_printed(unit, text):
    assert with_unit(2510, unit) == text


@pytest.mark.parametrize(
    ("reason", "sentence"),
    [("steps", "5 done"), ("converged", "converged: 5 done"), ("collapsed", "no field found: 5 done")],
)
def test_why_a_run_ended_is_said_once(reason, sentence):
    assert Outcome(reason, "5 done").sentence == sentence


def test_one_rms_is_of_rays_that_cross_the_box(measurement, tmp_path, capsys):
    half = replace(measurement, box=Box(measurement.box.lower, measurement.box.centre))
    half.write(tmp_path / "m.nc")
    _, values, _ = half.rays()
    rms = float(values.double().square().mean().sqrt())
    assert dict(half.summary())["Displacement"].startswith(f"rms {number(rms, 3)} px")
    assert main(["info", str(tmp_path / "m.nc")]) == 0
    assert f"rms displacement {rms:.4g} px" in capsys.readouterr().out


@pytest.mark.parametrize("name", nerif.__all__)
def test_every_name_is_there_and_at_home(name):
    member = getattr(nerif, name)
    assert name in dir(nerif)
    assert member is getattr(sys.modules[member.__module__], name)


def test_names_are_loaded_when_first_used():
    code = "import sys, nerif; heavy = {'torch', 'numpy'} & {*sys.modules}; print(len(heavy), nerif.Box.cube(2.0))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("0 Box(")


def test_a_name_that_is_not_there_is_refused():
    with pytest.raises(AttributeError, match="measurment"):
        _ = nerif.measurment


class Panel(HTMLParser):
    """The one image and the cells of what a notebook shows; every tag must be closed in turn."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.cells: list[str] = []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            self.images.append(dict(attributes))
        else:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] in (["th"], ["td"]):
            self.cells.append(data)

    @property
    def pixels(self) -> np.ndarray:
        [image] = self.images
        assert image["alt"]
        kind, _, data = str(image["src"]).partition(",")
        assert kind == "data:image/png;base64"
        return np.asarray(iio.imread(io.BytesIO(base64.b64decode(data))))[..., :3].astype(int)


def coloured(pixels: np.ndarray) -> float:
    """Share of the pixels that are neither white, black nor grey."""
    return float((np.ptp(pixels, axis=-1) > 30).mean())


def test_a_measurement_shows_its_views(measurement: Measurement):
    view = Panel(measurement._repr_html_())
    cells = " | ".join(view.cells)
    for words in ("Views | 5, 28 × 22 px", "Displacement | rms", "Noise σ | rms", "24 × 20 × 16 mm", "1.00027"):
        assert words in cells
    assert coloured(view.pixels) > 0.02
    still = replace(measurement, displacement=torch.zeros_like(measurement.displacement))
    assert coloured(Panel(still._repr_html_()).pixels) < 0.7 * coloured(view.pixels)


def test_of_many_views_some_are_drawn():
    maps = [np.random.default_rng(i).normal(size=(9, 30, 2)).astype(np.float32) for i in range(VIEWS + 5)]
    names = [f"c{i}" for i in range(len(maps))]
    pixels = Panel(panel("many", [], (show_views(names, maps, ("u", "v"), "d [px]"), "views"))).pixels
    assert pixels.shape[1] < 1200


def test_names_cannot_break_the_page():
    assert Panel(panel("<b>", [("a<script>", "1 & 2")], ("data:,", 'the "thing"'))).cells == ["a<script>", "1 & 2"]


def test_a_volume_shows_its_slices(ball: Field, box: Box):
    grid = Grid.of_resolution(box, 24)
    view = Panel(Volume(ball.sample(grid), grid, attributes={"n_ambient": 1.00027})._repr_html_())
    assert "24 × 20 × 16 (x, y, z)" in view.cells
    assert "× 10⁻⁴" in view.cells[view.cells.index("Index excess") + 1]
    assert coloured(view.pixels) > 0.1
    masked = torch.full(grid.shape, torch.nan)
    masked[2:] = 300.0
    cells = Panel(Volume(masked, grid, "temperature", "K")._repr_html_()).cells
    assert cells[cells.index("Temperature") + 1] == "300 to 300 K (0.1 to 99.9 % of the voxels); 12.50% masked"


def test_a_reconstruction_shows_its_field_and_why_it_stopped(measurement: Measurement):
    settings: dict[str, Any] = {"voxels": 10, "regularisation": 0.01}
    result = Tikhonov(**settings)(measurement)
    view = Panel(result._repr_html_())
    assert view.cells[view.cells.index("Why it ended") + 1] == result.outcome.sentence
    misfit = view.cells[view.cells.index("Misfit") + 1]
    assert float(misfit.split()[0]) == pytest.approx(result.history[-1]["residual_over_sigma"], rel=0.01)
    assert "times the noise" in misfit
    assert " s on cpu" in view.cells[view.cells.index("Time") + 1]
    assert coloured(view.pixels) > 0.1
