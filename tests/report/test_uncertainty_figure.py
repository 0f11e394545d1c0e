"""Bands about lines through the field, and the reliability diagram."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from nerif.report.uncertainty_figure import WIDE, banded, draw_bands, draw_reliability

from nerif.analysis.metrics import LEVELS, coverage
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid

GRID = Grid(Box((-4.0, -3.0, -2.0), (4.0, 3.0, 2.0)), (4, 6, 8))


def volumes() -> dict[str, Volume]:
    values = torch.arange(4 * 6 * 8, dtype=torch.float32).reshape(GRID.shape)
    density = Volume(values, GRID, "density")
    hot = Volume(300 + values, GRID, "temperature")
    found = [density, replace(density, quantity="density_std", values=torch.full(GRID.shape, 2.0)), hot,
             replace(hot, quantity="temperature_std", values=torch.full(GRID.shape, 5.0)),
             replace(hot, quantity="temperature_p05", values=hot.values - 7),
             replace(hot, quantity="temperature_p95", values=hot.values + 11)]  # fmt: skip
    return {v.quantity: v for v in found}


@pytest.mark.parametrize(("quantity", "below", "above"), [("density", 2 * WIDE, 2 * WIDE), ("temperature", 7, 11)])
def test_bands_are_those_of_the_percentiles_else_of_the_deviation(quantity, below, above):
    found = volumes()
    assert banded(found) == ["density", "temperature"]
    axes = draw_bands(Figure().subplots(), found, quantity)
    lines, bands = axes.get_lines(), axes.collections
    assert [line.get_label() for line in lines] == ["along x", "along y", "along z"]
    np.testing.assert_allclose(lines[0].get_xdata(), np.arange(-3.5, 4))
    np.testing.assert_allclose(lines[0].get_ydata(), found[quantity].values[2, 3].numpy())
    low, high = bands[0].get_paths()[0].get_extents().y0, bands[0].get_paths()[0].get_extents().y1
    assert low == pytest.approx(float(found[quantity].values[2, 3].min()) - below, rel=1e-5)
    assert high == pytest.approx(float(found[quantity].values[2, 3].max()) + above, rel=1e-5)


def test_errors_as_large_as_stated_lie_on_the_diagonal_and_others_do_not():
    drawn = np.random.default_rng(0)
    std = drawn.uniform(0.5, 2.0, 40000)
    flow = np.ones(std.shape, dtype=bool)
    flow[::2] = False
    found = coverage(std * drawn.standard_normal(std.shape), std, flow)
    np.testing.assert_allclose(found["reliability"], LEVELS, atol=0.02)
    assert found["share"] == pytest.approx(0.954, abs=0.005)
    assert found["share_in_one_in_flow"] == pytest.approx(0.683, abs=0.01)
    assert 0.2 < found["spearman"] < 0.6
    line = draw_reliability(Figure().subplots(), found).get_lines()[1]
    np.testing.assert_allclose(line.get_ydata(), found["reliability"])
    small = coverage(2 * std * drawn.standard_normal(std.shape), std, flow)
    assert small["share_in_flow"] == pytest.approx(0.683, abs=0.02)
