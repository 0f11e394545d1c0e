"""`nerif check` of a film: names the view that shows other instants than the rest, by how much, and with the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerif.analysis.film_check import Evidence, Excerpt, Shift, band_evidence, check_film, frame_shifts, late_views
from nerif.analysis.prediction import predict
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid, Ring

BOX, N_AMBIENT, FRAMES = Box.cube(50.0), 1.00027, 14


class Frames:
    """A film in memory."""

    def __init__(self, frames: list[Measurement], times: Sequence[float] = ()) -> None:
        self.frames, self.times = frames, times or range(len(frames))

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, index: int) -> Measurement:
        return self.frames[index]

    def fullest(self) -> Measurement:
        return max(self.frames, key=lambda frame: len(frame.names))


def rising(instant: float) -> VoxelField:
    """Uneven hot balls that rise by 3 mm a frame and drift."""
    grid, rng, speed = Grid.of_resolution(BOX, 28), np.random.default_rng(1), 3.0
    points, excess = grid.points().numpy(), 0
    for x, y, start, size in zip(
        *rng.uniform(-9, 9, (2, 18)), np.linspace(-130, 15, 18), rng.uniform(3, 5, 18), strict=True
    ):
        centre = np.array([x + 0.6 * instant, y, start + speed * instant])
        excess = excess - 1e-4 * np.exp(-np.square((points - centre) / size).sum(axis=-1) / 2)
    return VoxelField.through(torch.as_tensor(excess, dtype=torch.float32).reshape(grid.shape), grid)


def film_of(fields: list, views: int, seed: int = 0) -> list[Measurement]:
    """Displacements of 18 x 20 px with 5 % noise."""
    ring = Ring(views=views, arc=(0.0, 180 - 180 / views), image_size=(20, 18), pixel_pitch=0.2)
    frames = [predict(field, ring.cameras(), BOX, N_AMBIENT, samples=40) for field in fields]
    values = torch.stack([frame.displacements for frame in frames])
    noise = torch.randn(values.shape, generator=torch.Generator().manual_seed(seed))
    values = values + 0.05 * values.square().mean().sqrt() * noise
    return [replace(frame, displacement=d) for frame, d in zip(frames, values, strict=True)]


def late(frames: list[Measurement], shifts: dict[int, int]) -> list[Measurement]:
    """The film with some views late: their frame i + shift shows the instant of the others' frame i."""
    result = []
    for i in range(max(0, *shifts.values()), len(frames) + min(0, *shifts.values())):
        d = frames[i].displacements.clone()
        for view, shift in shifts.items():
            d[view] = frames[i - shift].displacements[view]
        result.append(replace(frames[i], displacement=d))
    return result


@pytest.fixture(scope="module")
def synchronous() -> list[Measurement]:
    return film_of([rising(i) for i in range(FRAMES)], 4)


def shifts_of(frames: list[Measurement]) -> tuple[Shift, ...]:
    excerpt = Excerpt(Frames(frames))
    return frame_shifts(excerpt, excerpt.liveliest(), 12)


def frames_of(shifts: tuple[Shift, ...]) -> list[int]:
    return [shift.frames if shift.clear else 0 for shift in shifts]


def test_evidence_is_for_changes_that_two_films_share():
    rng = np.random.default_rng(0)
    film = rng.standard_normal((8, 20, 18, 2)).cumsum(axis=0)
    still = np.broadcast_to(film[:1], film.shape)
    noise = [band_evidence(film, rng.standard_normal(film.shape)) for _ in range(20)]
    assert max(noise) < 25
    assert band_evidence(still, still) < 1
    assert band_evidence(film, 3 * film + still) > 1000  # neither a gain nor a mean counts
    assert band_evidence(film, -film) == 0
    assert band_evidence(film, film + rng.standard_normal(film.shape)) > band_evidence(film, film[::-1]) + 100


@pytest.mark.parametrize("shifts", [{2: 2}, pytest.param({1: -1}, marks=pytest.mark.slow)])
def test_a_late_view_is_named_with_the_number_of_frames(synchronous, shifts):
    assert frames_of(shifts_of(late(synchronous, shifts))) == [shifts.get(i, 0) for i in range(4)]


@pytest.mark.slow
def test_synchronous_and_steady_films_have_no_late_view(synchronous):
    shifts = shifts_of(synchronous)
    assert frames_of(shifts) == [0, 0, 0, 0]
    assert all(shift.sharp for shift in shifts)
    shifts = shifts_of(film_of([rising(5)] * 9, 3))
    assert frames_of(shifts) == [0, 0, 0]
    assert not any(shift.sharp for shift in shifts)


@pytest.mark.slow
def test_a_large_offset_is_searched_further():
    frames = late(film_of([rising(i) for i in range(44)], 3), {0: 8})
    assert frames_of(shifts_of(frames)) == [8, 0, 0]


def test_a_film_too_short_for_larger_offsets_is_named():
    shifts = [Shift("a", 3, 50, True, at_end=True), Shift("b", 0, 0, True), Shift("c", 0, 0, True)]
    (finding,) = late_views(shifts, {})
    assert "3 frames late, or more, as the film is too short for larger offsets" in str(finding)
    assert "too short" not in str(late_views([replace(shifts[0], at_end=False), *shifts[1:]], {})[0])


@pytest.mark.slow
def test_two_views_show_a_difference_but_not_which_is_late(synchronous):
    frames = [frame.select(frame.names[:2]) for frame in late(synchronous, {1: 2})]
    check = check_film(Frames(frames), 12)
    (finding,) = check.findings
    assert (finding.code, finding.views) == ("late", ("45deg",))
    assert "2 frames late, or the other views 2 frames early; equal numbers of views do not decide" in str(finding)
    assert check.remarks[-1].startswith("fewer than three views: from one instant the check cannot tell")


def test_the_remedy_adds_to_the_offsets_of_the_measurement():
    shifts = [Shift("a", 0, 0, True), Shift("b", -1, 90, True), Shift("c", -1, 60, True), Shift("d", 0, 0, True)]
    shifts += [Shift("e", 2, 20, False), Shift("f", 0, 0, True)]
    (finding,) = late_views(shifts, {"b": 3})
    assert finding.views == ("b", "c")
    assert str(finding).startswith(
        "views b and c: their films are 1 frame early (gain of evidence 90, 60; 25 is clear)"
    )
    assert str(finding).endswith("nerif displacement --frame-offset b 2 --frame-offset c -1")
    assert late_views([Shift("a", 0, 0, True), Shift("b", 1, 10, False)], {}) == []


def test_evidence_of_shifts():
    evidence = Evidence({-1: 10.0, 0: 50.0, 1: 90.0})
    assert (evidence.best, evidence.gain, evidence.sharp) == (1, 40.0, False)
    assert Evidence({-1: 10.0, 0: 50.0}).sharp


def test_frames_without_all_views_are_avoided(synchronous):
    frames = list(synchronous)
    for i in (0, 1, 12):
        frames[i] = frames[i].select(frames[i].names[1:])
    instants = Excerpt(Frames(frames)).liveliest()
    assert len(instants) == 7
    assert not {0, 1, 12} & set(instants)
    assert not Excerpt(Frames(frames[:5])).liveliest()
    paused = Excerpt(Frames(synchronous, [0.1 * (i + 4 * (i > 9)) for i in range(FRAMES)]))  # without 10 to 13
    assert paused.length == FRAMES + 4
    assert [paused.has([i]) for i in (9, 10, 13, 14)] == [True, False, False, True]
    assert not {10, 11, 12, 13} & set(paused.liveliest())
    alone = check_film(Frames([frame.select(frame.names[:1]) for frame in synchronous]), 8)
    assert any("one view: its film cannot be compared" in remark for remark in alone.remarks)


@pytest.mark.slow
def test_the_command_checks_a_store(synchronous, tmp_path, capsys):
    pytest.importorskip("zarr", reason="pip install '.[sequence]'")
    names = synchronous[0].names[1:]
    frames = [replace(f, frame_offsets={"90deg": 1}).select(names) for f in late(synchronous, {2: 2})]
    film = MeasurementSequence.create(tmp_path / "m.zarr", range(len(frames)), frames[0])
    for i, frame in enumerate(frames):
        film.write_frame(i, frame)
    assert main(["check", str(film.path), "--voxels", "8", "--strict"]) == 1
    output = capsys.readouterr().out
    assert "FOUND: view 90deg: its film is 2 frames late" in output
    assert "nerif displacement --frame-offset 90deg 3\n" in output
    assert output.count("FOUND") == 1  # at one instant, with the frames exchanged, the views agree
    assert main(["check", str(film.path), "-o", str(tmp_path / "m.nc")]) == 2
    assert "out: expected none for a measurement over time" in capsys.readouterr().err
