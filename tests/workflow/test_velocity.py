"""nerif velocity: from a film of densities to a store of velocities, its report, movie and export."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from commands import run
from nerif.common.interruption import Interrupted
from nerif.data.kinds import VELOCITY, kind_of
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.data.vti import read_vti
from nerif.flow.assimilation import FitIterate, VelocityFit
from nerif.geometry import Box, Grid
from nerif.geometry.symmetry import Symmetry
from nerif.report import velocity_page
from nerif.workflow.film_velocity import densities, velocity_of_film
from refusals import refused

pytest.importorskip("zarr", reason="velocities are stored by zarr (the extra `sequence`)")

GRID = Grid(Box((-20.0, -20.0, -30.0), (20.0, 20.0, 30.0)), (24, 16, 16))
TIMES = tuple(0.004 * k for k in range(5))
RISE = 400.0  # mm/s
N_AMBIENT = 1.00027
PLUME = Path(__file__).parents[2].parent / "shared" / "data" / "plume" / "plume.nc"
QUICK = ("--resolution", "12", "--max-iterations", "8", "--time-limit", "0", "--samples", "2",
         "--sample-iterations", "4")  # fmt: skip

ROUGH = ("--resolution", "12", "--max-iterations", "2", "--time-limit", "0", "--samples", "0")


def film_of(path: Path, thetas: list[torch.Tensor], grid: Grid, times: tuple[float, ...]) -> Path:
    """Write volumes over time of theta = -(rho - rho_0) / rho_0."""
    store = VolumeSequence.create(path, times, grid, ("index_excess",), N_AMBIENT)
    for index, theta in enumerate(thetas):
        store.write(index, [Volume.of((1 - N_AMBIENT) * theta, grid, "index_excess", N_AMBIENT)])
    return path


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A light ring that rises."""
    x, y, z = GRID.points(torch.float32).unbind(-1)
    radius = (x**2 + y**2).sqrt()
    thetas = [
        0.1 * torch.exp(-(((radius - 7.0) / 4.0) ** 2) - ((z + 4.0 - RISE * t) / 5.0) ** 2) for t in TIMES
    ]  # fmt: skip
    return film_of(tmp_path_factory.mktemp("film") / "film.zarr", thetas, GRID, TIMES)


@pytest.fixture(scope="module")
def velocity(film: Path) -> Path:
    """The velocity of that ring."""
    out = film.with_name("velocity.zarr")
    assert run("velocity", film, "-o", out, *QUICK) == 0
    return out


def test_the_ring_is_found_to_rise_and_the_ambient_is_unknown(velocity: Path):
    import xarray as xr

    with xr.open_zarr(velocity, consolidated=False) as data:
        assert data["w"].attrs["units"] == "m s-1"
        assert data["w"].attrs["standard_name"] == "upward_air_velocity"
        assert data["pressure"].attrs["units"] == "Pa"
        assert data.attrs["viscosity"] == pytest.approx(15e-6)
        assert data.attrs["reference_density"] == pytest.approx(1.19, rel=0.1)
        core = data["w"].sel(time=TIMES[2]).sel(z=slice(-8, 0)).values
        assert np.nanmean(core) > 0.1
        assert np.isnan(data["w"].isel(time=2, z=0, y=0, x=0))
        assert np.isfinite(data["transport_residual"].values).any()
        assert data["pressure_std"].attrs["units"] == "Pa"
        finite = np.isfinite(data["w"].values)
        assert (data["w_std"].values[finite] >= 0).all()
        assert np.isnan(data["w_std"].values[~finite]).all()
        assert np.nanmax(data["w_std"].values) < 2 * RISE / 1e3
        np.testing.assert_allclose(data["density"].sel(x=0, y=0, z=-30, method="nearest"), 1.19, rtol=0.1)
    assert kind_of(velocity) is VELOCITY
    page = velocity.with_suffix(".html").read_text()
    assert "standard deviation of the velocity is" in page


@pytest.mark.parametrize(
    ("about", "rating", "words"),
    [
        ({}, "Use: ", "1.1 times those of noise"),
        ({"misfit": 2.0}, "Use with care", "check units"),
        ({"misfit": 2.0, "falling": True}, "Use with care", "more time"),
        ({"misfit": 1.1, "falling": True}, "Use with care", "while its residual still fell"),
        ({"misfit": 3.2}, "Do not use", "3.2 times"),
        ({"unexplained": 0.015}, "Use with care", "leaves 1.5% of the acceleration"),
        ({"unexplained": 0.8}, "Do not use", "leaves 80.0% of the acceleration"),
        ({"settings": {"samples": 6}}, "Use with care", "no time for standard deviations"),
        ({"physics": "transport"}, "Use with care", "no pressure"),
        ({"known": 0.03}, "Use with care", "known in 3.0% of the box"),
        ({"known": 0.0}, "Do not use", "known in 0.0% of the box"),
    ],
)
def test_the_verdict_judges_residuals_limits_and_the_share_known(tmp_path: Path, about: dict, rating: str, words: str):
    share = about.pop("known", 0.4)
    store = VelocitySequence.begin(tmp_path / "v.zarr", (0.0,), GRID, (), {"misfit": 1.1, "unexplained": 0.004} | about)
    u = torch.full(GRID.shape, math.nan)
    u.view(-1)[: round(share * u.numel())] = 1.0
    store.write_frame(0, {"u": u, "v": u, "w": u})
    headline = velocity_page._statements(VelocitySequence(store.path))[0]
    assert headline.text.startswith(rating)
    assert words in headline.text
    assert (headline.level == "good") == (rating == "Use: ")


def test_report_movie_and_paraview_show_vectors(velocity: Path, tmp_path: Path):
    page = velocity.with_suffix(".html").read_text()
    assert "Streamlines and vorticity" in page
    assert "Velocity is given in" in page
    out = tmp_path / "frame.vti"
    assert run("export", velocity, "--frame", "2", "-o", out) == 0
    arrays, grid, _ = read_vti(out)
    assert grid.shape == GRID.shape
    pv = pytest.importorskip("pyvista", reason="the extra `movie` is not installed")
    image = pv.read(out)
    store = VelocitySequence(velocity)
    expected = store.vectors(2).reshape(3, -1).T.numpy()
    np.testing.assert_allclose(image.point_data["velocity"], expected)
    assert {"speed", "vorticity", "pressure"} <= set(arrays)
    for style in ("arrows", "streamlines"):
        movie = tmp_path / f"{style}.gif"
        assert run("movie", velocity, "-o", movie, "--style", style, "--every", "5", "--size", "160", "120") == 0
        assert movie.stat().st_size > 1000


def test_vorticity_of_a_rigid_rotation_is_twice_its_rate(tmp_path: Path):
    store = VelocitySequence.begin(tmp_path / "rotation.zarr", (0.0,), GRID, (), {})
    x, y, _ = GRID.points(torch.float32).unbind(-1)
    rate = 3.0  # 1/s
    store.write_frame(0, {"u": -rate * y / 1e3, "v": rate * x / 1e3, "w": torch.zeros_like(x)})
    torch.testing.assert_close(store.volume(0, "vorticity").values, torch.full(GRID.shape, 2 * rate))


def test_an_interrupted_run_continues_from_its_checkpoint(film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("nerif.workflow.film_velocity.CHECKPOINT_INTERVAL", 0.0)
    settings, out = VelocityFit(resolution=8, max_iterations=8, time_limit=0, samples=0), tmp_path / "v.zarr"

    def stop(iterate: FitIterate) -> None:
        if iterate.iterations == 3:
            with refused(out) as another:
                velocity_of_film(film, out, settings)
            assert "another run writes to it" in str(another.value)
        if iterate.iterations == 6:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted, match="run the same command again"):
        velocity_of_film(film, out, settings, on_iterate=stop)
    checkpoint = out.with_suffix(".checkpoint.safetensors")
    assert checkpoint.is_file()
    assert not out.exists()
    lines: list[str] = []
    counts: list[int] = []
    velocity_of_film(film, out, settings, say=lines.append, on_iterate=lambda i: counts.append(i.iterations))
    assert "continuing after 6 iterations" in lines
    assert counts[0] == 7
    assert out.exists()
    assert not checkpoint.exists()
    with refused(out):
        velocity_of_film(film, out, settings)


def test_a_symmetric_film_is_solved_in_the_plane_of_its_axis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("nerif.workflow.film_velocity.CHECKPOINT_INTERVAL", 0.0)
    lean = math.radians(5.0)
    symmetry = Symmetry.about("axis", (1.0, -1.0, 0.0), (math.sin(lean), 0.0, math.cos(lean)), 1e-3)
    assert symmetry is not None
    r, _, h = symmetry.reduced(GRID.points(torch.float32)).unbind(-1)
    film = tmp_path / "film.zarr"
    attributes = {"symmetry": asdict(symmetry)}
    store = VolumeSequence.create(film, TIMES, GRID, ("index_excess",), N_AMBIENT, attributes)
    for k, t in enumerate(TIMES):
        theta = 0.1 * torch.exp(-((r / 6.0) ** 2) - ((h + 4.0 - RISE * t) / 5.0) ** 2)
        store.write(k, [Volume.of((1 - N_AMBIENT) * theta, GRID, "index_excess", N_AMBIENT)])
    out = tmp_path / "v.zarr"
    settings = VelocityFit(resolution=12, max_iterations=8, time_limit=0, samples=2, sample_iterations=3)

    def stop(iterate: FitIterate) -> None:
        if iterate.iterations == 4:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted):
        velocity_of_film(film, out, settings, on_iterate=stop)
    lines: list[str] = []
    velocity = velocity_of_film(film, out, settings, say=lines.append)
    assert "continuing after 4 iterations" in lines
    vectors = velocity.vectors(2)
    middle = (r < 4) & ((h + 4.0 - RISE * TIMES[2]).abs() < 4)
    speed = (vectors * torch.tensor(symmetry.direction)[:, None, None, None]).sum(dim=0)[middle]
    assert float(speed.mean()) == pytest.approx(RISE / 1e3, rel=0.35)
    across = vectors[1][middle].mean()
    assert abs(float(across)) < 0.05 * float(speed.mean())
    assert not bool(torch.isfinite(vectors[:, r > 19]).any())
    assert velocity.attributes["symmetry"]["kind"] == "axis"
    deviation = velocity.read("w_std", 2)
    assert np.isfinite(deviation[middle.numpy()]).all()
    with refused("gravity"):
        velocity_of_film(film, tmp_path / "g.zarr", VelocityFit(gravity=(9810.0, 0.0, 0.0)))


def test_an_interruption_while_writing_leaves_no_store(film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(VelocitySequence, "write_frame", stop)
    settings = VelocityFit(resolution=8, max_iterations=2, time_limit=0, samples=0)
    with pytest.raises(KeyboardInterrupt):
        velocity_of_film(film, tmp_path / "v.zarr", settings)
    assert not (tmp_path / "v.zarr").exists()


def test_a_flow_that_moves_as_a_whole_has_its_velocity_and_water_has_no_density(tmp_path: Path, capsys):
    x, y, z = GRID.points(torch.float32).unbind(-1)
    centres = ((-9.0, 4.0, -8.0), (2.0, -6.0, 2.0), (-4.0, 3.0, 14.0))
    thetas = [
        sum(0.02 * torch.exp(-0.03 * ((x - a - 300.0 * t) ** 2 + (y - b) ** 2 + (z - c) ** 2)) for a, b, c in centres)
        for t in TIMES
    ]
    film = tmp_path / "film.zarr"
    store = VolumeSequence.create(film, TIMES, GRID, ("index_excess",), 1.333)
    for k, theta in enumerate(thetas):
        store.write(k, [Volume.of(-0.333 * theta, GRID, "index_excess", 1.333)])
    assert run("velocity", film, "-o", tmp_path / "v.zarr", "--physics", "transport", "--frames", "0:4", *ROUGH) == 0
    velocity = VelocitySequence(tmp_path / "v.zarr")
    assert np.nanmean(velocity.read("u", 2)) == pytest.approx(0.3, rel=0.1)
    assert abs(np.nanmean(velocity.read("v", 2))) < 0.01
    assert 0.1 < np.isfinite(velocity.read("u", 2)).mean() < 0.8
    assert "density" not in velocity.quantities
    printed = capsys.readouterr()
    assert "density and pressure: not computed: the ambient index 1.333" in printed.out + printed.err
    assert "Use with care: " in printed.out + printed.err


@pytest.mark.parametrize("physics", ["boussinesq", "transport"])
@pytest.mark.parametrize(("times", "lengths"), [(1e3, 1.0), (1e6, 1.0), (1.0, 1e-3), (1e-6, 1.0)])
def test_motion_of_wrong_units_is_refused(film: Path, times: float, lengths: float, physics: str):
    theta = densities(VolumeSequence(film))
    corners = [tuple(lengths * v for v in corner) for corner in (GRID.box.lower, GRID.box.upper)]
    with refused("film") as error:
        VelocityFit(physics=physics).check(theta, Grid(Box(*corners), GRID.shape), [times * t for t in TIMES])
    assert "instants in s and lengths in mm" in str(error.value)


def test_a_velocity_that_does_not_explain_its_film_exits_with_1(film: Path, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr("nerif.report.velocity_page.image", lambda *_: "")
    monkeypatch.setattr("nerif.analysis.velocity_verdict.MOST_MISFIT", 0.01)
    monkeypatch.setattr("nerif.analysis.velocity_verdict.MISFIT", (0.005, 0.01))
    assert run("velocity", film, "-o", tmp_path / "v.zarr", "--frames", "0:3", *ROUGH) == 1
    printed = capsys.readouterr()
    assert "Do not use: the density changes" in printed.out + printed.err
    assert (tmp_path / "v.html").is_file()


def test_a_part_of_a_film_has_its_own_instants(film: Path, tmp_path: Path):
    settings = VelocityFit(resolution=8, max_iterations=2, time_limit=0, samples=0)
    store = velocity_of_film(film, tmp_path / "part.zarr", settings, frames=(1, 4))
    assert store.times == pytest.approx(TIMES[1:4])
    assert run("movie", film, "-o", tmp_path / "film.gif", "--style", "arrows") == 2
    with refused("frames"):
        velocity_of_film(film, tmp_path / "v.zarr", settings, frames=(2, 9))


def test_films_that_show_no_velocity_are_refused(tmp_path: Path):
    x, _, _ = GRID.points(torch.float32).unbind(-1)
    one, column = torch.ones(GRID.shape), torch.exp(-((x / 5) ** 2))
    for number, (theta, frames, field) in enumerate(
        [(0 * one, 3, "film"), (one, 2, "film"), (0.8 * column, 3, "physics"), (0.1 * column, 3, "film"),
         (math.nan * one, 3, "film")]
    ):  # fmt: skip
        film = film_of(tmp_path / f"{number}.zarr", [theta] * frames, GRID, TIMES[:frames])
        with refused(field):
            velocity_of_film(film, tmp_path / "v.zarr")
    with refused("out"):
        velocity_of_film(film, film, force=True)
    assert run("velocity", film, "-o", tmp_path / "v.zarr") == 2
    assert not (tmp_path / "v.zarr").exists()


@pytest.mark.slow
@pytest.mark.skipif(not PLUME.is_file(), reason="the data of the plume are not beside the project (shared/data)")
def test_the_velocity_of_a_plume_by_another_solver(tmp_path: Path):
    import xarray as xr

    with xr.open_dataset(PLUME) as data:
        thetas = [torch.tensor(frame, dtype=torch.float32) for frame in data["theta"].values[:11]]
        times = tuple(float(t) for t in data["time"].values[:11])
        true = np.stack([data[name].values[:6] for name in "uvw"], axis=1) / 1e3
    grid = Grid(Box.cube(100.0), (60, 60, 60))
    film = film_of(tmp_path / "plume.zarr", thetas, grid, times)
    settings = VelocityFit(viscosity=30.0, diffusivity=30.0, resolution=24, time_limit=150)
    store = velocity_of_film(film, tmp_path / "v.zarr", settings)
    error = size = 0.0
    for k in range(6):
        inside = (thetas[2 * k] > 0.05 * max(float(t.max()) for t in thetas)).numpy()
        estimate = store.vectors(2 * k).numpy()
        error += float(np.square((estimate - true[k])[:, inside]).sum())
        size += float(np.square(true[k][:, inside]).sum())
    assert (error / size) ** 0.5 < 0.3
