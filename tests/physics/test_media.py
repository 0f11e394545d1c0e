"""Media against published values, closed relations and round trips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from commands import run
from nerif.common.conventions import InputError
from nerif.common.settings import merge
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volumes
from nerif.geometry import Box, Grid
from nerif.physics.gas import GasSettings
from nerif.physics.gas_optics import ambient_index, gladstone_dale, molar_mass
from nerif.physics.isentropic import IsentropicSettings
from nerif.physics.media import MEDIA, MediumChanges, MediumSettings, stored_medium
from nerif.physics.medium import Medium, derive, derive_all, deviation
from nerif.physics.mixture import MixtureSettings
from nerif.physics.plasma import PlasmaSettings, critical_density
from nerif.physics.shock import shock_angle
from nerif.physics.table import TableSettings
from nerif.physics.two_wavelengths import gas_and_electrons, two_gases
from nerif.physics.water import WaterSettings, fresh_water_index, seawater_index, water_density
from nerif.results.directory import ResultDirectory

GRID = Grid(Box((-1, -1, -1), (1, 1, 1)), (2, 3, 4))
N_AIR = 1.00027


def volume(excess: object, n_ambient: float) -> Volume:
    values = torch.as_tensor(excess, dtype=torch.float64).reshape(-1)
    whole = torch.zeros(24, dtype=torch.float64)
    whole[: len(values)] = values
    return Volume.of(whole.reshape(GRID.shape), GRID, "index_excess", n_ambient)


def values_of(medium: Medium, quantity: str, excess: object, n_ambient: float) -> np.ndarray:
    return derive(volume(excess, n_ambient), quantity, medium).values.double().numpy().ravel()[: np.size(excess)]


def test_helium_in_air_round_trip() -> None:
    x = np.array([0.0, 0.25, 1.0])
    indices = [ambient_index(f"He:{a}, air:{1 - a}", 293.15, 101325.0, 532.0) for a in x]
    medium = MixtureSettings()
    excess = np.array(indices) - indices[0]
    np.testing.assert_allclose(values_of(medium, "mole_fraction", excess, indices[0]), x, atol=1e-6)
    mass = x * molar_mass("He") / (x * molar_mass("He") + (1 - x) * molar_mass("air"))
    np.testing.assert_allclose(values_of(medium, "mass_fraction", excess, indices[0]), mass, atol=1e-6)
    density = values_of(medium, "density", excess, indices[0])
    assert density[[0, 2]] == pytest.approx([1.2041, 0.16640], rel=1e-3)  # kg/m3, tables of both gases at 20 degrees C
    assert np.isnan(values_of(medium, "mole_fraction", [-4e-4], indices[0]))[0]
    beyond = 1.08 * excess[2:]  # noise beyond pure helium
    assert values_of(medium, "mass_fraction", beyond, indices[0])[0] == pytest.approx(1.0)
    with pytest.raises(InputError, match="does not separate them"):
        MixtureSettings(jet="N2", ambient="air")
    assert "not that of air" in medium.not_around(1.333)


def test_tunnel_against_tables_of_isentropic_flow() -> None:
    """NACA report 1135: at Mach 2, p/p0 = 0.1278, rho/rho0 = 0.2300, T/T0 = 0.5556; Mach 1: 0.5283, 0.6339, 0.8333."""
    medium = IsentropicSettings(total_pressure_pa=2e5, total_temperature_k=300.0, mach=2.0)
    k, rho0 = gladstone_dale("air", 532.0), medium.total_density
    assert rho0 == pytest.approx(2e5 / 287.06 / 300, rel=1e-4)
    n_ambient = 1 + k * 0.2300 * rho0
    still = IsentropicSettings(total_pressure_pa=2e5, total_temperature_k=300.0)
    assert still.stream_mach(n_ambient) == pytest.approx(2.0, abs=2e-3)
    assert values_of(medium, "static_pressure", [0.0], n_ambient)[0] == pytest.approx(0.1278 * 2e5, rel=1e-3)
    assert values_of(medium, "temperature", [0.0], n_ambient)[0] == pytest.approx(0.5556 * 300, rel=1e-3)
    assert values_of(medium, "pressure_coefficient", [0.0], n_ambient)[0] == pytest.approx(0, abs=1e-3)
    expansion = -k * (0.2300 - 0.0762) * rho0  # to Mach 3: 0.07623
    assert values_of(medium, "mach", [expansion], n_ambient)[0] == pytest.approx(3.0, abs=5e-3)
    compression = k * (0.6339 - 0.2300) * rho0
    assert np.isnan(values_of(medium, "mach", [compression], n_ambient))[0]
    assert np.isfinite(values_of(medium, "density", [compression], n_ambient))[0]


def test_behind_a_shock_total_pressure_is_lost() -> None:
    """Normal shock at Mach 2 (NACA 1135): rho2/rho1 = 2.6667, p2/p1 = 4.5, p02/p01 = 0.7209, M2 = 0.5774."""
    medium = IsentropicSettings(mach=2.0, shock_angle=90.0)
    k = gladstone_dale("air", 532.0)
    stream = medium.stream_density(N_AIR)
    excess, n_ambient = k * (2.6667 - 1) * stream, 1 + k * stream
    assert values_of(medium, "mach", [excess], n_ambient)[0] == pytest.approx(0.5774, abs=2e-3)
    ratio = values_of(medium, "static_pressure", [0.0, excess], n_ambient)
    assert ratio[1] / ratio[0] == pytest.approx(4.5, rel=2e-3)
    assert any("72.1%" in line for line in medium.remarks(volume([0.0], n_ambient)))
    with pytest.raises(InputError, match=r"more than the Mach angle, 30.0 degrees"):
        IsentropicSettings(mach=2.0, shock_angle=25.0)
    low = IsentropicSettings(total_pressure_pa=2e4)
    assert "above that of the reservoir" in low.not_around(N_AIR)
    assert low.quantities_of(volume([0.0], N_AIR)) == ("index_excess", "n")


def test_index_of_water() -> None:
    """Check values of IAPWS R9-97 at 0 degrees C, 0.1 MPa; Tilton & Taylor 1938, sodium D, against air."""
    checks = {226.5: 1.394527, 589.0: 1.334344, 1013.98: 1.326135}
    for wavelength, expected in checks.items():
        assert fresh_water_index(np.array([0.0]), wavelength)[0] == pytest.approx(expected, abs=2e-6)
    table = {10: 1.33369, 20: 1.33299, 40: 1.33051, 60: 1.32718}
    celsius = np.array([*table], dtype=float)
    np.testing.assert_allclose(fresh_water_index(celsius, 589.3) / 1.000271, [*table.values()], atol=8e-5)
    np.testing.assert_allclose(water_density(np.array([4.0, 25.0])), [999.972, 997.045], atol=0.01)
    assert seawater_index(20.0, np.array([0.0]), 589.3)[0] == pytest.approx(1.33299, abs=5e-5)


def test_heated_and_salted_water() -> None:
    n = float(fresh_water_index(np.array([20.0]), 532.0)[0])
    warm = fresh_water_index(np.array([25.0, 60.0]), 532.0) - n
    medium = WaterSettings()
    np.testing.assert_allclose(values_of(medium, "temperature", warm, 1.3335), [298.15, 333.15], atol=2e-3)
    assert np.isnan(values_of(medium, "temperature", [0.05], 1.3335))[0]
    salty = WaterSettings(varies="salinity", ambient_salinity=5.0)
    steps = seawater_index(20.0, np.array([5.0, 12.0]), 532.0)
    np.testing.assert_allclose(values_of(salty, "salinity", steps - steps[0], 1.334), [5.0, 12.0], atol=1e-3)
    assert "salinity" not in medium.available("index_excess")
    assert "not that of water" in medium.not_around(N_AIR)
    with pytest.raises(InputError, match="expected 0 to 30 degrees C for salinity, got 50"):
        WaterSettings(varies="salinity", ambient_c=50.0)


def test_electrons_in_a_plasma() -> None:
    """The critical density is 1.115e27 m^-3 at 1 um (Hutchinson), and n = 1 - n_e / (2 n_c) for small n_e."""
    assert critical_density(1000.0) == pytest.approx(1.115e27, rel=1e-3)
    n_e = 3e24
    excess = -n_e / critical_density(532.0) / 2
    assert values_of(PlasmaSettings(), "electron_density", [excess], 1.0)[0] == pytest.approx(n_e, rel=1e-3)


def test_table_of_another_liquid(tmp_path: Path) -> None:
    file = tmp_path / "ethanol.csv"
    file.write_text(
        "temperature [C],n,wavelength_nm\n" + "".join(
            f"{t},{1.3616 - 4e-4 * (t - 20) + 2e-5 * (600 - w)},{w}\n" for w in (500, 600) for t in (10, 20, 30)
        )
    )  # fmt: skip
    medium = TableSettings(file=file, ambient=20.0)
    value = values_of(medium, "temperature", [-2e-3], 1.363)[0]
    assert value == pytest.approx(298.15, abs=0.01)
    assert medium.available("index_excess") == ("index_excess", "n", "temperature")
    with pytest.raises(InputError, match=r"expected a value of the table \(10 to 30\), got 50"):
        TableSettings(file=file, ambient=50.0)
    with pytest.raises(InputError, match="expected 500 to 600 nm"):
        TableSettings(file=file, ambient=20.0, wavelength_nm=632.8)
    with pytest.raises(InputError, match="expected a file for --medium table"):
        TableSettings().available("index_excess")


@pytest.mark.parametrize("name", [name for name in MEDIA if name != "table"])
def test_deviations_are_the_scatter_of_samples(name: str) -> None:
    medium = MEDIA[name]()
    n_ambient = {"water": 1.3345, "isentropic": 1.0002}.get(name, N_AIR)
    centre = {"water": -2e-4, "mixture": -5e-5}.get(name, -1e-6)
    std = 1e-6
    field = volume(np.full(24, centre), n_ambient)
    draws = centre + std * np.random.default_rng(0).standard_normal(4000)
    for quantity in medium.available("index_excess")[2:]:
        value = deviation(field, torch.full(GRID.shape, std, dtype=torch.float64), quantity, medium)
        samples = medium.values(torch.from_numpy(draws), n_ambient, quantity)[0]
        assert float(value.mean()) == pytest.approx(float(samples.std()), rel=0.06)


def test_a_medium_is_stored_and_read() -> None:
    settings = MediumSettings(medium="water", water=WaterSettings(ambient_c=30.0))
    assert stored_medium(settings.medium_entries) == settings.substance
    assert MediumSettings().medium_entries.keys() == {"gas"}
    assert MediumChanges().of(settings.medium_entries) == settings.substance
    assert MediumChanges(medium="plasma").of(settings.medium_entries) == PlasmaSettings()
    unused = r"expected water with --water.ambient-c, got gas"
    with pytest.raises(InputError, match=unused):
        MediumSettings(water=WaterSettings(ambient_c=30.0))
    with pytest.raises(InputError, match=unused):
        merge(MediumChanges(), {"water.ambient_c": 30.0}).of({})
    with pytest.raises(InputError, match=r"expected gas with --gas.composition, got plasma"):
        MediumSettings(medium="plasma", gas=GasSettings(composition="CO2"))
    assert [v.quantity for v in derive_all(volume([0.0], 1.3345), settings.substance)] == [
        "index_excess", "n", "temperature",
    ]  # fmt: skip


def test_a_run_in_water(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From a measurement in a tank to temperature, its page, an export, and the medium of another export."""
    path, out = tmp_path / "m.nc", tmp_path / "result"
    assert not run(
        "simulate", "--phantom", "gaussians", "--views", 4, "--image-size", 14, 14, "--n-ambient", 1.3345,
        "--noise", 0.05, "--steps", 30, "--truth-voxels", 8, "--out", path,
    )  # fmt: skip
    words = ("--medium", "water", "--water.ambient-c", 25)
    assert not run("reconstruct", path, "--out", out, "--max-steps", 5, "--withhold", "none", "--voxels", 12, *words)
    assert "temperature: fresh water at one atmosphere and 532 nm" in capsys.readouterr().out
    page = (out / "report.html").read_text(encoding="utf-8")
    assert '"kind": "table"' in page or '"kind":"table"' in page
    assert "temperature" in page
    with xr.open_dataset(out / "volume.nc") as result:
        assert "temperature" in result
        assert "density" not in result
    assert not run("export", out, "--out", tmp_path / "t.nc", "--quantities", "temperature")
    with xr.open_dataset(tmp_path / "t.nc") as exported:
        assert exported["temperature"].shape == (12, 12, 12)
        assert float(exported["temperature"].mean()) == pytest.approx(298.15, abs=5)
    assert not run("export", out, "--out", tmp_path / "p.nc", "--medium", "plasma", "--voxels", 8)
    capsys.readouterr()
    assert run("export", out, "--out", tmp_path / "d.nc", "--quantities", "density", "--voxels", 8) == 2
    assert "expected one of index_excess, n, temperature, got 'density'" in capsys.readouterr().err
    assert run("export", out, "--out", tmp_path / "d.nc", "--medium", "water", "--water.ambient-c", 200) == 2
    assert "--water.ambient-c: expected 0.2 to 99 degrees C" in capsys.readouterr().err
    assert run("export", out, "--out", tmp_path / "d.nc", "--medium", "mixture") == 2
    assert "--medium: nothing follows from the field: the ambient index 1.3345 is not" in capsys.readouterr().err
    assert run("reconstruct", path, "--out", tmp_path / "r", "--medium", "mixture", "--max-steps", 3) == 2
    assert "--medium: the ambient index 1.3345 is not that of air" in capsys.readouterr().err
    assert run("export", out, "--out", tmp_path / "d.nc", "--second", out, "--medium", "plasma") == 2
    assert "--second: expected results at two wavelengths, got 532 and 532 nm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("head", "ambient", "message"),
    [
        ("temperature [F],n", 68, r"expected temperature in k or c or degc or celsius or degreesc, got 'f'"),
        ("temperature,n", 20, r"expected a unit, temperature \[C\] or temperature \[K\], got none"),
        ("density [g/cm3],n", 20, r"expected density in kg/m3 .*, got 'g/cm3'"),
        ("salinity [%],n", 20, r"expected salinity in g/kg or gkg-1, got '%'"),
    ],
)
def test_tables_in_other_units_are_refused(tmp_path: Path, head: str, ambient: float, message: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"{head}\n20,1.00027\n120,1.0002\n", encoding="utf-8")
    with pytest.raises(InputError, match=message):
        TableSettings(file=path, ambient=ambient)


def test_a_value_in_another_unit_than_the_tables_is_refused(tmp_path: Path) -> None:
    """20 degrees C stated as 293.15 is in the table of a furnace, but its index is not that around the flow."""
    path = tmp_path / "table.csv"
    path.write_text("temperature [C],n\n0,1.000290\n20,1.00027\n500,1.0001\n", encoding="utf-8")
    assert not TableSettings(file=path, ambient=20).not_around(1.00027)
    assert "is not that of" in TableSettings(file=path, ambient=293.15).not_around(1.00027)


@pytest.mark.parametrize("head", ["temperature [deg C]", "temperature [°C]", "temperature [degrees C]"])
def test_celsius_by_its_names(tmp_path: Path, head: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"{head},n\n20,1.36\n40,1.35\n", encoding="utf-8")
    water = TableSettings(file=path, ambient=20)
    assert values_of(water, "temperature", [-0.01], 1.36) == pytest.approx([313.15])


def test_changes_to_the_medium_of_a_result_begin_with_it() -> None:
    stored = MediumSettings(medium="mixture", mixture=MixtureSettings(jet="CO2", temperature_k=350.0)).medium_entries
    default = MixtureSettings().temperature_k
    changed = merge(MediumChanges(), {"mixture.pressure_pa": 9e4, "mixture.temperature_k": default}).of(stored)
    assert changed == MixtureSettings(jet="CO2", temperature_k=default, pressure_pa=9e4)
    assert MediumChanges(medium="plasma").of(stored) == PlasmaSettings()


def test_a_gas_that_is_not_in_the_table_is_named_by_its_option() -> None:
    with pytest.raises(InputError, match="ambient: expected gases out of"):
        MixtureSettings(ambient="Xx")


def test_celsius_and_the_ambient_of_the_laboratory_in_a_tunnel() -> None:
    with pytest.raises(InputError, match=r"total_temperature_k: expected K, from 60 on, got 27; add 273.15"):
        IsentropicSettings(total_temperature_k=27.0)
    assert "of no gas" in IsentropicSettings().not_around(1.0)
    lines = IsentropicSettings(mach=2.0).remarks(volume(np.zeros(24), N_AIR))
    assert any("is n_ambient that of the laboratory" in line for line in lines)
    assert not any("laboratory" in line for line in IsentropicSettings().remarks(volume(np.zeros(24), N_AIR)))


def test_two_results_at_two_wavelengths(tmp_path: Path) -> None:
    """The export of two results is the solution of their fields, with deviations where both have them."""
    names = ("green", "infrared")
    for name, light in zip(names, (532, 1064), strict=True):
        path = tmp_path / f"{name}.nc"
        assert not run(
            "simulate", "--views", 4, "--image-size", 14, 14, "--wavelength-nm", light, "--seed", light,
            "--noise", 0.05, "--steps", 30, "--truth-voxels", 8, "--out", path,
        )  # fmt: skip
        words = ("--method", "tikhonov", "--withhold", "none", "--voxels", 10, "--uncertainty", "fast", "--no-report",
                 "--regularisation", 0.01, "--iterations", 10)  # fmt: skip
        assert not run("reconstruct", path, "--out", tmp_path / name, *words)
    first, second = (tmp_path / name for name in names)
    assert not run("export", first, "--out", tmp_path / "p.nc", "--second", second, "--medium", "plasma")
    volumes = [ResultDirectory(folder).volumes() for folder in (first, second)]
    fields, stds = ([v[f"index_excess{end}"] for v in volumes] for end in ("", "_std"))
    expected = gas_and_electrons(fields, (532.0, 1064.0), stds=[std.values for std in stds])
    exported = read_volumes(tmp_path / "p.nc")
    assert [*exported] == ["density", "electron_density", "density_std", "electron_density_std"]
    for volume_of in expected:
        values = exported[volume_of.quantity].values.double()
        assert torch.allclose(values, volume_of.values.double(), rtol=1e-3, atol=1e-3 * float(values.abs().max()))


@pytest.mark.parametrize("angle", [25.0, 40.0, 60.0])
@pytest.mark.parametrize("shape", ["wedge", "cone"])
def test_the_angle_of_a_shock_is_measured(angle: float, shape: str) -> None:
    """A jump of density over 1.6 mm with noise of 5 % of it, along a plane or a cone."""
    grid, tilt = Grid.of_resolution(Box.cube(50.0), 60), np.radians(angle)
    x, y, z = grid.points().reshape(*grid.shape, 3).unbind(-1)
    distance = z.abs() if shape == "wedge" else (y.square() + z.square()).sqrt()
    behind = torch.sigmoid(((x + 20) * np.sin(tilt) - distance * np.cos(tilt)) / 0.8)
    noise = 0.05 * torch.from_numpy(np.random.default_rng(0).standard_normal(grid.shape))
    field = Volume.of(1e-4 * (behind + noise), grid, "index_excess", 1.0001)
    measured = shock_angle(field, (1.0, 0.0, 0.0))
    assert measured is not None
    assert measured[0] == pytest.approx(angle, abs=1.0)
    assert measured[1] < 2
    lines = IsentropicSettings(mach=3.0, total_pressure_pa=4e5).remarks(field)
    assert any(f"shock in the field: {measured[0]:.1f} degrees" in line for line in lines)
    blob = Volume.of(1e-4 * torch.exp(-(x**2 + y**2 + z**2) / 100), grid, "index_excess", 1.0001)
    assert shock_angle(blob, (1.0, 0.0, 0.0)) is None


def test_two_wavelengths_separate_gas_and_electrons() -> None:
    rho, n_e, lights = -0.3, 5e23, (532.0, 1064.0)
    k = [gladstone_dale("air", w) for w in lights]
    excess = [a * rho - n_e / critical_density(w) / 2 for a, w in zip(k, lights, strict=True)]
    fields = [volume(np.full(24, x), N_AIR) for x in excess]
    stds = [torch.full(GRID.shape, 1e-7)] * 2
    density, electrons, *deviations = gas_and_electrons(fields, lights, stds=stds)
    assert float(density.values.mean()) == pytest.approx((N_AIR - 1) / k[0] + rho, rel=1e-5)
    assert float(electrons.values.mean()) == pytest.approx(n_e, rel=1e-5)
    assert [v.quantity for v in deviations] == ["density_std", "electron_density_std"]
    one = 1e-7 * 2 * critical_density(1064.0)  # by one wavelength, if the gas were known
    assert one < float(deviations[1].values.mean()) < 2 * one
    with pytest.raises(InputError, match="the same relation twice"):
        gas_and_electrons(fields, (532.0, 532.0))


def test_two_wavelengths_give_temperature_and_composition_with_deviations_that_say_how_badly() -> None:
    lights, x, hot = (500.0, 650.0), 0.4, 500.0
    mixed = {w: ambient_index(f"He:{x}, air:{1 - x}", hot, 101325.0, w) for w in lights}
    still = {w: ambient_index("air", 293.15, 101325.0, w) for w in lights}
    excess = [mixed[w] - still[w] for w in lights]
    fields = [volume(np.full(24, e), N_AIR) for e in excess]
    std = 1e-9
    temperature, fraction, *deviations = two_gases(
        fields, lights, "He", "air", stds=[torch.full(GRID.shape, std)] * 2
    )  # fmt: skip
    assert float(temperature.values.mean()) == pytest.approx(hot, rel=1e-3)
    assert float(fraction.values.mean()) == pytest.approx(x, rel=1e-3)
    draws = np.random.default_rng(0).standard_normal((2, 24)) * std
    noisy = [volume(e + d, N_AIR) for e, d in zip(excess, draws, strict=True)]
    scatter = two_gases(noisy, lights, "He", "air")
    for samples, deviation_of in zip(scatter, deviations, strict=True):
        assert float(deviation_of.values.mean()) == pytest.approx(float(samples.values.std()), rel=0.4)
    assert (
        float(deviations[1].values.mean()) > 0.001
    )  # a billionth of the index is already a thousandth of the fraction
