"""Nothing of a person's is overwritten or removed: not by --force, not by a later verb, not by a list made up."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.common.written_files import WRITTEN, OwnFiles
from nerif.results.directory import CALIBRATION, FIGURES, METRICS, REPORT, RUN, ResultDirectory


def put(path: Path, text: str = "mine") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def written(directory: Path, *names: str) -> None:
    """Let the program write files."""
    directory.mkdir(parents=True, exist_ok=True)
    for name in names:
        with OwnFiles(directory).writing(name) as path:
            path.write_text("{}")


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def result(tmp_path, said) -> ResultDirectory:
    """A directory that a run has written to, with repetitions and figures."""
    found = ResultDirectory(tmp_path / "r", said.append)
    found.begin({"seed": 1})
    found.write_metrics({"seconds": 1})
    written(found.path, REPORT, CALIBRATION)
    for folder in (found.member(1).path, found.member(2).path, found.cross_validation.path):
        written(folder, "asked.json", "field.safetensors")
    written(found.path / FIGURES, "views.pdf", "slices.pdf")
    assert not said
    return found


def contents(directory: Path) -> set[str]:
    return {str(p.relative_to(directory)) for p in directory.rglob("*") if p.is_file()} - {WRITTEN}


def test_a_forced_run_removes_what_the_one_before_wrote_and_nothing_else(result, said):
    own = ("figures/drawn_by_hand.svg", "trials/notes.txt", "trials/01/remark.txt", "notes.txt", "measurement.nc")
    for name in own:
        put(result / name)
    result.begin({"seed": 2})
    assert contents(result.path) == {RUN, *own}
    assert all((result / name).read_text() == "mine" for name in own)
    assert not (result / "cross_validation").exists()
    assert not said
    assert result.settings()["seed"] == 2


def test_what_was_changed_since_stays_and_is_named(result, said):
    put(result / "figures" / "views.pdf", "improved by hand")
    put(result / CALIBRATION, "improved by hand")
    put(result / METRICS, "improved by hand")
    result.begin({})
    assert (result / "figures" / "views.pdf").read_text() == "improved by hand"
    assert (result / CALIBRATION).read_text() == "improved by hand"
    assert (result / "metrics.before.json").read_text() == "improved by hand"  # the run needs the name
    assert not (result / METRICS).exists()
    assert any("views.pdf" in line for line in said)
    assert any(CALIBRATION in line for line in said)
    assert any("it is metrics.before.json now" in line for line in said)


def test_a_calibration_that_the_run_did_not_write_is_never_lost(tmp_path, said):
    result = ResultDirectory(tmp_path, said.append)
    put(tmp_path / CALIBRATION, "a day's work")
    for _ in range(2):
        result.begin({})
        assert (tmp_path / CALIBRATION).read_text() == "a day's work"
    assert any(CALIBRATION in line for line in said)
    for _ in range(2):  # --refine writes one
        with result.writing(CALIBRATION) as path:
            path.write_text("refined")
    result.begin({})
    assert not (tmp_path / CALIBRATION).exists()
    assert (tmp_path / "calibration.before.toml").read_text() == "a day's work"


def test_renaming_never_overwrites(tmp_path, said):
    files = OwnFiles(tmp_path, said.append)
    for text in ("first", "second", "third"):
        put(tmp_path / "a.nc", text)
        files.set_aside(["a.nc", "missing.nc"])
    found = [(tmp_path / f"a.before{n}.nc").read_text() for n in ("", "2", "3")]
    assert found == ["first", "second", "third"]
    assert len(said) == 3


def test_a_result_without_a_list_loses_only_what_a_run_writes_for_certain(result, said):
    for manifest in result.path.rglob(WRITTEN):
        manifest.unlink()
    result.begin({}, resume=True)
    assert contents(result.path) >= {METRICS, REPORT}
    assert not said
    for manifest in result.path.rglob(WRITTEN):
        manifest.unlink()
    result.begin({})
    assert contents(result.path) == {RUN, CALIBRATION, "figures/views.pdf", "figures/slices.pdf"}


def test_files_of_a_folder_that_is_no_result_are_renamed(tmp_path, said):
    put(tmp_path / "volume.nc", "an export")
    put(tmp_path / RUN, "# my own notes on a run\n")
    ResultDirectory(tmp_path, said.append).begin({})
    assert (tmp_path / "volume.before.nc").read_text() == "an export"
    assert (tmp_path / "run.before.toml").read_text() == "# my own notes on a run\n"
    assert len(said) == 2


def test_a_copy_of_a_result_is_still_known(result, tmp_path, said):
    shutil.copytree(result.path, tmp_path / "copy", copy_function=shutil.copyfile)  # without its times
    copy = ResultDirectory(tmp_path / "copy", said.append)
    copy.begin({})
    assert contents(copy.path) == {RUN}
    assert not said


@pytest.mark.parametrize("name", ["../precious.txt", "/etc/hostname", "sub/precious.txt", ""])
def test_a_list_from_elsewhere_reaches_nothing_outside_the_directory(tmp_path, name):
    precious = [put(tmp_path / "precious.txt"), put(tmp_path / "r" / "sub" / "precious.txt")]
    about = precious[0].stat()
    entry = {"bytes": about.st_size, "changed_ns": about.st_mtime_ns, "sha256": "0"}
    put(tmp_path / "r" / WRITTEN, json.dumps({"files": {name: entry}}))
    OwnFiles(tmp_path / "r").remove()
    assert all(path.read_text() == "mine" for path in precious)


@pytest.mark.parametrize("text", ["", "[]", '{"files": 3}', '{"files": {"a.nc": 3}}', '{"files": {"a.nc": {}}}'])
def test_by_a_damaged_list_nothing_is_removed(tmp_path, text):
    put(tmp_path / WRITTEN, text)
    put(tmp_path / "a.nc")
    files = OwnFiles(tmp_path, lambda line: None)
    files.remove(["a.nc"])
    assert (tmp_path / "a.nc").is_file()
    assert "a.nc" not in files


def test_a_link_is_nobodys_file(tmp_path):
    written(tmp_path / "r", "volume.nc")
    elsewhere = tmp_path / "elsewhere.nc"
    shutil.move(tmp_path / "r" / "volume.nc", elsewhere)
    (tmp_path / "r" / "volume.nc").symlink_to(elsewhere)
    OwnFiles(tmp_path / "r", lambda line: None).remove()
    assert (tmp_path / "r" / "volume.nc").is_symlink()
    assert elsewhere.is_file()


def test_the_demo_keeps_a_measurement_that_is_not_its_own(tmp_path, monkeypatch):
    from nerif.cli.commands import demo

    out = tmp_path / "demo"
    put(out / "measurement.nc", "measured in the laboratory")

    class EnoughError(Exception):
        pass

    def enough(settings):
        assert settings.measurement.is_file()
        raise EnoughError

    def simulated(settings):
        for path in (settings.out, demo.simulate.truth_path(settings.out)):
            put(path, "simulated")

    monkeypatch.setattr(demo.simulate, "run", simulated)
    monkeypatch.setattr(demo.reconstruct, "run", enough)
    for _ in range(2):
        with pytest.raises(EnoughError):
            demo.run(demo.Demo(out=out, force=True))
    assert (out / "measurement.before.nc").read_text() == "measured in the laboratory"
    assert contents(out) == {"measurement.nc", "measurement.before.nc", "measurement.truth.nc"}


def test_images_that_were_not_rendered_are_not_rendered_over(tmp_path):
    from nerif.fields.phantoms import make_phantom
    from nerif.geometry import Box, Ring
    from nerif.simulation.experiment import Experiment

    box = Box.around_origin((50.0, 50.0, 50.0))
    cameras = Ring(views=2).cameras(0.0)
    written(tmp_path / cameras[0].name / "flow", "flow_000.tif")
    real = put(tmp_path / cameras[1].name / "reference" / "reference_000.tif")
    with pytest.raises(InputError, match=r"holds reference_000\.tif, which nerif render did not write"):
        Experiment().write(tmp_path, cameras, make_phantom("gaussians", box, 0), box, 1.00027)
    assert real.read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 2  # nothing was begun


def test_a_store_takes_the_place_of_one_of_its_kind_alone(tmp_path):
    pytest.importorskip("zarr", reason="pip install '.[sequence]'")
    from nerif.data.measurement_sequence import MEASUREMENTS, check_store
    from nerif.data.volume_sequence import FIELDS

    def store(name: str, attributes: dict, *arrays: str) -> Path:
        for part in ("", *arrays):
            put(tmp_path / name / part / "zarr.json", json.dumps({"attributes": attributes}))
        return tmp_path / name

    fields, measured = store("f.zarr", {"box_lower_mm": [0]}, "density"), store("m.zarr", {}, "written", "displacement")
    check_store(fields, FIELDS)
    check_store(measured, MEASUREMENTS)
    check_store(tmp_path / "none.zarr", FIELDS)
    folder, file = put(tmp_path / "photos.zarr" / "a.jpg").parent, put(tmp_path / "file.zarr")
    for path, kind in ((measured, FIELDS), (fields, MEASUREMENTS), (folder, FIELDS), (file, MEASUREMENTS)):
        with pytest.raises(InputError, match="exists already, is not"):
            check_store(path, kind)
    put(fields / "notes.txt")
    with pytest.raises(InputError, match=r"since notes\.txt in it is not part of the store"):
        check_store(fields, FIELDS)


def test_a_film_is_not_overwritten_by_its_own_reconstruction(tmp_path, capsys):
    pytest.importorskip("zarr", reason="pip install '.[sequence]'")
    from nerif.data.measurement_sequence import MeasurementSequence
    from sequence_films import QUICK, simulated

    film = simulated(tmp_path / "film.zarr", 2)
    capsys.readouterr()
    assert main(["sequence", str(film), "-o", str(film), "--force", *QUICK]) == 2
    assert "is not fields over time, and was left as it is" in capsys.readouterr().err
    assert len(MeasurementSequence.read(film)) == 2
