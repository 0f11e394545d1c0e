"""Vectors of other programs: from their files to the measurement they were computed from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import nerif
from benchmarks.vector_files import WRITERS, Grid, write_session
from commands import run
from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Lens, paper_rig
from nerif.imaging.vectors.text_vectors import read_text_vectors
from nerif.imaging.vectors.vector_map import VectorMap, lattice, neighbour_noise
from nerif.imaging.vectors.vector_settings import VectorSettings
from nerif.imaging.vectors.vectors import VectorFilm
from nerif.simulation.simulate import simulate

STEP, WINDOW, PIXELS, VIEWS = 8, 16, (168, 200), ("cam2", "cam5")


class Rig:
    """Two cameras, their calibration, and the vectors that they see."""

    def __init__(self, folder: Path, first: float) -> None:
        cameras, box = paper_rig(200)
        self.cameras = [
            replace(cameras[i], image_size=PIXELS, name=name) for i, name in zip((1, 4), VIEWS, strict=True)
        ]
        self.calibration = folder / "calibration.toml"
        write_cameras(self.calibration, [CalibratedCamera.from_camera(c) for c in self.cameras], box=box)
        self.origin = first * STEP - 0.5
        shape = (int(PIXELS[0] / STEP - 2 * first) + 1, int(PIXELS[1] / STEP - 2 * first) + 1)
        grid = torch.tensor([[1 / STEP, 0, -self.origin / STEP], [0, 1 / STEP, -self.origin / STEP], [0, 0, 1]])
        lens = Lens(points=5, window=WINDOW / STEP)
        coarse = tuple(
            replace(c, intrinsics=grid.double() @ c.intrinsics, image_size=shape, lens=lens) for c in self.cameras
        )
        field = make_phantom("flame", box, 1)
        self.truth: Measurement = simulate(field, coarse, box, 1.00027, steps=20)
        self.missing = np.zeros((len(VIEWS), *shape), dtype=bool)
        self.missing[:, 3:5, 6] = True

    def grids(self, lag: float) -> list[Grid]:
        d = STEP * self.truth.displacements.double().numpy()
        return [
            Grid(d[i], self.missing[i], self.origin, STEP, PIXELS[0]).moved(lag) for i in range(len(VIEWS))
        ]  # fmt: skip


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> dict[float, Rig]:
    """Rigs by the position of the first vector, in steps from the edge."""
    return {first: Rig(tmp_path_factory.mktemp("rig"), first) for first in (0.5, 1.0)}


@pytest.fixture(scope="module")
def rig(rigs: dict[float, Rig]) -> Rig:
    return rigs[1.0]


@pytest.mark.parametrize("name", WRITERS)
def test_every_program_gives_the_measurement(
    name: str, rigs: dict[float, Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = WRITERS[name]
    rig = rigs[program.first]
    if program.ending == ".vc7":
        pytest.importorskip("lvpyio", reason="lvpyio, LaVision's reader, is not installed")
    for view, grid in zip(VIEWS, rig.grids(program.lag), strict=True):
        program.write(tmp_path / f"{view}{program.ending}", grid)
    out = tmp_path / "m.nc"
    assert not run(
        "vectors", tmp_path, "--calibration", rig.calibration, "--out", out, "--window", WINDOW, "--sigma", 0.08,
        *program.arguments,
    )  # fmt: skip
    text = capsys.readouterr().out
    m = Measurement.read(out)
    assert "vectors of" in text
    assert "every 8 x 8 px, window 16 px" in text
    assert m.names == VIEWS
    for camera, expected in zip(m.cameras, rig.truth.cameras, strict=True):
        torch.testing.assert_close(camera.intrinsics, expected.intrinsics, rtol=1e-5, atol=1e-3)
        assert camera.lens is not None
        assert camera.lens.window == pytest.approx(2, rel=1e-4)
        assert camera.image_size == expected.image_size
    assert bool((m.usable == torch.from_numpy(~rig.missing)).all())
    inner = m.usable[:, 2:-2, 2:-2].clone()
    inner[:, 0:5, 3:6] = False  # beside missing vectors the gradient of the displacement is unknown
    difference = (m.displacements - rig.truth.displacements)[:, 2:-2, 2:-2][inner].abs().max() * STEP
    assert float(difference) < program.digits + 0.02 * program.lag  # second order of the step to the flow image
    assert m.sigma is not None
    assert float(m.sigma[m.usable].max()) == pytest.approx(0.08 / STEP)


@pytest.mark.parametrize("name", ["PIVlab text", "a table"])
def test_vectors_point_to_the_reference(name: str, rig: Rig, tmp_path: Path) -> None:
    """Images in the other order turn the signs, and the position is that of the flow image at once."""
    for view, grid in zip(VIEWS, rig.grids(0.0), strict=True):
        WRITERS[name].write(tmp_path / f"{view}{WRITERS[name].ending}", replace(grid, d=-grid.d))
    settings = VectorSettings(first_image="flow", window=WINDOW, sigma=0.1)
    m = nerif.read_vectors(tmp_path, rig.calibration, settings)
    torch.testing.assert_close(m.displacements[m.usable], rig.truth.displacements[m.usable], rtol=0, atol=1e-5)


def test_film_of_numbered_files_and_its_mean(rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    for view, grid in zip(VIEWS, rig.grids(0.0), strict=True):
        for i in range(12):  # frame 10 is behind frame 9
            noisy = replace(grid, d=(1 + (i == 11)) * grid.d + 0.1 * rng.standard_normal(grid.d.shape))
            WRITERS["a table"].write(tmp_path / f"{view}_{i}.csv", noisy)
    film = VectorFilm.open(tmp_path, rig.calibration, VectorSettings(window=WINDOW))
    assert len(film) == 12
    last, _ = film.measure((11,))
    assert float((last.displacements / rig.truth.displacements)[last.usable].median()) == pytest.approx(2, rel=0.05)
    mean, noise = film.measure(range(11))
    assert set(noise.values()) == {"repeats"}
    assert mean.sigma is not None
    assert STEP * float(mean.sigma[mean.usable].median()) == pytest.approx(0.1 / 11**0.5, rel=0.1)
    out = tmp_path / "film.zarr"
    calibration = tmp_path.with_suffix(".toml")
    calibration.write_bytes(rig.calibration.read_bytes())
    words = ("vectors", tmp_path, "--calibration", calibration, "--out", out, "--frame-rate", 500, "--window")
    assert not run(*words, WINDOW)
    sequence = MeasurementSequence.read(out)
    assert sequence.times[1] == pytest.approx(0.002)
    assert len(sequence) == 12
    before = {path: path.stat().st_mtime_ns for path in (out / "displacement" / "c").rglob("*")}
    assert not run(*words, WINDOW)  # nothing is left to do
    assert before == {path: path.stat().st_mtime_ns for path in (out / "displacement" / "c").rglob("*")}
    assert run(*words, WINDOW + 1) == 2  # a store of other settings
    turned = [replace(rig.cameras[0], rotation=rig.cameras[1].rotation), rig.cameras[1]]
    write_cameras(calibration, [CalibratedCamera.from_camera(c) for c in turned], box=rig.truth.box)
    capsys.readouterr()
    assert run(*words, WINDOW) == 2  # a new calibration of the same name
    assert "got other rotation of view 'cam2'" in capsys.readouterr().err
    stored = sequence.frame(11)
    torch.testing.assert_close(stored.displacements[stored.usable], last.displacements[last.usable])


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_session_of_several_frames(version: str, rig: Rig, tmp_path: Path) -> None:
    for view, grid in zip(VIEWS, rig.grids(0.0), strict=True):
        write_session(
            tmp_path / f"{view}.mat", [grid, replace(grid, d=2 * grid.d), replace(grid, d=3 * grid.d)], version
        )
    film = VectorFilm.open(tmp_path, rig.calibration, VectorSettings(first_image="flow"))
    assert len(film) == 3
    views = [film.views[0].map(i) for i in range(3)]
    there = views[0].valid
    np.testing.assert_allclose(views[2].displacement[there], 3 * views[0].displacement[there], rtol=1e-5)


def test_one_file_of_all_views(rig: Rig, tmp_path: Path) -> None:
    grids = rig.grids(0.0)
    x, y = grids[0].xy
    d = np.stack([grid.d for grid in grids])
    np.savez(tmp_path / "all.npz", x=x[0], y=y[:, 0], u=d[..., 0], v=d[..., 1])
    m = nerif.read_vectors(tmp_path / "all.npz", rig.calibration, VectorSettings(window=WINDOW))
    torch.testing.assert_close(m.displacements, rig.truth.displacements, rtol=0, atol=1e-5)


@pytest.mark.parametrize("shared", [True, False])
def test_noise_among_neighbours(shared: bool) -> None:
    """The scatter gives the noise beside a smooth flow, whether windows that overlap by half share noise or not."""
    rng = np.random.default_rng(3)
    fine = rng.standard_normal((131, 161, 2))
    mean = sum(fine[i : 130 + i, j : 160 + j] for i in (0, 1) for j in (0, 1)) / 2
    y, x = np.mgrid[:130, :160] / 40
    flow = np.stack([np.sin(x) * np.cos(y), np.cos(x + y)], axis=-1)
    noise = 0.07 * (mean if shared else fine[:130, :160])
    assert neighbour_noise(flow + noise, 2.0) == pytest.approx((0.07, 0.07), rel=0.15)


def test_grid_with_a_missing_row_and_rounded_positions() -> None:
    rows = np.delete(np.arange(9) * 5.33333, 4).round(2)
    first, step, index = lattice(rows, "y", "file")
    assert (first, step) == pytest.approx((0, 5.3333), abs=1e-2)
    assert index.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]


def _text(folder: Path, name: str, content: str) -> None:
    (folder / name).write_text(content)


def _rows(step: float = 8, names: str = "x,y,u,v", values: str = "0.1,0.2", first: float = 8) -> str:
    points = [(first + step * j, first + step * i) for i in range(8) for j in range(9)]
    return "\n".join([names, *(f"{x},{y},{values}" for x, y in points)])


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (_rows(names="x,y,u,q"), "expected columns x, y, u, v, got x, y, u, q without v"),
        (_rows(names="x [mm],y [mm],u [m/s],v [m/s]"), "without the length of a pixel; give --scale MM"),
        (_rows(names="x [px],y [px],u [furlong],v [furlong]"), "got the unit 'furlong' of u; give --vector-unit"),
        (_rows(step=40), "expected vectors within the 168 x 200 px"),
        (_rows().replace("16,8", "19,8"), "at equal distances"),
        (_rows() + "\n8,8,0.1,0.2", "expected one vector at a position, got several"),
        ("x,y,u,v\nno numbers here", "expected rows of at least 4 numbers"),
        (_rows(names="x,y,u,v,w", values="0.1,0.2,0.3"), "expected two components of one camera, got three"),
        (_rows(values="nan,nan"), "no vector that its flags allow"),
    ],
)  # fmt: skip
def test_bad_files(content: str, expected: str, rig: Rig, tmp_path: Path) -> None:
    for view in VIEWS:
        _text(tmp_path, f"{view}.csv", content)
    with pytest.raises(InputError, match=expected.replace("(", r"\(").replace("--", "--")):
        nerif.read_vectors(tmp_path, rig.calibration)


def test_refused_folders(rig: Rig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        nerif.read_vectors(tmp_path / "none", rig.calibration)
    with pytest.raises(InputError, match="expected files of vectors"):
        nerif.read_vectors(tmp_path, rig.calibration)
    for name in ("cam2.csv", "cam2.txt", "cam5.csv"):
        _text(tmp_path, name, _rows())
    with pytest.raises(InputError, match=r"expected one file or film of view 'cam2', got cam2.txt and cam2.csv"):
        nerif.read_vectors(tmp_path, rig.calibration)
    (tmp_path / "cam2.txt").unlink()
    _text(tmp_path, "cam9.csv", _rows())
    with pytest.raises(InputError, match="no camera named 'cam9'"):
        nerif.read_vectors(tmp_path, rig.calibration)
    (tmp_path / "cam9.csv").unlink()
    with pytest.raises(InputError, match="time between the images"):
        nerif.read_vectors(tmp_path, rig.calibration, VectorSettings(vector_unit="m/s", scale=0.1))
    with pytest.raises(InputError, match="scale: expected none for positions in px and vectors in px"):
        nerif.read_vectors(tmp_path, rig.calibration, VectorSettings(scale=0.1))
    with pytest.raises(InputError, match="window: expected less than the edge of the images"):
        nerif.read_vectors(tmp_path, rig.calibration, VectorSettings(window=180.0))
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cam1.tif").touch()
    with pytest.raises(InputError, match="got images; nerif displacement evaluates those"):
        nerif.read_vectors(tmp_path / "photos", rig.calibration)


def test_displacement_moves_to_the_flow_image() -> None:
    """A displacement that grows along x, at positions on the first image, is smaller on the second."""
    x = np.arange(40.0)
    d = np.zeros((5, 40, 2), dtype=np.float32)
    d[..., 0] = 0.1 * x * 8
    moved = VectorMap(d, (0, 0), (8, 8), lag=1.0).on_flow_image().displacement[..., 0]
    expected = 0.1 / 1.1 * x * 8  # d0(p) = d(p + d0): d = 0.1 (p - d) to all orders
    np.testing.assert_allclose(moved[2], expected, rtol=0.012)


def test_file_that_openpiv_wrote() -> None:
    """Particles displaced by d = (0.02 (x - 100.25), 1 - 0.03 (y - 80.75)) px at (x, y) of the second image.

    OpenPIV 0.26.1: extended_search_area_piv with windows of 32 px, transform_coordinates, save.
    """
    path = Path(__file__).with_name("openpiv_0.26.1.txt")
    vectors = read_text_vectors(path, VectorSettings())
    assert vectors.y_up
    grid = vectors.map(240, path).on_flow_image()
    rows, columns = np.mgrid[: grid.displacement.shape[0], : grid.displacement.shape[1]]
    x, y = grid.origin[0] + grid.step[0] * columns, grid.origin[1] + grid.step[1] * rows
    inner = (slice(2, -2), slice(2, -2))
    u, v = grid.displacement[..., 0][inner], grid.displacement[..., 1][inner]
    (across, u0), (along, v0) = np.polyfit(x[inner].ravel(), u.ravel(), 1), np.polyfit(y[inner].ravel(), v.ravel(), 1)
    assert across == pytest.approx(0.02, abs=0.001)
    assert along == pytest.approx(-0.03, abs=0.002)
    assert -u0 / across == pytest.approx(100.25, abs=2.5)  # the noise is 0.1 px
    assert -v0 / along == pytest.approx(80.75 + 1 / 0.03, abs=2.5)


def test_doubtful_scales_windows_and_calibrations_are_named(
    rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    """Displacements beyond the window, vectors in a corner of the image, a window of a fraction of a pixel."""
    for view in VIEWS:
        _text(tmp_path, f"{view}.csv", _rows(step=2, names="x,y,u [m s-1],v [m s-1]"))
    calibration = tmp_path.with_suffix(".toml")
    calibration.write_bytes(rig.calibration.read_bytes())
    words = ("vectors", tmp_path, "--calibration", calibration, "--out", tmp_path.parent / "d.nc", "--sigma", 0.1)
    assert not run(*words, "--scale", 1.0, "--time-step", 1.0, "--window", 0.16)
    text = capsys.readouterr().out
    assert "u and v in m/s" in text
    assert "displacements of 200 px exceed the window of 0.16 px; check --scale, --time-step" in text
    assert "a window of 0.16 px with a vector on every 2 px" in text
    assert "vectors cover 13% x 14% of the camera's image from its first corner" in text


def test_a_cut_file_and_a_wrong_scale_are_noticed(
    rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    for view in VIEWS:
        _text(tmp_path, f"{view}.csv", _rows())
    whole = (tmp_path / "cam5.csv").read_text().splitlines()
    _text(tmp_path, "cam5.csv", "\n".join(whole[:-18]))
    calibration = tmp_path.with_suffix(".toml")
    calibration.write_bytes(rig.calibration.read_bytes())
    words = ("vectors", tmp_path, "--calibration", calibration, "--out", tmp_path.parent / "cut.nc", "--sigma", 0.1)
    assert not run(*words)
    assert (
        "note: views with fewer rows or columns of vectors than others: cam5 (6, 9) of (8, 9)"
        in capsys.readouterr().out
    )
    settings = VectorSettings(position_unit="mm", scale=10.0, sigma=0.1)
    with pytest.raises(InputError, match=r"at least a pixel apart, got 0.8 px; check --scale"):
        nerif.read_vectors(tmp_path, rig.calibration, settings)
