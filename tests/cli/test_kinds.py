"""Every command given every other kind of file: it names what it got, and the command that takes it."""

from __future__ import annotations

import re
import shlex
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import tifffile
import xarray as xr

from commands import run
from nerif.common.conventions import InputError
from nerif.common.files import write_toml
from nerif.data import kinds
from nerif.data.cameras_file import FORMAT
from nerif.data.kinds import Kind, check_kind, kind_of
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import Volume, export
from nerif.data.volume_file import read_volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Grid
from nerif.imaging.readers.views import find_views
from nerif.reconstruction.field_files import CHECKPOINT
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import ResultDirectory
from nerif.workflow.sequence.store import SequenceStore

FILES = {
    "m.nc": kinds.MEASUREMENT, "volume.nc": kinds.VOLUME, "volume.vti": kinds.VOLUME, "result": kinds.RESULT,
    "films.zarr": kinds.SEQUENCE, "truth.zarr": kinds.TRUE_SEQUENCE, "store.zarr": kinds.SEQUENCE_RESULT,
    "velocity.zarr": kinds.VELOCITY, "film.nc": kinds.FILM_FILE, "fields.nc": kinds.FILM_FILE,
    "old.zarr": kinds.FORMAT_2, "inside.zip": kinds.ZIPPED_CONTENT, "films.zarr.zip": kinds.ZIPPED,
    "lab": kinds.EXPERIMENT, "listed": kinds.EXPERIMENT, "lab/cam1": kinds.VIEW, "listed/views.toml": kinds.VIEWS,
    "lab/cam1/flow": kinds.IMAGES, "lab/cam1/flow/1.TIF": kinds.IMAGES, "d.npy": kinds.ARRAYS,
    "calibration.toml": kinds.CALIBRATION, "result/run.toml": kinds.SETTINGS,
}  # fmt: skip
STORES = (kinds.SEQUENCE_RESULT, kinds.TRUE_SEQUENCE)
COMMANDS: dict[str, tuple[Kind, ...]] = {
    "info {}": (kinds.MEASUREMENT, kinds.VOLUME, kinds.RESULT, kinds.SEQUENCE),
    "check {}": (kinds.MEASUREMENT, kinds.SEQUENCE),
    "mask {} -o new.nc": (kinds.MEASUREMENT,),
    "reconstruct {} -o new": (kinds.MEASUREMENT,),
    "displacement {} --calibration calibration.toml -o new.nc": (kinds.EXPERIMENT,),
    "project {} -o new.nc": (kinds.RESULT,),
    "project result -o new.nc --cameras {}": (kinds.MEASUREMENT,),
    "evaluate {} --truth volume.nc": (kinds.RESULT, *STORES),
    "evaluate result --truth {}": (kinds.VOLUME,),
    "evaluate result --measurement {}": (kinds.MEASUREMENT,),
    "evaluate store.zarr --truth {}": STORES,
    "sequence {} -o new.zarr": (kinds.SEQUENCE,),
    "velocity {} -o new.zarr": STORES,
    "movie {} -o new.gif": (*STORES, kinds.VELOCITY),
    "report {} -o new.html": (kinds.RESULT, *STORES, kinds.VELOCITY),
    "figures {} -o new": (kinds.RESULT,),
    "export {} -o new.csv": (kinds.RESULT, *STORES, kinds.VELOCITY),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, measurement: Any, ball: Any) -> Path:
    """One file or folder of every kind."""
    out = tmp_path_factory.mktemp("kinds")
    measurement.write(out / "m.nc")
    grid = Grid(measurement.box, (4, 5, 6))
    volume = Volume.of(ball.sample(grid), grid, "index_excess", 1.00027)
    for name in ("volume.nc", "volume.vti"):
        export(out / name, [volume])
    result = ResultDirectory(out / "result")
    result.begin({"method": "tikhonov"})
    result.write_field(Tikhonov(voxels=8, regularisation=1e-3, iterations=2, device="cpu")(measurement))
    films = MeasurementSequence.create(out / "films.zarr", [0.0, 0.1], measurement)
    films.write_frame(0, measurement)
    VolumeSequence.create(out / "truth.zarr", [0.0, 0.1], grid, ["index_excess"], 1.00027)
    VelocitySequence.begin(out / "velocity.zarr", [0.0, 0.1], grid, [], {})
    SequenceStore.begin(out / "store.zarr", films, grid, ["index_excess"], NetworkShape(width=8, depth=2), {})
    for store, file in (("films.zarr", "film.nc"), ("truth.zarr", "fields.nc")):
        with xr.open_zarr(out / store, consolidated=False) as dataset:
            dataset.to_netcdf(out / file, engine="h5netcdf")
            if store == "films.zarr":
                dataset.drop_encoding().to_zarr(out / "old.zarr", zarr_format=2)
    shutil.make_archive(str(out / "inside"), "zip", out / "films.zarr")
    shutil.make_archive(str(out / "films.zarr"), "zip", out, "films.zarr")
    for source in ("reference", "flow"):
        (out / "lab" / "cam1" / source).mkdir(parents=True)
        tifffile.imwrite(out / "lab" / "cam1" / source / "1.TIF", np.zeros((9, 12), dtype=np.uint8))
    (out / "listed").mkdir()
    write_toml(out / "listed" / "views.toml", {"views": {"left": {"flow": "1.tif"}}})
    np.save(out / "d.npy", np.zeros((2, 9, 12, 2)))
    write_toml(out / "calibration.toml", {"format": FORMAT})
    (out / "empty").mkdir()
    return out


def test_kinds_are_recognised(folder):
    assert {name: kind_of(folder / name) for name in FILES} == FILES
    (folder / "cut.nc").write_bytes((folder / "m.nc").read_bytes()[:900])
    for name in ("empty", "cut.nc", "none.nc"):
        assert kind_of(folder / name) is None
        check_kind(folder / name, kinds.VOLUME)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_names_the_kind_that_it_got(folder, monkeypatch, refusal, command):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    for kind, name in {kind: name for name, kind in FILES.items()}.items():  # one of each
        if kind not in COMMANDS[command]:
            line = refusal(*(word.replace("{}", name) for word in command.split()))
            use = kind.use.format(path=name, parent=Path(name).parent)
            assert line.startswith(f"nerif: {name}: expected "), line
            assert line.endswith(f", got {kind.name}; {use}\n"), line
    assert sorted(folder.rglob("*")) == before


@pytest.mark.filterwarnings("ignore:The data type")  # of texts of fixed length, by zarr
@pytest.mark.parametrize("name", ["film.nc", "old.zarr", "inside.zip", "films.zarr.zip"])
def test_a_film_in_another_form_is_read_after_the_conversion_that_is_named(folder, tmp_path, monkeypatch, name):
    use = kind_of(folder / name).use
    _, option, code, *arguments = shlex.split(use[use.index("python") :].replace("{path}", str(folder / name)))
    monkeypatch.chdir(tmp_path)
    if option == "-c":
        monkeypatch.setattr("sys.argv", ["-c", *arguments])
        exec(code, {})
    else:
        assert [option, code] == ["-m", "zipfile"]
        zipfile.main(arguments)
    (store,) = tmp_path.iterdir()
    ours, expected = MeasurementSequence.read(store), MeasurementSequence.read(folder / "films.zarr")
    assert ours.times == expected.times
    assert np.array_equal(ours.frame(0).displacement, expected.frame(0).displacement, equal_nan=True)


def test_a_command_to_copy_contains_no_command_of_a_name(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, word in (("$(x); x.nc", "'$(x); x.nc'"), ("--force.nc", "./--force.nc")):
        shutil.copy(folder / "m.nc", name)
        with pytest.raises(InputError, match=re.escape(f"nerif reconstruct {word} -o RESULT")):
            check_kind(name, kinds.RESULT)
    folder = tmp_path / "-o `x`"
    ResultDirectory(folder).begin({})
    (folder / CHECKPOINT).touch()
    assert "nerif reconstruct --resume -o './-o `x`'." in ResultDirectory("-o `x`").read().missing[0].sentence


VECTORS = {
    "PIVlab_0001.txt": "PIVlab by W.Th. & E.J.S., ASCII chart output\nFRAME: 1\nx [px],y [px],u [px/frame]\n",
    "B00001.dat": 'TITLE = "B00001"\nVARIABLES = "x", "y", "Vx", "Vy", "isValid"\nZONE T="Frame 0", I=9, J=9\n',
    "B00001.txt": '#DaVis 8.4.0 2D-vector 16 9 9 "position" "mm" "position" "mm" "velocity" "m/s"\n1\t2\t3\t4\n',
    "run.vec": 'TITLE="run" VARIABLES="X mm", "Y mm", "U m/s", "V m/s", "CHC", ZONE I=9, J=9, F=POINT\n',
    "Export.csv": ">>*HEADER*<<\nFileID:DSExport.CSV\nVersion:2\n",
    "open.txt": "# x\ty\tu\tv\tflags\tmask\n1 2 3 4 0 0\n",
    "columns.txt": "16.0\t16.0\t0.12\t-0.3\t0\n", "table.csv": "X (mm);Y (mm);Vx (m/s);Vy (m/s)\n1;2;3;4\n",
    "B00001.vc7": "\x00\x01", "PIVlab.mat": "u_original typevector_original", "piv.mat": "x y u v",
    "v.nc": "piv_data piv_flags", "xarray.nc": "u v chc",
}  # fmt: skip
NAMES = ["PIVlab", "DaVis", "DaVis", "Insight", "Dynamic Studio", "OpenPIV", "", ""]
NAMES += ["DaVis", "PIVlab", "", "PIVview", ""]


@pytest.mark.parametrize(("name", "program"), [*zip(VECTORS, NAMES, strict=True)])
def test_vectors_of_other_programs_are_named_and_where_to_go(folder, tmp_path, monkeypatch, refusal, name, program):
    monkeypatch.chdir(tmp_path)
    content = VECTORS[name]
    maps = dict.fromkeys(content.split(), np.zeros((2, 3)))
    if name.endswith(".mat"):
        scipy.io.savemat(name, maps)
    elif name.endswith(".nc"):
        xr.Dataset({key: (("row", "column"), value) for key, value in maps.items()}).to_netcdf(name, engine="h5netcdf")
    else:
        Path(name).write_text(content)
    got = f"got vectors of {program or 'another program'}; put them into FOLDER/VIEW, and read them: nerif vectors "
    for command in ("info {}", "calibrate {}"):
        assert got in refusal(*command.format(name).split())
    for other in ("name,fx,fy\na,1,1\n", "rx,ry,rz,tx,ty,tz\n1,2,3,4,5,6\n", "cores: 4\n", "a few words, x and y\n"):
        Path("other.txt").write_text(other)
        assert kind_of("other.txt") is None


@pytest.mark.parametrize("command", COMMANDS)
def test_a_folder_that_holds_nothing_is_not_a_missing_one(folder, monkeypatch, refusal, command):
    monkeypatch.chdir(folder)
    for name, words in (("empty", "no such"), ("none", "")):
        line = refusal(*(word.replace("{}", name) for word in command.split()))
        assert line.startswith(f"nerif: {name}: ")
        assert not words or words not in line


def test_info_describes_its_kinds(folder, capsys):
    for name, kind in FILES.items():
        if kind in COMMANDS["info {}"]:
            assert run("info", folder / name) == 0
            assert str(folder / name) in capsys.readouterr().out


def test_python_refuses_as_the_commands_do(folder):
    for read, name in ((Measurement.read, "lab"), (read_volume, "m.nc"), (find_views, "m.nc"), (VolumeSequence, "lab")):
        with pytest.raises(InputError, match=f", got {FILES[name].name}".replace("(", r"\(").replace(")", r"\)")):
            read(folder / name)
