"""Movies of a sequence of volumes."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyvista", reason="pip install '.[movie]'")
pytest.importorskip("imageio_ffmpeg", reason="pip install '.[movie]'")

from imageio_ffmpeg import get_ffmpeg_exe

from nerif.cli.cli import main
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence, add_frames
from nerif.fields.phantoms import Flame
from nerif.geometry import Box, Grid
from nerif.report.volume_movie import Movie, _points, _surfaces, finished_frames, instants
from refusals import refused

SMALL = ["--quantity", "index_excess", "--size", "240", "180"]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> VolumeSequence:
    """Three instants of a flame in a box of different edges."""
    box = Box((-25.0, -25.0, -20.0), (25.0, 25.0, 20.0))
    grid = Grid.of_resolution(box, 20)
    path: Path = tmp_path_factory.mktemp("movie") / "v.zarr"
    sequence = VolumeSequence.create(path, [0.0, 1e-4, 2e-4], grid, ("index_excess",), 1.00027)
    for i, t in enumerate(sequence.times):
        sequence.write(i, [Volume(Flame(box, time=t).sample(grid), grid)])
    return sequence


@pytest.mark.slow
@pytest.mark.parametrize(("name", "style"), [("m.mp4", "isosurface"), ("m.gif", "slices")])
def test_a_movie_shows_every_frame_and_they_differ(store, tmp_path, capsys, name, style):
    out = tmp_path / name
    assert main(["movie", str(store.path), "-o", str(out), "--style", style, *SMALL]) == 0
    assert "3 frames" in capsys.readouterr().out
    command = [get_ffmpeg_exe(), "-v", "error", "-i", str(out), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, check=True, capture_output=True).stdout
    images = np.frombuffer(raw, np.uint8).reshape(-1, 180, 240, 3)
    assert len(images) == 3
    assert all(image.std() > 10 for image in images)
    centre = (slice(50, 140), slice(70, 170))
    assert np.abs(images[0][centre].astype(float) - images[2][centre].astype(float)).mean() > 1
    assert not list(tmp_path.glob(".*"))


def test_masked_voxels_are_grey_and_have_no_isosurface(store):
    z = store.grid.points()[..., 2]
    values = 1 + 0.01 * z
    values[12:, 5:15, 5:15] = float("nan")  # above the surface of 1
    volume = Volume(values, store.grid, "density", "kg m-3")
    whole = replace(volume, values=values.nan_to_num(1.2))
    surface, masked = _surfaces(_points(volume, "density"), "density", 1.0)
    assert surface.n_points
    assert np.abs(surface.points[:, 2]).max() < 0.5 * store.grid.spacing[2]
    assert masked.n_points
    for style in ("slices", "isosurface"):
        movie = Movie(style=style, quantity="density", size=(240, 180))
        images = [movie._image(v, "", (0.8, 1.2), 1.0).astype(int) for v in (volume, whole)]
        grey = [((p.max(-1) - p.min(-1) < 12) & (abs(p.mean(-1) - 190) < 40)).sum() for p in images]
        assert grey[0] > grey[1] + 100, style


def test_only_finished_frames_are_drawn(store, tmp_path):
    assert finished_frames(store) == [0, 1, 2]
    partial = VolumeSequence.create(tmp_path / "v.zarr", store.times, store.grid, ("index_excess",), 1.00027)
    add_frames(partial.group, "status", 3, (), (), "int8", 0)
    partial.write(1, [store.volume(1, "index_excess")])
    with refused(partial.path):
        Movie(quantity="index_excess").write(tmp_path / "m.mp4", partial, finished_frames(partial))
    partial.array("status")[1] = 1
    assert finished_frames(partial) == [1]


def test_times_of_frames_differ():
    assert instants([0.0, 1e-4, 2e-4]) == ["0.000 ms", "0.100 ms", "0.200 ms"]
    assert instants([1.0, 1.0 + 2e-7, 1.0 + 4e-7]) == ["1000.00000 ms", "1000.00020 ms", "1000.00040 ms"]
    assert instants([0.5]) == ["500.000 ms"]


@pytest.mark.parametrize(
    ("field", "arguments"),
    [("out", ["-o", "m.avi"]), ("quantity", ["-o", "m.mp4", "--quantity", "density"]),
     ("style", ["-o", "m.mp4", "--style", "cubist"]), ("size", ["-o", "m.mp4", "--size", "241", "180"]),
     ("frames_per_second", ["-o", "m.mp4", "--frames-per-second", "0"]), ("every", ["-o", "m.mp4", "--every", "0"])],
)  # fmt: skip
def test_invalid_settings_are_refused(store, tmp_path, monkeypatch, capsys, arguments, field):
    monkeypatch.chdir(tmp_path)
    quantity = [] if "--quantity" in arguments else ["--quantity", "index_excess"]
    assert main(["movie", str(store.path), *quantity, *arguments]) == 2
    name = field.replace("_", ".")
    assert re.search(rf"{name}(:|'\.) expected", capsys.readouterr().err, re.IGNORECASE)
    assert not list(tmp_path.iterdir())
