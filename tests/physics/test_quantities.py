"""n, density and temperature of a volume, and the assumptions written beside them."""

from __future__ import annotations

import pytest
import torch

from nerif.conventions import InputError
from nerif.geometry import Box, Grid
from nerif.physics.gas_optics import ambient_index
from nerif.physics.quantities import GasSettings, derive
from nerif.volume import Volume


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


def test_refusals():
    volume = Volume(torch.zeros(2, 3, 4), Grid(Box.cube(4.0), (2, 3, 4)), attributes={"n_ambient": 1.00027})
    with pytest.raises(InputError, match="quantity"):
        derive(volume, "pressure", GasSettings())
    with pytest.raises(InputError, match="phlogiston"):
        derive(volume, "density", GasSettings("phlogiston"))
    with pytest.raises(InputError, match="pressure_pa"):
        GasSettings(pressure_pa=-1)
    with pytest.raises(InputError, match="pressure_pa"):
        GasSettings(pressure_pa=float("inf"))
