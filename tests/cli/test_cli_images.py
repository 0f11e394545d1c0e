"""The verbs from images to a measurement, on a small rendered experiment."""

from __future__ import annotations

import json
import shutil
import tomllib
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
import torch
from scipy.spatial.transform import Rotation

from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.imaging.calibration.cameras_file import read_cameras
from nerif.simulation.simulate import view_displacement

BOX = ["--lower", "-25", "-25", "-25", "--upper", "25", "25", "25"]
VIEWS = 4


@pytest.fixture(scope="session")
def experiment(tmp_path_factory):
    """Images of four views, a calibration and a measurement, each made by its verb."""
    folder = tmp_path_factory.mktemp("experiment")
    code = main(
        ["render", "-o", str(folder / "images"), "--phantom", "gaussians", "--views", str(VIEWS), "--arc", "10",
         "120", "--image-size", "96", "112", "--pixel-pitch", "0.0425", "--background-distance", "900",
         "--references", "3", "--poses", "10", "--backgrounds", "2", "--truth-voxels", "20"]
    )  # fmt: skip
    assert code == 0
    images, out = folder / "images", folder / "calibration.toml"
    assert main(["calibrate", str(images), "--config", str(images / "calibrate.toml"), "-o", str(out)]) == 0
    assert main(displacement(folder)) == 0
    return folder


QUICK = ("--method", "dis")  # where it does not matter how displacements are found


def displacement(folder, *more):
    words = ["displacement", str(folder / "images"), "--calibration", str(folder / "calibration.toml")]
    return [*words, *BOX, "-o", str(folder / "m.nc"), *map(str, more)]


@pytest.fixture
def copy(experiment, tmp_path):
    """The experiment again, to be spoilt."""
    shutil.copytree(experiment, tmp_path / "copy")
    return tmp_path / "copy"


def test_calibration_finds_the_rendered_rig(experiment):
    truth = read_cameras(experiment / "images" / "truth" / "calibration.toml")
    found = read_cameras(experiment / "calibration.toml")
    assert [c.name for c in found] == [c.name for c in truth]
    points = torch.from_numpy(np.random.default_rng(0).uniform(-15, 15, (50, 3)))
    for a, b in zip(found, truth, strict=True):
        # a narrow lens can hardly tell a turn from a shift of the principal point, but what it sees is right
        assert np.degrees(Rotation.from_matrix((a.rotation @ b.rotation.T).numpy()).magnitude()) < 0.5
        assert float((a.camera().project(points) - b.camera().project(points)).abs().max()) < 0.1
        assert a.background is not None
        assert b.background is not None
        # nor a focal length, told to 0.5 to 0.9 %, from a distance
        assert abs(a.background.offset - b.background.offset) < 3 * 0.009 * abs(b.background.offset)
    for name in ("calibration.rig.png", "calibration.errors.png"):
        assert iio.imread(experiment / name).std() > 10


def test_measurement_holds_what_was_rendered(experiment):
    measurement = Measurement.read(experiment / "m.nc")
    assert len(measurement.cameras) == VIEWS
    assert measurement.sigma is not None
    from nerif.fields.phantoms import make_phantom

    phantom = make_phantom("gaussians", measurement.box, 0)
    truth = {c.name: c.camera() for c in read_cameras(experiment / "images" / "truth" / "calibration.toml")}
    displaced, taken = measurement.observations
    assert taken.technique.name == "images"
    assert float(measurement.usable_for(taken).float().mean()) > 0.98
    found = measurement.usable_for(displaced)
    for i, name in enumerate(measurement.names):
        d = view_displacement(phantom, truth[name], measurement.box, measurement.n_ambient, steps=40)
        good = found[i]
        assert float(good.float().mean()) > 0.9
        error = (measurement.displacement[i] - d)[good]
        assert float(error.norm(dim=-1).median()) < 0.05
        assert np.corrcoef(measurement.displacement[i][good].ravel(), d[good].ravel())[0, 1] > 0.97
    assert iio.imread(experiment / "m.png").std() > 10


def test_truth_is_beside_the_images(experiment):
    assert read_volume(experiment / "images" / "truth" / "volume.nc").values.shape == (20, 20, 20)


@pytest.mark.slow
def test_field_from_images_alone_is_that_which_was_rendered(experiment):
    """Four views are few; examples/from_images.py does nine (test_examples.py, slow)."""
    words = ["reconstruct", str(experiment / "m.nc"), "-o", str(experiment / "r"), "--method", "tikhonov"]
    assert main([*words, "--voxels", "16", "--basis", "linear", "--regularisation", "3e-3", "--no-report"]) == 0
    assert main(["evaluate", str(experiment / "r"), "--truth", str(experiment / "images/truth/volume.nc")]) == 0
    assert json.loads((experiment / "r/metrics.json").read_text())["cc"] > 0.9


@pytest.mark.slow
def test_a_network_goes_by_images_and_the_page_shows_them(experiment, tmp_path, capsys):
    out = tmp_path / "result"
    held = Measurement.read(experiment / "m.nc").names[1]
    words = ["reconstruct", str(experiment / "m.nc"), "-o", str(out), "--from", "images", "--withhold", held]
    assert main([*words, "--max-steps", "40", "--voxels", "16", "--points-per-batch", "2048"]) == 0
    assert tomllib.loads((out / "run.toml").read_text())["source"] == "images"
    views = json.loads((out / "metrics.json").read_text())["views"]
    assert {(v["name"], v["measured"]) for v in views if v["withheld"]} == {(held, "displacement"), (held, "flow")}
    page = (out / "report.html").read_text()
    assert page.count("data:image/png") >= 3 * 3 * VIEWS  # measured, predicted, difference of u, v and flow
    settings = out / "run.toml"
    settings.write_text(settings.read_text().replace('source = "images"', 'from = "displacements"'))
    assert main(["reconstruct", "--config", str(settings), "-o", str(tmp_path / "again"), "--no-report"]) == 0
    kept = tomllib.loads((tmp_path / "again/run.toml").read_text())
    assert kept["source"] == "displacements"
    capsys.readouterr()
    assert main([*words[:-4], "--force", "--from", "images"]) == 2
    assert "from: expected one of auto, images, displacements, both, got 'images'" in capsys.readouterr().err
    plain = tmp_path / "plain.nc"
    whole = Measurement.read(experiment / "m.nc")
    replace(whole, maps={}).write(plain)
    assert main(["reconstruct", str(plain), "-o", str(tmp_path / "none"), "--from", "images"]) == 2
    assert "expected a measurement with images (variables reference and flow)" in capsys.readouterr().err


def test_nothing_is_overwritten_unasked(experiment, capsys):
    assert main(displacement(experiment)) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["calibrate", str(experiment / "images"), "-o", str(experiment / "calibration.toml")]) == 2
    assert main(["render", "-o", str(experiment / "images")]) == 2


def test_bad_images_cost_only_themselves(copy, capsys):
    views = sorted(p.name for p in (copy / "images").iterdir() if (p / "flow").is_dir())
    (copy / "images" / views[0] / "reference" / "reference_001.tif").write_bytes(b"broken")
    (copy / "images" / views[1] / "flow" / "flow_000.tif").unlink()
    tifffile.imwrite(copy / "images" / views[2] / "flow" / "flow_000.tif", np.zeros((50, 60), np.uint16))
    assert main(displacement(copy, "--force", *QUICK)) == 0
    said = capsys.readouterr().out
    assert "left out: " in said
    assert "reference_001.tif" in said
    assert f"view '{views[1]}' left out" in said
    assert f"view '{views[2]}' left out" in said
    assert len(Measurement.read(copy / "m.nc").cameras) == VIEWS - 2


def test_no_good_view_is_an_error(copy, capsys):
    for flow in (copy / "images").glob("*/flow/*.tif"):
        flow.write_bytes(b"")
    before = (copy / "m.nc").read_bytes()
    assert main(displacement(copy, "--force")) == 2
    assert "no view could be used" in capsys.readouterr().err
    assert (copy / "m.nc").read_bytes() == before


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--frame", "3"], "frame, average: expected numbers within the 1 flow images"),
        (["--method", "piv"], "method: expected one of"),
        (["--views", "none"], "views: expected some of"),
        (["--average", "0"], "average: expected 1 or more"),
    ],
)
def test_settings_that_cannot_be_right(experiment, capsys, more, words):
    assert main(displacement(experiment, "--force", *more)) == 2
    assert words in capsys.readouterr().err


def test_calibration_of_other_views_or_sizes(copy, capsys):
    file = copy / "calibration.toml"
    text = file.read_text()
    name = read_cameras(file)[0].name
    file.write_text(text.replace(f'name = "{name}"', 'name = "other"'))
    assert main(displacement(copy, "--force")) == 2
    assert f"no camera named '{name}'" in capsys.readouterr().err
    sized = text.replace("    96,\n    112,\n", "    192,\n    224,\n")
    assert sized != text
    file.write_text(sized)
    assert main(displacement(copy, "--force")) == 2
    assert "was calibrated with (192, 224)" in capsys.readouterr().err


def test_masks_by_threshold_and_drawn(experiment, tmp_path, capsys):
    out = tmp_path / "masked.nc"
    assert main(["mask", str(experiment / "m.nc"), "-o", str(out), "--threshold", "3"]) == 0
    assert "visual hull holds" in capsys.readouterr().out
    masked = Measurement.read(out)
    assert masked.flow_mask is not None
    strong = masked.displacement.norm(dim=-1) > 0.3
    assert bool(masked.flow_mask[strong & masked.usable].all())
    assert 0.02 < float(masked.flow_mask.float().mean()) < 0.9
    assert iio.imread(tmp_path / "masked.masks.png").std() > 10
    drawn = tmp_path / "drawn"
    drawn.mkdir()
    whole = np.full((96, 112), 255, np.uint8)
    whole[:10] = 0
    iio.imwrite(drawn / f"{masked.names[1]}.png", whole)
    again = tmp_path / "again.nc"
    assert main(["mask", str(experiment / "m.nc"), "-o", str(again), "--threshold", "3", "--drawn", str(drawn)]) == 0
    flow_mask = Measurement.read(again).flow_mask
    assert flow_mask is not None
    assert not flow_mask[1, :10].any()
    assert flow_mask[1, 10:].all()
    assert torch.equal(flow_mask[0], masked.flow_mask[0])
    assert main(["mask", str(again), "-o", str(tmp_path / "none.nc"), "--remove"]) == 0
    assert Measurement.read(tmp_path / "none.nc").flow_mask is None


def test_masks_that_leave_nothing(experiment, tmp_path, capsys):
    out = tmp_path / "masked.nc"
    assert main(["mask", str(experiment / "m.nc"), "-o", str(out), "--threshold", "1000"]) == 2
    assert "no flow is left in view" in capsys.readouterr().err
    assert main(["mask", str(experiment / "m.nc"), "-o", str(out), "--drawn", str(tmp_path)]) == 2
    assert "expected images named as the views" in capsys.readouterr().err
    assert not out.exists()


def test_masks_while_finding_displacements(experiment, tmp_path):
    words = displacement(experiment)
    words[words.index("-o") + 1] = str(tmp_path / "m.nc")
    assert main([*words, "--mask", "4", *QUICK]) == 0
    measurement = Measurement.read(tmp_path / "m.nc")
    assert measurement.flow_mask is not None
    assert 0 < float(measurement.flow_mask.float().mean()) < 1


def test_check_draws_the_rig_of_calibrations_and_measurements(experiment, tmp_path, capsys):
    for source in ("calibration.toml", "m.nc"):
        out = tmp_path / f"{source.split('.')[0]}.toml"
        assert main(["calibrate", str(experiment / source), "--check", "-o", str(out), *BOX]) == 0
        assert iio.imread(out.with_suffix(".rig.png")).std() > 5
        assert not out.exists()
    assert "look whether cameras and axes stand" in capsys.readouterr().out


def test_other_programs_calibrations_are_taken_over(experiment, tmp_path, capsys):
    import cv2

    for camera in read_cameras(experiment / "calibration.toml")[:2]:
        storage = cv2.FileStorage(str(tmp_path / f"{camera.name}.yml"), cv2.FILE_STORAGE_WRITE)
        for key, value in (("K", camera.intrinsics), ("D", camera.distortion), ("R", camera.rotation)):
            storage.write(key, value.numpy())
        storage.write("T", camera.translation.numpy() / 1000)
        storage.release()
    out = tmp_path / "taken.toml"
    words = ["calibrate", str(tmp_path), "-o", str(out), "--scale-mm", "1000"]
    assert main(words) == 0
    assert "was not drawn" in capsys.readouterr().out
    more = ["--background-distance", "900", "--image-size", "96", "112", "--force"]
    assert main([*words, *more]) == 0
    taken, known = read_cameras(out), read_cameras(experiment / "calibration.toml")
    assert torch.allclose(taken[0].translation, known[0].translation)
    assert taken[0].background is not None
    assert known[0].background is not None
    assert float(taken[0].background.normal @ known[0].background.normal) > 0.999
    assert abs(taken[0].background.offset - known[0].background.offset) < 10


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--lower", "0", "0", "0"], "expected both corners"),
        (["--axes", "x+", "x+", "z+"], "right-handed"),
        (["--target.kind", "checkers"], "target kind"),
        (["--target.columns", "9", "--target.rows", "9"], "turned by 180"),
        (["--world", "99"], "world: expected a target pose that was found"),
    ],
)
def test_calibrate_settings_that_cannot_be_right(experiment, tmp_path, capsys, more, words):
    config = experiment / "images" / "calibrate.toml"
    line = ["calibrate", str(experiment / "images"), "--config", str(config), "-o", str(tmp_path / "c.toml"), *more]
    assert main(line) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "c.toml").exists()


def test_a_mirrored_camera_is_refused(copy, capsys):
    view = next(p for p in sorted((copy / "images").iterdir()) if (p / "flow").is_dir())
    for path in view.glob("*/*.tif"):
        tifffile.imwrite(path, tifffile.imread(path)[:, ::-1])
    config = copy / "images" / "calibrate.toml"
    assert main(["calibrate", str(copy / "images"), "--config", str(config), "-o", str(copy / "c.toml")]) == 2
    said = capsys.readouterr().err
    assert f"view '{view.name}'" in said
    assert "mirrored" in said


@pytest.mark.slow
def test_many_flow_images_become_a_sequence(copy, capsys):
    pytest.importorskip("zarr", reason="pip install '.[sequence]'")
    from nerif.data.measurement_sequence import MeasurementSequence

    views = [folder for folder in sorted((copy / "images").iterdir()) if (folder / "flow").is_dir()]
    for folder in views:
        (image,) = (folder / "flow").glob("*.tif*")
        rest = sorted((folder / "reference").iterdir())[0]
        image.rename(image.with_name(f"flow0{image.suffix}"))
        for number in (1, 2):  # nothing flows in these
            shutil.copy(rest, image.with_name(f"flow{number}{image.suffix}"))
    spoilt = next(iter(sorted((views[0] / "flow").glob("flow1*"))))
    iio.imwrite(spoilt, np.zeros_like(iio.imread(spoilt)))
    out = copy / "film.zarr"
    words = displacement(copy, "--frames", "all", "--frame-rate", "1000")
    words[words.index("-o") + 1] = str(out)
    assert main(words) == 0
    said = capsys.readouterr().out
    assert f"frame 1: left out: view '{views[0].name}'" in said
    assert f"3 frames of {len(views)} views, 1 of them with something left out" in said
    film, single = MeasurementSequence.read(out), Measurement.read(copy / "m.nc")
    assert film.times == pytest.approx([0, 1e-3, 2e-3])
    first = film.frame(0)
    assert first.names == single.names
    assert torch.equal(first.usable, single.usable_for(single.observations[0]))
    assert torch.allclose(first.displacement[first.usable], single.displacement[first.usable], atol=1e-6)
    assert len(film.frame(1).names) == len(views) - 1
    still = film.frame(2)
    assert float(still.displacement[still.usable].abs().mean()) < 0.3 * float(
        first.displacement[first.usable].abs().mean()
    )
    assert main(words) == 0
    assert "3 of 3 frames are there already" in capsys.readouterr().out
    for change in (["--smoothness", "2"], ["--mask", "4"], ["--n-ambient", "1.0003"]):
        assert main([*words, *change]) == 2
        assert "made with other settings" in capsys.readouterr().err
    assert main([*words, "--frames", "0:4"]) == 2
    assert "expected numbers within the 3 of view" in capsys.readouterr().err


def test_flow_images_of_another_depth_than_the_reference_are_refused(copy, capsys):
    view = next(p for p in sorted((copy / "images").iterdir()) if (p / "flow").is_dir())
    (image,) = (view / "flow").glob("*.tif*")
    whole = iio.imread(image)
    assert whole.dtype == np.uint16
    iio.imwrite(image, (whole >> 8).astype(np.uint8))
    words = displacement(copy, "--frames", "all", "--frame-rate", "1000", *QUICK)
    words[words.index("-o") + 1] = str(copy / "film.zarr")
    assert main(words) == 2
    said = capsys.readouterr().err
    assert f"view '{view.name}'" in said
    assert "got 8 bit; record both alike" in said
    assert main(displacement(copy, "--force", *QUICK)) == 0  # of one instant the other views may do
    assert f"view '{view.name}' left out" in capsys.readouterr().out
