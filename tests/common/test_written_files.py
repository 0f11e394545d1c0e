"""Foreign files are never overwritten or removed: not by --force, a later command or a forged list."""

from __future__ import annotations

import errno
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nerif.cli.cli import main
from nerif.cli.commands import demo, reconstruct, simulate
from nerif.common.conventions import InputError
from nerif.common.files import atomic
from nerif.common.written_files import ABOUT, WRITTEN, OwnFiles
from nerif.data.measurement_sequence import MEASUREMENTS, MeasurementSequence, check_store
from nerif.data.volume_sequence import FIELDS
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.results.directory import CALIBRATION, FIGURES, METRICS, REPORT, RUN, ResultDirectory
from nerif.results.metrics_file import Metrics
from nerif.simulation.experiment import Experiment
from refusals import refused
from sequence_films import QUICK, simulated


def put(path: Path, text: str = "mine") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def write_own(directory: Path, *names: str) -> None:
    """Let the program write files."""
    directory.mkdir(parents=True, exist_ok=True)
    for name in names:
        with OwnFiles(directory).writing(name) as path:
            path.write_text("{}")


@pytest.fixture
def result(tmp_path, lines) -> ResultDirectory:
    """The directory of a run with trials and figures."""
    result = ResultDirectory(tmp_path / "r", lines.append)
    result.begin({"seed": 1})
    result.write_metrics(Metrics(seconds=1))
    write_own(result.path, REPORT, CALIBRATION)
    for folder in (result.member(1).path, result.member(2).path, result.cross_validation.path):
        write_own(folder, "views.json", "field.safetensors")
    write_own(result.path / FIGURES, "views.pdf", "slices.pdf")
    assert not lines
    return result


def contents(directory: Path) -> set[str]:
    return {str(p.relative_to(directory)) for p in directory.rglob("*") if p.is_file()} - {WRITTEN}


@pytest.mark.parametrize("copied", [False, True])
def test_a_forced_run_removes_the_files_of_the_former_and_no_others(result, lines, copied):
    foreign = ("figures/by_hand.svg", "trials/notes.txt", "trials/01/remark.txt", "notes.txt", "measurement.nc")
    for name in foreign:
        put(result / name)
    if copied:  # without its times
        copy = result.path.with_name("copy")
        shutil.copytree(result.path, copy, copy_function=shutil.copyfile)
        result = ResultDirectory(copy, lines.append)
    result.begin({"seed": 2})
    assert contents(result.path) == {RUN, *foreign}
    assert all((result / name).read_text() == "mine" for name in foreign)
    assert not (result / "cross_validation").exists()
    assert not lines
    assert result.settings()["seed"] == 2


def test_changed_files_are_kept_and_named(result, lines):
    for path in (result / "figures" / "views.pdf", result / CALIBRATION, result / METRICS):
        put(path, "improved by hand")
    result.begin({})
    for name in ("figures/views.pdf", CALIBRATION, "metrics.before.json"):  # the run needs the name of the last
        assert (result / name).read_text() == "improved by hand"
    assert not (result / METRICS).exists()
    for name in ("views.pdf", CALIBRATION, "metrics.before.json"):
        assert any(name in line for line in lines)


def test_foreign_files_are_renamed(tmp_path, lines):
    result = ResultDirectory(tmp_path, lines.append)
    foreign = {CALIBRATION: "a day's work", "volume.nc": "an export", RUN: "# notes on a run\n"}
    for name, text in foreign.items():
        put(tmp_path / name, text)
    for _ in range(2):
        result.begin({})
        assert (tmp_path / CALIBRATION).read_text() == "a day's work"  # a run writes none
    assert (tmp_path / "volume.before.nc").read_text() == "an export"
    assert (tmp_path / "run.before.toml").read_text() == "# notes on a run\n"
    for _ in range(2):  # but --refine does
        with result.writing(CALIBRATION) as path:
            path.write_text("refined")
    result.begin({})
    assert not (tmp_path / CALIBRATION).exists()
    assert (tmp_path / "calibration.before.toml").read_text() == "a day's work"
    assert sum("renamed to" in line for line in lines) == 3


def test_renaming_never_overwrites(tmp_path, lines):
    files = OwnFiles(tmp_path, lines.append)
    for text in ("first", "second", "third"):
        put(tmp_path / "a.nc", text)
        files.set_aside(["a.nc", "missing.nc"])
    assert [(tmp_path / f"a.before{n}.nc").read_text() for n in ("", "2", "3")] == ["first", "second", "third"]
    assert len(lines) == 3


@pytest.mark.parametrize("name", ["../precious.txt", "/etc/hostname", "sub/precious.txt", ""])
def test_a_forged_list_reaches_nothing_outside_the_directory(tmp_path, name):
    precious = [put(tmp_path / "precious.txt"), put(tmp_path / "r" / "sub" / "precious.txt")]
    about = precious[0].stat()
    entry = {"bytes": about.st_size, "changed_ns": about.st_mtime_ns, "sha256": "0"}
    put(tmp_path / "r" / WRITTEN, json.dumps({"about": ABOUT, "files": {name: entry}}))
    OwnFiles(tmp_path / "r").remove()
    assert all(path.read_text() == "mine" for path in precious)


@pytest.mark.parametrize("text", ["", "[]", "3", '{"a.nc": 3}', '{"a.nc": {}}'])
def test_a_damaged_list_removes_nothing(tmp_path, text):
    put(tmp_path / WRITTEN, f'{{"about": "{ABOUT}", "files": {text}}}' if text else text)
    put(tmp_path / "a.nc")
    files = OwnFiles(tmp_path, lambda line: None)
    files.remove(["a.nc"])
    assert (tmp_path / "a.nc").is_file()
    assert "a.nc" not in files


@pytest.mark.parametrize("before", ["", "old"])
def test_after_a_failed_write_a_later_file_of_that_name_is_foreign(tmp_path, lines, before):
    files = OwnFiles(tmp_path, lines.append)
    if before:
        with files.writing("a.nc") as path:
            path.write_text(before)
    with pytest.raises(OSError), files.writing("a.nc") as path, atomic(path) as part:  # noqa: PT012
        part.write_text("half")
        raise OSError(errno.ENOSPC, "full")
    assert ("a.nc" in files) == bool(before)
    put(tmp_path / "a.nc", "measured since")
    assert "a.nc" not in files
    files.remove()
    assert (tmp_path / "a.nc").read_text() == "measured since"


def test_a_users_own_list_is_renamed(tmp_path, lines):
    put(tmp_path / WRITTEN, '{"files": {"a.nc": {"pending": true}}}')
    put(tmp_path / "a.nc")
    files = OwnFiles(tmp_path, lines.append)
    files.remove()
    assert (tmp_path / "a.nc").is_file()
    with files.writing("b.nc") as path:
        path.touch()
    assert "a.nc" in (tmp_path / "written.before.json").read_text()
    assert "b.nc" in files
    assert len(lines) == 1


def test_two_processes_that_write_at_once_keep_both_entries(tmp_path):
    code = "import sys; from nerif.common.written_files import OwnFiles\n"
    code += "for i in range(40):\n    with OwnFiles(sys.argv[1]).writing(f'{sys.argv[2]}{i}') as p: p.touch()"
    line = [sys.executable, "-c", code, str(tmp_path)]
    processes = [subprocess.Popen([*line, name]) for name in "ab"]
    assert [process.wait(60) for process in processes] == [0, 0]
    assert all(f"{name}{i}" in OwnFiles(tmp_path) for name in "ab" for i in range(40))


def test_a_link_is_foreign(tmp_path):
    write_own(tmp_path / "r", "volume.nc")
    elsewhere = tmp_path / "elsewhere.nc"
    shutil.move(tmp_path / "r" / "volume.nc", elsewhere)
    (tmp_path / "r" / "volume.nc").symlink_to(elsewhere)
    OwnFiles(tmp_path / "r", lambda line: None).remove()
    assert (tmp_path / "r" / "volume.nc").is_symlink()
    assert elsewhere.is_file()


def test_the_demo_keeps_a_foreign_measurement(tmp_path, monkeypatch):
    out = tmp_path / "demo"
    put(out / "measurement.nc", "measured in the laboratory")

    def write(words):
        for name in ("measurement.nc", "measurement.truth.nc"):
            put(out / name, "simulated")

    def stop(words):
        raise KeyboardInterrupt

    monkeypatch.setattr(simulate, "main", write)
    monkeypatch.setattr(reconstruct, "main", stop)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            demo.run(demo.Demo(out=out, force=True))
    assert (out / "measurement.before.nc").read_text() == "measured in the laboratory"
    assert contents(out) == {"measurement.nc", "measurement.before.nc", "measurement.truth.nc"}


def test_foreign_images_are_not_replaced_by_rendered_ones(tmp_path):
    box, cameras = Box.around_origin((50.0, 50.0, 50.0)), Ring(views=2).cameras(0.0)
    write_own(tmp_path / cameras[0].name / "flow", "flow_000.tif")
    foreign = put(tmp_path / cameras[1].name / "reference" / "reference_000.tif")
    with refused(foreign.parent):
        Experiment().write(tmp_path, cameras, make_phantom("gaussians", box, 0), box, 1.00027)
    assert foreign.read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 2  # nothing was written


def test_a_store_replaces_only_one_of_its_kind(tmp_path):
    def store(name: str, attributes: dict, *arrays: str) -> Path:
        for part in ("", *arrays):
            put(tmp_path / name / part / "zarr.json", json.dumps({"attributes": attributes}))
        return tmp_path / name

    fields = store("f.zarr", {"box_lower_mm": [0]}, "density")
    measurements = store("m.zarr", {}, "written", "displacement")
    check_store(fields, FIELDS)
    check_store(measurements, MEASUREMENTS)
    check_store(tmp_path / "none.zarr", FIELDS)
    folder, file = put(tmp_path / "photos.zarr" / "a.jpg").parent, put(tmp_path / "file.zarr")
    for path, kind in ((measurements, FIELDS), (fields, MEASUREMENTS), (folder, FIELDS), (file, MEASUREMENTS)):
        with refused(path):
            check_store(path, kind)
    put(fields / "notes.txt")
    with pytest.raises(InputError, match=r"notes\.txt"):
        check_store(fields, FIELDS)


def test_a_sequence_is_not_overwritten_by_its_own_reconstruction(tmp_path, capsys):
    pytest.importorskip("zarr", reason="pip install '.[sequence]'")
    film = simulated(tmp_path / "film.zarr", 2)
    capsys.readouterr()
    assert main(["sequence", str(film), "-o", str(film), "--force", *QUICK]) == 2
    assert "is not fields over time" in capsys.readouterr().err
    assert len(MeasurementSequence.read(film)) == 2
