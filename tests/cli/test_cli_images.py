"""The commands from images to a measurement, on a small rendered experiment."""

from __future__ import annotations

import shutil
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
import torch
from scipy.spatial.transform import Rotation

from commands import metrics_of, run
from nerif.data.cameras_file import read_cameras
from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.fields.phantoms import make_phantom
from nerif.simulation.rendering import render
from nerif.simulation.simulate import view_displacement

BOX = str.split("--lower -25 -25 -25 --upper 25 25 25")
VIEWS = 4
QUICK = ("--method", "dis")  # where the method does not matter


@pytest.fixture(scope="session")
def experiment(tmp_path_factory):
    """Images of four views, a calibration and a measurement, each made by its command."""
    folder = tmp_path_factory.mktemp("experiment")
    words = str.split(f"--phantom gaussians --views {VIEWS} --arc 10 120 --image-size 80 92 --pixel-pitch 0.051")
    words += str.split("--background-distance 900 --references 3 --poses 8 --backgrounds 2 --truth-voxels 20")
    words += str.split("--columns 8 --rows 5")
    images = folder / "images"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nerif.simulation.experiment.render", partial(render, steps=40))
        assert run("render", "-o", images, *words) == 0
    assert run(*calibrate(folder)) == 0
    assert run(*displacement(folder)) == 0
    return folder


def calibrate(folder: Path, *more: object, out: str = "calibration.toml") -> list[object]:
    images = folder / "images"
    return ["calibrate", images, "--config", images / "calibrate.toml", "-o", folder / out, *more]


def displacement(folder: Path, *more: object, out: Path | None = None) -> list[object]:
    words = ["displacement", folder / "images", "--calibration", folder / "calibration.toml"]
    return [*words, *BOX, "-o", out or folder / "m.nc", *more]


@pytest.fixture
def copy(experiment, tmp_path):
    """A copy of the experiment."""
    return shutil.copytree(experiment, tmp_path / "copy")


def views_of(folder: Path) -> list[Path]:
    return [view for view in sorted((folder / "images").iterdir()) if (view / "flow").is_dir()]


def test_calibration_agrees_with_the_rendered_rig(experiment):
    truth = read_cameras(experiment / "images/truth/calibration.toml")
    cameras = read_cameras(experiment / "calibration.toml")
    assert [c.name for c in cameras] == [c.name for c in truth]
    points = torch.from_numpy(np.random.default_rng(0).uniform(-15, 15, (50, 3)))
    for a, b in zip(cameras, truth, strict=True):
        # a narrow lens does not separate rotation and principal point, nor focal length and distance (0.5 to 0.9 %)
        assert np.degrees(Rotation.from_matrix((a.rotation @ b.rotation.T).numpy()).magnitude()) < 0.5
        assert float((a.camera().project(points) - b.camera().project(points)).abs().max()) < 0.1
        assert abs(a.background.offset - b.background.offset) < 3 * 0.009 * abs(b.background.offset)
    for name in ("calibration.rig.png", "calibration.errors.png"):
        assert iio.imread(experiment / name).std() > 10


def test_measurement_agrees_with_the_rendered_phantom(experiment):
    measurement = Measurement.read(experiment / "m.nc")
    assert len(measurement.cameras) == VIEWS
    assert measurement.sigma is not None
    phantom = make_phantom("gaussians", measurement.box, 0)
    truth = {c.name: c.camera() for c in read_cameras(experiment / "images/truth/calibration.toml")}
    deflection, images = measurement.observations
    assert images.technique.name == "images"
    assert float(measurement.usable_for(images).float().mean()) > 0.98
    usable = measurement.usable_for(deflection)
    for i, name in enumerate(measurement.names):
        d = view_displacement(phantom, truth[name], measurement.box, measurement.n_ambient, steps=40)
        assert float(usable[i].float().mean()) > 0.9
        values = measurement.displacement[i][usable[i]]
        assert float((values - d[usable[i]]).norm(dim=-1).median()) < 0.05
        assert np.corrcoef(values.ravel(), d[usable[i]].ravel())[0, 1] > 0.97
    assert iio.imread(experiment / "m.png").std() > 10
    assert read_volume(experiment / "images/truth/volume.nc").values.shape == (20, 20, 20)


@pytest.mark.slow
def test_the_field_agrees_with_the_rendered_phantom(experiment):
    """With only four views; examples/from_images.py has nine (test_examples.py, slow)."""
    words = str.split("--method tikhonov --voxels 16 --basis linear --regularisation 3e-3 --no-report")
    assert run("reconstruct", experiment / "m.nc", "-o", experiment / "r", *words) == 0
    assert run("evaluate", experiment / "r", "--truth", experiment / "images/truth/volume.nc") == 0
    assert metrics_of(experiment / "r")["cc"] > 0.9


@pytest.mark.slow
def test_reconstruction_from_images(experiment, tmp_path, refusal):
    out, measurement = tmp_path / "result", Measurement.read(experiment / "m.nc")
    withheld = measurement.names[1]
    words = ["reconstruct", experiment / "m.nc", "-o", out, "--from", "images", "--withhold", withheld]
    assert run(*words, "--max-steps", "40", "--voxels", "16", "--points-per-batch", "2048") == 0
    assert tomllib.loads((out / "run.toml").read_text())["from"] == "images"
    scores = {(v["name"], v["measured"]) for v in metrics_of(out)["views"] if v["withheld"]}
    assert scores == {(withheld, "displacement"), (withheld, "flow")}
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") >= 3 * 3 * VIEWS  # measured, predicted, difference of u, v and flow
    settings = out / "run.toml"
    settings.write_text(settings.read_text().replace('from = "images"', 'from = "displacements"'))
    assert run("reconstruct", "--config", settings, "-o", tmp_path / "again", "--no-report") == 0
    assert tomllib.loads((tmp_path / "again/run.toml").read_text())["from"] == "displacements"
    assert "displacements" in refusal(*words[:4], "--force", "--from", "videos")
    replace(measurement, maps={}).write(tmp_path / "plain.nc")
    line = refusal("reconstruct", tmp_path / "plain.nc", "-o", tmp_path / "none", "--from", "images")
    assert "variables reference and flow" in line


def test_nothing_is_overwritten_without_force(experiment, refusal):
    for words in (displacement(experiment), calibrate(experiment), ["render", "-o", experiment / "images"]):
        assert "--force" in refusal(*words)


def test_bad_images_are_left_out(copy, capsys):
    first, second, third, *_ = views_of(copy)
    (first / "reference/reference_001.tif").write_bytes(b"broken")
    (second / "flow/flow_000.tif").unlink()
    tifffile.imwrite(third / "flow/flow_000.tif", np.zeros((50, 60), np.uint16))
    assert run(*displacement(copy, "--force", *QUICK)) == 0
    lines = capsys.readouterr().out
    for text in ("reference_001.tif", f"view '{second.name}' left out", f"view '{third.name}' left out"):
        assert text in lines
    assert len(Measurement.read(copy / "m.nc").cameras) == VIEWS - 2


def test_without_any_valid_view_the_old_measurement_stays(copy, refusal):
    for flow in (copy / "images").glob("*/flow/*.tif"):
        flow.write_bytes(b"")
    before = (copy / "m.nc").read_bytes()
    assert "no view" in refusal(*displacement(copy, "--force"))
    assert (copy / "m.nc").read_bytes() == before


@pytest.mark.parametrize(
    ("more", "field"),
    [
        ("--frame 3", "frame, average: "),
        ("--frame -1", "frame: "),
        ("--method piv", "--method"),
        ("--views none", "views: "),
        ("--frame-offset none 1", "--frame-offset: unknown view 'none'"),
        ("--frame-offset none", "--frame-offset"),
        ("--average 0", "average: expected 1 or more"),
        ("--frames all", "out: expected a name ending in .zarr"),
    ],
)
def test_invalid_options_of_displacement(experiment, refusal, more, field):
    assert field in refusal(*displacement(experiment, "--force", *more.split()))


def test_calibration_of_other_views_or_sizes(copy, refusal):
    file = copy / "calibration.toml"
    text, name = file.read_text(), read_cameras(file)[0].name
    file.write_text(text.replace(f'name = "{name}"', 'name = "other"'))
    assert f"no camera named '{name}'" in refusal(*displacement(copy, "--force"))
    resized = text.replace("    80,\n    92,\n", "    160,\n    184,\n")
    assert resized != text
    file.write_text(resized)
    assert "(160, 184)" in refusal(*displacement(copy, "--force"))


@pytest.mark.slow
def test_masks_by_threshold_and_drawn(experiment, tmp_path, capsys, refusal):
    words = ["mask", experiment / "m.nc", "-o"]
    assert run(*words, tmp_path / "masked.nc", "--threshold", "3") == 0
    assert "visual hull" in capsys.readouterr().out
    masked = Measurement.read(tmp_path / "masked.nc")
    strong = masked.displacement.norm(dim=-1) > 0.3
    assert bool(masked.flow_mask[strong & masked.usable].all())
    assert 0.02 < float(masked.flow_mask.float().mean()) < 0.9
    assert iio.imread(tmp_path / "masked.masks.png").std() > 10
    drawing = np.full((80, 92), 255, np.uint8)
    drawing[:10] = 0
    (tmp_path / "drawn").mkdir()
    iio.imwrite(tmp_path / f"drawn/{masked.names[1]}.png", drawing)
    assert run(*words, tmp_path / "again.nc", "--threshold", "3", "--drawings", tmp_path / "drawn") == 0
    flow_mask = Measurement.read(tmp_path / "again.nc").flow_mask
    assert not flow_mask[1, :10].any()
    assert flow_mask[1, 10:].all()
    assert torch.equal(flow_mask[0], masked.flow_mask[0])
    assert run("mask", tmp_path / "again.nc", "-o", tmp_path / "none.nc", "--remove") == 0
    assert Measurement.read(tmp_path / "none.nc").flow_mask is None
    assert "no flow" in refusal(*words, tmp_path / "empty.nc", "--threshold", "1000")
    assert "views" in refusal(*words, tmp_path / "empty.nc", "--drawings", tmp_path)
    assert not (tmp_path / "empty.nc").exists()
    assert run(*displacement(experiment, "--mask", "4", *QUICK, out=tmp_path / "m.nc")) == 0
    assert 0 < float(Measurement.read(tmp_path / "m.nc").flow_mask.float().mean()) < 1


def test_check_draws_the_rig_of_calibrations_and_measurements(experiment, tmp_path):
    for source in ("calibration.toml", "m.nc"):
        out = (tmp_path / source).with_suffix(".toml")
        assert run("calibrate", experiment / source, "--check", "-o", out, *BOX) == 0
        assert iio.imread(out.with_suffix(".rig.png")).std() > 5
        assert not out.exists()
    source, out = experiment / "calibration.toml", tmp_path / "calibration.toml"
    assert run("calibrate", source, "--check", "-o", out, *BOX) == 0  # over its own picture
    assert run("calibrate", source, "-o", out) == 0  # beside the picture
    before = out.read_bytes()
    assert run("calibrate", source, "-o", out) == 2
    assert out.read_bytes() == before


def test_calibrations_of_other_programs_are_imported(experiment, tmp_path, capsys):
    import cv2

    originals = read_cameras(experiment / "calibration.toml")
    for camera in originals[:2]:
        storage = cv2.FileStorage(str(tmp_path / f"{camera.name}.yml"), cv2.FILE_STORAGE_WRITE)
        for key, value in (("K", camera.intrinsics), ("D", camera.distortion), ("R", camera.rotation)):
            storage.write(key, value.numpy())
        storage.write("T", camera.translation.numpy() / 1000)
        storage.release()
    words = ["calibrate", tmp_path, "-o", tmp_path / "out.toml", "--scale-mm", "1000"]
    assert run(*words) == 0
    assert "was not drawn" in capsys.readouterr().out
    assert run(*words, *str.split("--background-distance 900 --image-size 80 92 --force")) == 0
    camera, original = read_cameras(tmp_path / "out.toml")[0], originals[0]
    assert torch.allclose(camera.translation, original.translation)
    assert float(camera.background.normal @ original.background.normal) > 0.999
    assert camera.background.offset == pytest.approx(-900)


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ("--lower 0 0 0", "expected both corners"),
        ("--axes x+ x+ z+", "right-handed"),
        ("--target.kind checkers", "kind"),
        ("--target.columns 9 --target.rows 9", "180"),
        ("--world 99", "world: "),
    ],
)
def test_invalid_options_of_calibrate(experiment, refusal, more, text):
    assert text in refusal(*calibrate(experiment, *more.split(), out="c.toml"))
    assert not (experiment / "c.toml").exists()


def test_a_mirrored_camera_is_refused(copy, refusal):
    view = views_of(copy)[0]
    for path in view.glob("*/*.tif"):
        tifffile.imwrite(path, tifffile.imread(path)[:, ::-1])
    line = refusal(*calibrate(copy, out="c.toml"))
    assert f"view '{view.name}'" in line
    assert "mirrored" in line


@pytest.mark.slow
def test_several_flow_images_become_a_sequence(copy, capsys, refusal):
    pytest.importorskip("zarr", reason="pip install '.[sequence]'")
    from nerif.data.measurement_sequence import MeasurementSequence

    views = views_of(copy)
    for folder in views:
        (image,) = (folder / "flow").glob("*.tif*")
        still = sorted((folder / "reference").iterdir())[0]
        image.rename(image.with_name(f"flow0{image.suffix}"))
        for number in (1, 2):
            shutil.copy(still, image.with_name(f"flow{number}{image.suffix}"))
    (black,) = (views[0] / "flow").glob("flow1*")
    iio.imwrite(black, np.zeros_like(iio.imread(black)))
    words = displacement(copy, *str.split("--frames all --frame-rate 1000"), out=copy / "film.zarr")
    assert run(*words) == 0
    lines = capsys.readouterr().out
    assert f"frame 1: left out: view '{views[0].name}'" in lines
    assert f"3 frames of {len(views)} views" in lines
    film, single = MeasurementSequence.read(copy / "film.zarr"), Measurement.read(copy / "m.nc")
    assert film.times == pytest.approx([0, 1e-3, 2e-3])
    first, still = film.frame(0), film.frame(2)
    assert first.names == single.names
    assert torch.equal(first.usable, single.usable_for(single.observations[0]))
    assert torch.allclose(first.displacement[first.usable], single.displacement[first.usable], atol=1e-6)
    assert len(film.frame(1).names) == len(views) - 1
    mean = [float(m.displacement[m.usable].abs().mean()) for m in (still, first)]
    assert mean[0] < 0.3 * mean[1]
    assert run(*words) == 0  # nothing is left to do
    for change in ("--smoothness 2", "--mask 4", "--n-ambient 1.0003"):
        assert "other settings" in refusal(*words, *change.split())
    assert "expected numbers within 0 to 2, those of view" in refusal(*words, "--frames", "0:4")
    first, second = (view.name for view in views[:2])
    offsets = ["--frame-offset", first, "-1", "--frame-offset", second, "1"]
    assert "other settings" in refusal(*words, *offsets)
    assert run(*words, "--force", *offsets) == 0
    assert MeasurementSequence.read(copy / "film.zarr").times == pytest.approx([1e-3])
    capsys.readouterr()
    assert run("info", copy / "film.zarr") == 0
    lines = capsys.readouterr().out
    assert "measurement over time, 1 of 1 instants written" in lines
    assert f"frame offset   {first} -1" in lines
    assert f"frame offset   {second} +1" in lines


def test_flow_images_of_another_bit_depth_are_refused_in_sequences(copy, capsys, refusal):
    view = views_of(copy)[0]
    (image,) = (view / "flow").glob("*.tif*")
    content = iio.imread(image)
    assert content.dtype == np.uint16
    iio.imwrite(image, (content >> 8).astype(np.uint8))
    words = str.split("--frames all --frame-rate 1000")
    line = refusal(*displacement(copy, *words, *QUICK, out=copy / "film.zarr"))
    assert f"view '{view.name}'" in line
    assert "8 bit" in line
    assert run(*displacement(copy, "--force", *QUICK)) == 0  # of one instant the view is left out
    assert f"view '{view.name}' left out" in capsys.readouterr().out
