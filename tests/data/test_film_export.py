"""Exports that other programs read: Tecplot text of a volume, films as .pvd and .dat, planes of vectors for DaVis."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from commands import run
from nerif.common.interruption import Interrupted
from nerif.data.measurement_sequence import add_frames
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import Volume, export
from nerif.data.volume_file import read_volumes
from nerif.data.volume_sequence import VolumeSequence
from nerif.geometry import Box, Grid
from refusals import refused

pytest.importorskip("zarr", reason="films are stored by zarr (the extra `sequence`)")

GRID = Grid(Box((-1.0, 2.0, -3.0), (3.0, 8.0, 7.0)), (5, 3, 4))
TIMES = (0.0, 1e-4, 2.5e-4, 1e-3)
DONE = (0, 2, 3)  # frame 1 failed


def random(seed: int) -> torch.Tensor:
    return torch.randn(GRID.shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def film(tmp_path: Path) -> VolumeSequence:
    """A film of index and density, masked in one voxel of frame 2, of which frame 1 failed."""
    path = tmp_path / "film.zarr"
    store = VolumeSequence.create(path, TIMES, GRID, ("index_excess", "density"), 1.00027)
    add_frames(store.group, "status", len(TIMES), (), (), "int8", 0)
    for i in DONE:
        density = random(10 + i).masked_fill(torch.arange(60).reshape(GRID.shape) == (17 if i == 2 else -1), np.nan)
        store.write(i, [Volume(1e-4 * random(i), GRID), Volume(density, GRID, "density", "kg m-3")])
        store.array("status")[i] = 1
    store.array("status")[1] = 2
    return VolumeSequence(path)


@pytest.fixture
def velocity(tmp_path: Path) -> VelocitySequence:
    store = VelocitySequence.begin(tmp_path / "velocity.zarr", TIMES[:2], GRID, (), {})
    components = {name: random(k) for k, name in enumerate("uvw")}
    components["u"][1, 0, 2] = np.nan
    store.write_frame(1, components)
    return store


def zone_of(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Return the entries of the zone record and the variables [z, y, x] of a Tecplot file."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    head = re.fullmatch(r'TITLE = "[^"]*"\nVARIABLES = (.*)\nZONE T="[^"]*",(.*)', "\n".join(lines[:3]))
    assert head
    variables, entries = re.findall(r'"([^"]*)"', head[1]), dict(re.findall(r"(\w+)=([^,\s]+)", head[2]))
    shape = tuple(int(entries[axis]) for axis in "KJI")
    table = np.array([[float(word) for word in line.split()] for line in lines[3:]])
    assert np.isfinite(table).all()
    return entries, {name: column.reshape(shape) for name, column in zip(variables, table.T, strict=True)}


def same(read: np.ndarray, values: torch.Tensor) -> bool:
    return np.array_equal(read.astype(np.float32), values.nan_to_num(0).numpy())


def test_a_volume_as_tecplot_text(tmp_path: Path):
    masked = random(1).masked_fill(random(2) > 1, np.nan)
    export(tmp_path / "v.dat", [Volume(random(0), GRID, "extinction", "mm-1"), Volume(masked, GRID, "density")])
    entries, variables = zone_of(tmp_path / "v.dat")
    assert entries == {"I": "4", "J": "3", "K": "5", "DATAPACKING": "POINT"}  # ParaView reads ZONETYPE=ORDERED wrongly
    assert list(variables) == ["X", "Y", "Z", "extinction", "density", "density_valid"]
    for axis, number in (("X", 2), ("Y", 1), ("Z", 0)):
        centres = np.moveaxis(variables[axis], number, -1)
        np.testing.assert_allclose(centres, np.broadcast_to(GRID.axis(axis.lower()).numpy(), centres.shape), rtol=1e-6)
    assert same(variables["extinction"], random(0))
    assert same(variables["density"], masked)
    assert np.array_equal(variables["density_valid"] == 1, masked.isfinite().numpy())


def test_tecplot_text_by_vtk(velocity: VelocitySequence, tmp_path: Path):
    geometry = pytest.importorskip("vtkmodules.vtkIOGeometry", reason="VTK is not installed")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    velocity.export(tmp_path / "v.dat", frame=1)
    reader = geometry.vtkTecplotReader()
    reader.SetFileName(str(tmp_path / "v.dat"))
    reader.Update()
    block = reader.GetOutput().GetBlock(0)
    assert block.GetPoint(59) == pytest.approx([float(GRID.axis(a)[-1]) for a in "xyz"])
    for name in ("u", "speed"):
        array = vtk_to_numpy(block.GetPointData().GetArray(name)).reshape(GRID.shape)
        np.testing.assert_allclose(array, velocity.volume(1, name).values.nan_to_num(0), rtol=1e-6)
        valid = vtk_to_numpy(block.GetPointData().GetArray(f"{name}_valid")).reshape(GRID.shape)
        assert np.argwhere(valid == 0).tolist() == [[1, 0, 2]]


def test_a_film_as_a_list_of_images(film: VolumeSequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "a & ü.pvd"
    assert run("export", film.path, "-o", out) == 0
    printed = capsys.readouterr().out
    assert "2 quantities of 3 frames" in printed
    assert "1 missing or failed frames were left out" in printed
    entries = ElementTree.parse(out).getroot().findall("Collection/DataSet")
    assert [e.get("file") for e in entries] == [f"a & ü/a & ü_{i:04d}.vti" for i in DONE]
    assert [float(str(e.get("timestep"))) for e in entries] == [TIMES[i] for i in DONE]
    for i, entry in zip(DONE, entries, strict=True):
        volumes = read_volumes(out.parent / str(entry.get("file")))
        assert set(volumes) == {"index_excess", "density"}
        for name, volume in volumes.items():
            torch.testing.assert_close(volume.values, film.volume(i, name).values, rtol=0, atol=0, equal_nan=True)
    pyvista = pytest.importorskip("pyvista", reason="the extra `movie` is not installed")
    reader = pyvista.get_reader(out)
    assert reader.time_values == [TIMES[i] for i in DONE]
    reader.set_active_time_value(TIMES[2])
    assert "density" in reader.read()[0].point_data


def test_a_film_as_tecplot_text_has_the_same_variables_in_all_files(film: VolumeSequence, tmp_path: Path):
    done = film.export(tmp_path / "f.dat", quantities=("density",))
    assert (done.path, done.left_out) == (tmp_path / "f", 1)
    assert not (tmp_path / "f.dat").exists()
    for i, path in zip(DONE, sorted(done.path.iterdir()), strict=True):
        assert path.name == f"f_{i:04d}.dat"
        entries, variables = zone_of(path)
        assert (entries["STRANDID"], float(entries["SOLUTIONTIME"])) == ("1", TIMES[i])
        assert list(variables) == ["X", "Y", "Z", "density", "density_valid"]
        assert same(variables["density"], film.volume(i, "density").values)
        assert int((variables["density_valid"] == 0).sum()) == (i == 2)


def test_planes_of_a_velocity_as_text_of_davis(velocity: VelocitySequence, tmp_path: Path):
    assert run("export", velocity.path, "--frame", "1", "-o", tmp_path / "p.txt") == 0
    files = sorted((tmp_path / "p").iterdir())
    assert [file.name for file in files] == [f"p_{k:04d}.txt" for k in range(5)]
    for k, file in enumerate(files):
        head, *rows, last = file.read_bytes().decode("ascii").split("\r\n")
        assert re.fullmatch(
            r'#DaVis 8\S+ 2D-vector 1 3 4 "position" "mm" "position" "mm" "velocity" "m/s"', head + last
        )
        x, y, *uv = np.array([[float(word) for word in row.split("\t")] for row in rows]).T.reshape(4, 3, 4)
        np.testing.assert_allclose(x[0], GRID.axis("x"))
        np.testing.assert_allclose(y[:, 0], GRID.axis("y").flip(0))
        for component, name in zip(uv, "uv", strict=True):
            assert same(component, velocity.volume(1, name).values[k].flip(0))


def test_what_is_written_is_replaced_by_force_and_foreign_files_never(film: VolumeSequence, tmp_path: Path):
    out, folder = tmp_path / "f.pvd", tmp_path / "f"
    film.export(out)
    with refused(out):
        film.export(out)
    with refused(folder):  # of images, not of text
        film.export(tmp_path / "f.dat", force=True)
    out.unlink()
    with refused(folder):
        film.export(out)
    film.array("status")[3] = 0
    film.export(out, force=True)
    assert sorted(path.name for path in folder.iterdir()) == ["f_0000.vti", "f_0002.vti"]
    (folder / "notes.txt").write_text("mine")
    with refused(folder) as error:
        film.export(out, force=True)
    assert "notes.txt" in str(error.value)
    with refused(film.path):  # the folder of this name is the film
        film.export(tmp_path / "film.zarr.pvd", force=True)


def test_an_interruption_leaves_nothing(film: VolumeSequence, tmp_path: Path):
    def stop(done: int, total: int) -> None:
        assert total == 3
        if done == 2:
            raise KeyboardInterrupt

    for name in ("f.pvd", "f.dat"):
        with pytest.raises(Interrupted, match="nothing was written"):
            film.export(tmp_path / name, on_file=stop)
    assert [path.name for path in tmp_path.iterdir()] == ["film.zarr"]


def test_bad_input_is_refused(film: VolumeSequence, velocity: VelocitySequence, tmp_path: Path):
    text, listed = tmp_path / "f.txt", tmp_path / "f.pvd"
    for store, path, frame, quantities, field in (
        (film, text, None, (), "frame"), (film, text, 4, (), "frame"), (film, text, 1, (), "frame"),
        (film, listed, 0, (), listed), (film, listed, None, ("u",), film.path), (film, text, 0, (), "quantities"),
        (velocity, text, 0, ("speed",), "quantities"),
    ):  # fmt: skip
        with refused(field):
            store.export(path, quantities, frame)
    assert run("export", tmp_path, "-o", listed) == 2  # the result of one reconstruction is no film
    film.array("status")[:] = 0
    with refused(film.path):
        film.export(listed)
    assert {path.name for path in tmp_path.iterdir()} == {"film.zarr", "velocity.zarr"}
