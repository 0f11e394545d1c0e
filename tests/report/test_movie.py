"""Movies of volumes over time."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyvista", reason="pip install '.[movie]'")
pytest.importorskip("imageio_ffmpeg", reason="pip install '.[movie]'")

from imageio_ffmpeg import get_ffmpeg_exe

from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.phantoms import Flame
from nerif.geometry import Box, Grid
from nerif.report.movie import Movie, _points, _surfaces, frames_there, instants


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> VolumeSequence:
    """Three instants of a flame in a box of different edges."""
    box = Box((-25.0, -25.0, -20.0), (25.0, 25.0, 20.0))
    grid = Grid.of_resolution(box, 20)
    path: Path = tmp_path_factory.mktemp("movie") / "v.zarr"
    found = VolumeSequence.create(path, [0.0, 1e-4, 2e-4], grid, ("index_excess",), 1.00027)
    for i, t in enumerate(found.times):
        found.write(i, [Volume(Flame(box, time=t).sample(grid), grid)])
    return found


def decoded(movie: Path, width: int, height: int) -> np.ndarray:
    """The images of a movie as a player would show them."""
    command = [get_ffmpeg_exe(), "-v", "error", "-i", str(movie), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, check=True, capture_output=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


SMALL = ["--quantity", "index_excess", "--size", "240", "180"]


@pytest.mark.parametrize(("name", "style"), [("m.mp4", "isosurface"), ("m.gif", "slices")])
def test_a_movie_shows_every_frame_and_they_differ(store, tmp_path, capsys, name, style):
    out = tmp_path / name
    assert main(["movie", str(store.path), "-o", str(out), "--style", style, *SMALL]) == 0
    assert "3 frames" in capsys.readouterr().out
    images = decoded(out, 240, 180)
    assert len(images) == 3
    assert all(p.std() > 10 for p in images)
    middle = (slice(50, 140), slice(70, 170))
    assert np.abs(images[0][middle].astype(float) - images[2][middle].astype(float)).mean() > 1
    assert not list(tmp_path.glob(".*"))


def test_masked_voxels_are_shown_as_such(store):
    """They are grey in slices, and have no isosurface of their own, as the lowest value in their place would give."""
    z = store.grid.points()[..., 2]
    values = 1 + 0.01 * z
    values[12:, 5:15, 5:15] = float("nan")  # above the surface of 1, and below it nowhere
    volume = Volume(values, store.grid, "density", "kg m-3")
    surface, hidden = _surfaces(_points(volume, "density"), "density", 1.0)
    assert surface.n_points
    assert np.abs(surface.points[:, 2]).max() < 0.5 * store.grid.spacing[2]
    assert hidden.n_points
    for style in ("slices", "isosurface"):
        movie = Movie(style=style, quantity="density", size=(240, 180))
        with_mask, without = (movie._image(v, "", (0.8, 1.2), 1.0).astype(int) for v in (volume, _whole(volume)))
        grey = [((p.max(-1) - p.min(-1) < 12) & (abs(p.mean(-1) - 190) < 40)).sum() for p in (with_mask, without)]
        assert grey[0] > grey[1] + 100, style


def _whole(volume: Volume) -> Volume:
    return replace(volume, values=volume.values.nan_to_num(1.2))


def test_only_frames_that_are_there_are_drawn(store, tmp_path):
    assert frames_there(store) == [0, 1, 2]
    from nerif.data.measurement_sequence import add_frames

    path = tmp_path / "v.zarr"
    partial = VolumeSequence.create(path, store.times, store.grid, ("index_excess",), 1.00027)
    add_frames(partial.group, "status", 3, (), (), "int8", 0)
    partial.write(1, [store.volume(1, "index_excess")])
    with pytest.raises(InputError, match="no frame of it is there yet"):
        Movie(quantity="index_excess").write(tmp_path / "m.mp4", partial, frames_there(partial))
    partial.array("status")[1] = 1
    assert frames_there(partial) == [1]


def test_no_two_frames_show_the_same_instant():
    assert instants([0.0, 1e-4, 2e-4]) == ["0.000 ms", "0.100 ms", "0.200 ms"]
    assert instants([1.0, 1.0 + 2e-7, 1.0 + 4e-7]) == ["1000.00000 ms", "1000.00020 ms", "1000.00040 ms"]
    assert instants([0.5]) == ["500.000 ms"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "m.avi"], "out: expected a name ending in .mp4 or .gif"),
        (["-o", "m.mp4", "--quantity", "density"], "quantity: expected one of index_excess, got 'density'"),
        (["-o", "m.mp4", "--style", "cubist"], "style: expected one of isosurface, slices"),
        (["-o", "m.mp4", "--size", "241", "180"], "size: expected an even width and height"),
        (["-o", "m.mp4", "--frames-per-second", "0"], "frames_per_second: expected a positive number"),
        (["-o", "m.mp4", "--every", "0"], "every: expected 1 or more"),
    ],
)
def test_what_cannot_be_drawn_is_refused(store, tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    shown = [] if "--quantity" in arguments else ["--quantity", "index_excess"]
    assert main(["movie", str(store.path), *shown, *arguments]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
