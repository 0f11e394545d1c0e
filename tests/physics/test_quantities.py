"""n, density and temperature of a volume, with their assumptions."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.common.settings import merge
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid
from nerif.physics.gas import NOT_UNIFORM, GasSettings
from nerif.physics.gas_optics import ambient_index
from nerif.physics.media import MediumChanges
from nerif.physics.medium import derive, derive_all, deviation
from refusals import refused


def flow(values: torch.Tensor, n_ambient: float = 1.00027) -> Volume:
    return Volume(values, Grid(Box.cube(20.0), values.shape), attributes={"n_ambient": n_ambient})


def test_hot_air_from_its_index():
    """Density and temperature of air at 600 K in air at 300 K."""
    cold, hot = (ambient_index("air", t, 101325.0, 532.0) for t in (300.0, 600.0))
    values = torch.zeros(2, 3, 4)
    values[1, 2, 3] = hot - cold
    excess = flow(values, cold)
    n, density, temperature = (derive(excess, q, GasSettings()) for q in ("n", "density", "temperature"))
    assert float(n.values[1, 2, 3]) == pytest.approx(hot, abs=1e-11)
    assert float(density.values[0, 0, 0]) == pytest.approx(1.177, rel=2e-3)
    assert float(density.values[0, 0, 0] / density.values[1, 2, 3]) == pytest.approx(2, rel=1e-4)
    assert float(temperature.values[0, 0, 0]) == pytest.approx(300, rel=1e-4)
    assert float(temperature.values[1, 2, 3]) == pytest.approx(600, rel=1e-4)
    assert temperature.attributes["gas"] == "air"
    assert temperature.attributes["pressure_pa"] == 101325.0
    assert density.unit == "kg m-3"
    assert derive(excess, "index_excess", GasSettings()) is excess


@pytest.mark.parametrize("phantom", ["underexpanded", "flame", "plume"])
def test_flows_with_compression_and_expansion_have_no_temperature(phantom):
    """Shock cells have densities above and below ambient; a hot flow with a field error of a tenth has not."""
    grid = Grid(Box.cube(50.0), (20, 21, 22))
    values = make_phantom(phantom, grid.box).sample(grid)
    error = torch.randn(values.shape, generator=torch.Generator().manual_seed(1)) * values.square().mean().sqrt() / 10
    excess = Volume(values + error, grid, attributes={"n_ambient": 1.00027})
    names, temperature = (
        [v.quantity for v in derive_all(excess, GasSettings())],
        derive(excess, "temperature", GasSettings()),
    )
    if phantom == "underexpanded":
        assert names == ["index_excess", "n", "density"]
        assert bool(temperature.values.isnan().all())
        assert temperature.notes["masked_where"] == NOT_UNIFORM
    else:
        assert names[-1] == "temperature"
        assert bool(temperature.values.isfinite().any())
    for uniform, last in (("yes", "temperature"), ("no", "density")):
        assert derive_all(excess, GasSettings(uniform_pressure=uniform))[-1].quantity == last


def test_uniform_pressure_follows_from_the_field_unless_stated():
    both = flow(torch.tensor([1e-5, -1e-5] * 12).reshape(2, 3, 4))
    assert GasSettings().absent(both) == {"temperature": NOT_UNIFORM}
    assert GasSettings().absent(flow(torch.full((2, 3, 4), -1e-5))) == {}
    stated = {"gas": {"uniform_pressure": "no"}}
    assert merge(MediumChanges(), {"gas.uniform_pressure": "yes"}).of(stated).uniform_pressure == "yes"
    assert MediumChanges().of(stated).uniform_pressure == "no"


BURNT = "N2:0.72, H2O:0.19, CO2:0.09"


@pytest.mark.parametrize(
    ("n_ambient", "excess", "gas", "absent", "words"),
    [
        (1.333, -1e-4, {}, "dT", "liquids and plasmas have an index only"),
        (1.36, 3e-3, {"composition": "N2"}, "dT", "is not that of N2 at 101325 Pa"),
        (0.9999, -5e-5, {}, "dT", "0.9999 is not that of air"),
        (1.0, 1e-4, {}, "dT", "is not that of air"),
        (1.0000326, 2e-5, {}, "dT", "--gas.composition"),  # helium around
        (1.0000326, 5e-6, {"composition": "He"}, "", ""),
        (1.0007, -1e-4, {}, "dT", "--gas.composition"),  # sulphur hexafluoride around
        (1.00135, -1e-4, {}, "dT", "--gas.pressure-pa"),  # air at 5 bar
        (1.00135, -1e-4, {"pressure_pa": 5e5}, "", ""),
        (1.00027, -2.37e-4, {}, "T", "hotter than 2300 K"),  # helium in air
        (1.00027, -2.9e-4, {"composition": BURNT}, "T", "hotter than 4000 K"),
        (1.00027, -2.37e-4, {"composition": BURNT}, "", ""),  # hot products
        (1.00027, -2.37e-4, {"uniform_pressure": "yes"}, "", "helium or fuel"),
        (1.00027, -2.37e-4, {"uniform_pressure": "no"}, "T", "not uniform"),
        (1.00027, -2.2e-4, {}, "", "helium or fuel"),  # a flame, or a diluted jet of helium
        (1.00027, 4.3e-4, {}, "T", "colder than 200 K"),  # sulphur hexafluoride in air
        (1.00027, -1e-4, {}, "", ""),
    ],
)
def test_quantities_of_another_medium_are_left_out_with_the_reason(n_ambient, excess, gas, absent, words):
    """A core within a thin edge, of some per cent of the box."""
    grid = Grid(Box.cube(20.0), (20, 21, 22))
    radius = grid.points(torch.float64).square().sum(dim=-1).sqrt()
    volume = Volume(excess * torch.sigmoid(3 * (5.0 - radius)), grid, attributes={"n_ambient": n_ambient})
    settings = GasSettings(**gas)
    left_out = {name for name, letter in (("density", "d"), ("temperature", "T")) if letter in absent}
    written = {v.quantity for v in derive_all(volume, settings)}
    assert written == {"index_excess", "n", "density", "temperature"} - left_out
    assert bool(derive(volume, "density", settings).values.isnan().all()) == ("d" in absent)
    lines = settings.remarks(volume)
    assert len(lines) == bool(words)
    assert words in " ".join(lines)
    assert bool(lines and "not computed" in lines[0]) == bool(absent)


def test_invalid_quantities_and_gases_are_refused():
    excess = flow(torch.zeros(2, 3, 4))
    with refused("quantity"):
        derive(excess, "pressure", GasSettings())
    with refused("composition"):
        derive(excess, "density", GasSettings("phlogiston"))
    for pressure in (-1, float("inf")):
        with refused("pressure_pa"):
            GasSettings(pressure_pa=pressure)


@pytest.mark.parametrize("quantity", ["index_excess", "n", "density", "temperature"])
def test_standard_deviations_are_first_order_changes(quantity):
    values = torch.linspace(-2.9e-4, 2e-4, 24, dtype=torch.float64).reshape(2, 3, 4)
    excess, step = flow(values), torch.full_like(values, 1e-9)
    above, below, middle = (
        derive(replace(excess, values=values + k * step), quantity, GasSettings()).values.double()
        for k in (100, -100, 0)
    )
    std = deviation(excess, step, quantity, GasSettings())
    assert torch.equal(std.isnan(), middle.isnan())
    torch.testing.assert_close(std, (above - below).abs() / 200, rtol=1e-2, atol=0, equal_nan=True)
    large = deviation(excess, 3e5 * step, quantity, GasSettings())
    torch.testing.assert_close(large, 3e5 * std, rtol=1e-9, atol=0, equal_nan=True)
