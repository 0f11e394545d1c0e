"""n, density and temperature of a volume, and the assumptions written beside them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid
from nerif.physics.gas_optics import ambient_index
from nerif.physics.quantities import NOT_UNIFORM, GasChanges, GasSettings, derive, derive_all, deviation
from refusals import refused


def test_hot_air_from_its_index():
    """Air at 600 K in air at 300 K: back from the index to density and temperature."""
    cold, hot = (ambient_index("air", t, 101325.0, 532.0) for t in (300.0, 600.0))
    excess = torch.zeros(2, 3, 4)
    excess[1, 2, 3] = hot - cold
    volume = Volume(excess, Grid(Box.cube(4.0), (2, 3, 4)), attributes={"n_ambient": cold})
    n, density, temperature = (derive(volume, q, GasSettings()) for q in ("n", "density", "temperature"))
    assert float(n.values[1, 2, 3]) == pytest.approx(hot, abs=1e-11)
    assert float(density.values[0, 0, 0]) == pytest.approx(1.177, rel=2e-3)
    assert float(density.values[0, 0, 0] / density.values[1, 2, 3]) == pytest.approx(2, rel=1e-4)
    assert float(temperature.values[0, 0, 0]) == pytest.approx(300, rel=1e-4)
    assert float(temperature.values[1, 2, 3]) == pytest.approx(600, rel=1e-4)
    assert temperature.attributes["gas"] == "air"
    assert temperature.attributes["pressure_pa"] == 101325.0
    assert density.unit == "kg m-3"
    assert derive(volume, "index_excess", GasSettings()) is volume


def flow(values: torch.Tensor) -> Volume:
    return Volume(values, Grid(Box.cube(20.0), values.shape), attributes={"n_ambient": 1.00027})


@pytest.mark.parametrize("phantom", ["underexpanded", "flame", "plume"])
def test_no_temperature_of_a_flow_with_compression_and_expansion(phantom):
    """A shock-cell jet has density above and below ambient; a hot flow has not, even with a field error of a tenth."""
    grid = Grid(Box.cube(50.0), (20, 21, 22))
    values = make_phantom(phantom, grid.box).sample(grid)
    error = torch.randn(values.shape, generator=torch.Generator().manual_seed(1)) * values.square().mean().sqrt() / 10
    excess = Volume(values + error, grid, attributes={"n_ambient": 1.00027})
    names = [v.quantity for v in derive_all(excess, GasSettings())]
    temperature = derive(excess, "temperature", GasSettings())
    if phantom == "underexpanded":
        assert names == ["index_excess", "n", "density"]
        assert bool(temperature.values.isnan().all())
        assert temperature.notes["masked_where"] == NOT_UNIFORM
    else:
        assert names[-1] == "temperature"
        assert bool(temperature.values.isfinite().any())
    assert derive_all(excess, GasSettings(uniform_pressure="yes"))[-1].quantity == "temperature"
    assert derive_all(excess, GasSettings(uniform_pressure="no"))[-1].quantity == "density"


def test_a_flow_is_judged_once_for_all_its_repetitions():
    both = flow(torch.tensor([1e-5, -1e-5] * 12).reshape(2, 3, 4))
    assert GasSettings().for_field(both).uniform_pressure == "no"
    assert GasSettings().for_field(flow(torch.full((2, 3, 4), -1e-5))).uniform_pressure == "yes"
    assert GasChanges(uniform_pressure="yes").of({"gas": {"uniform_pressure": "no"}}).uniform_pressure == "yes"
    assert GasChanges().of({"gas": {"uniform_pressure": "no"}}).uniform_pressure == "no"


def test_refusals():
    volume = Volume(torch.zeros(2, 3, 4), Grid(Box.cube(4.0), (2, 3, 4)), attributes={"n_ambient": 1.00027})
    with refused("quantity"):
        derive(volume, "pressure", GasSettings())
    with refused("composition"):
        derive(volume, "density", GasSettings("phlogiston"))
    with refused("pressure_pa"):
        GasSettings(pressure_pa=-1)
    with refused("pressure_pa"):
        GasSettings(pressure_pa=float("inf"))


@pytest.mark.parametrize("quantity", ["index_excess", "n", "density", "temperature"])
def test_standard_deviations_are_those_of_the_index_to_first_order(quantity):
    """A small change of the index is the change of each quantity; a large one masks none of what is known."""
    excess = torch.linspace(-2.9e-4, 2e-4, 24, dtype=torch.float64).reshape(2, 3, 4)
    volume = Volume(excess, Grid(Box.cube(4.0), (2, 3, 4)), attributes={"n_ambient": 1.00027})
    step = torch.full_like(excess, 1e-9)
    above, below, middle = (
        derive(replace(volume, values=excess + move * step), quantity, GasSettings()).values.double()
        for move in (100, -100, 0)
    )
    found = deviation(volume, step, quantity, GasSettings())
    assert torch.equal(found.isnan(), middle.isnan())
    torch.testing.assert_close(found, (above - below).abs() / 200, rtol=1e-2, atol=0, equal_nan=True)
    large = deviation(volume, 3e5 * step, quantity, GasSettings())
    torch.testing.assert_close(large, 3e5 * found, rtol=1e-9, atol=0, equal_nan=True)
