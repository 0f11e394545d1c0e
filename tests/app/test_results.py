"""The Results page: verdicts, slices and films compared, surfaces, reports, exports."""

from __future__ import annotations

import math
import shutil
from types import SimpleNamespace

import pytest
import torch
from nicegui import ui

from app.projects import AMBIENT, BOX, OUT, REPORT, result
from app.visiting import visiting
from nerif.app.project.folder import ProjectFolder
from nerif.app.project.jobs import Jobs
from nerif.app.views.result_table import rows_of
from nerif.app.views.result_view import ResultView
from nerif.app.views.result_volumes import FilmVolumes, ResultVolumes
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import Volume, export
from nerif.data.volume_sequence import VolumeSequence
from nerif.geometry import Grid
from nerif.results.directory import ResultDirectory
from refusals import refused

pytestmark = pytest.mark.anyio


def test_what_is_listed_and_what_is_said_of_it(folder):
    project = ProjectFolder(folder)
    first, _, second, film = rows_of(project, project.contents())
    assert (first.name, second.name, film.name) == ("results/a <b>", "results/other", "film.zarr")
    assert first.cells[:5] == ("Tikhonov", "use", "1.9% of the variation", "0.01 px", "converged")
    assert dict(film.figures)["Frames"] == "3 of 3"
    unfinished = folder / "results" / "z"
    ResultDirectory(unfinished).begin({"method": "nerif"})
    row = rows_of(project, project.contents())[3]
    assert (row.name, row.word, row.cells[4]) == ("results/z", "", "not ended")
    assert "has not ended" in row.sentence
    with refused("z"):
        ResultVolumes(unfinished).volume("index_excess")
    shutil.rmtree(unfinished)


def test_sources_follow_the_files(folder, tmp_path):
    still, film = ResultVolumes(folder / "results" / "other"), FilmVolumes(folder / "film.zarr")
    assert still.quantities == ("index_excess", "index_excess_std")
    assert film.frames == [0, 1, 2]
    assert film.limits("index_excess")[0] == pytest.approx(float(film.volume("index_excess", 0).values.min()), rel=0.1)
    with refused("other"):
        still.volume("density")
    export(tmp_path / "volume.nc", [still.volume("index_excess")])
    before = ResultVolumes(tmp_path).limits("index_excess")
    twice = still.volume("index_excess")
    export(tmp_path / "volume.nc", [Volume.of(2 * twice.values, twice.grid, "index_excess", AMBIENT)], force=True)
    assert ResultVolumes(tmp_path).limits("index_excess")[0] == pytest.approx(2 * before[0])


def test_a_velocity_is_a_film_of_speeds(tmp_path):
    grid = Grid.of_resolution(BOX, 12)
    store = VelocitySequence.begin(tmp_path / "v.zarr", [0.0, 1e-3], grid, ("pressure", "u_std"), {})
    x, y, z = grid.points(torch.float32).unbind(-1)
    for i in range(2):
        w = (i + 1) * torch.exp(-(x**2 + y**2) / 100).masked_fill(z < z.median(), math.nan)
        zero = torch.zeros_like(w)
        store.write_frame(i, {"u": zero, "v": zero, "w": w, "pressure": zero, "u_std": zero + 0.1})
    film = FilmVolumes(tmp_path / "v.zarr")
    assert film.quantities[:4] == ("speed", "vorticity", "u", "u_std")
    assert film.limits("speed") == (pytest.approx(0, abs=0.1), pytest.approx(2, rel=0.2))
    assert math.isfinite(film.level("speed"))
    assert film.volume("vorticity", 1).unit == "s-1"
    project = ProjectFolder(tmp_path)
    (row,) = rows_of(project, project.contents())
    assert row.cells[0] == "velocity, 2 frames"


def test_films_are_compared_at_the_same_instants(tmp_path):
    grid = Grid.of_resolution(BOX, 6)
    for name, times in (("a", [0.0, 1e-3, 2e-3]), ("b", [1e-3, 2.4e-3, 9e-3])):
        store = VolumeSequence.create(tmp_path / f"{name}.zarr", times, grid, ("index_excess",), AMBIENT)
        for i, time in enumerate(times):
            store.write(i, [Volume(torch.full(grid.shape, time), grid)])
    view = ResultView(SimpleNamespace(project=ProjectFolder(tmp_path)), "a.zarr", ["b.zarr"], {}, lambda: None)
    view.source = FilmVolumes(tmp_path / "a.zarr")
    for step, time in ((1, 1e-3), (2, 2.4e-3)):
        panels, note = view._panels("index_excess", "b.zarr", step)
        assert [float(panel.volume.values.mean()) for panel in panels[:2]] == pytest.approx([step * 1e-3, time])
        assert note == ""
    with refused("b.zarr"):
        view._panels("index_excess", "b.zarr", 0)


def slices(user):
    """Addresses and texts of the slices."""
    return [(e.props["src"], e.props["alt"]) for e in user.all() if e.tag == "img" and "slice at" in e.props["alt"]]


async def test_two_results_side_by_side_move_together_and_in_space(folder):
    async with visiting(folder) as user:
        await user.open("results", "In this folder")
        await user.until(lambda: len(slices(user)) == 3)
        before = slices(user)
        user.put("Standard deviation", True)
        await user.until(lambda: slices(user)[:1] not in ([], before[:1]))
        assert user.sees("Standard deviation of")
        user.put("Standard deviation", False)
        user.put("Compare with", "results/other")
        await user.until(lambda: len(slices(user)) == 9)
        titles = "results/a <b> and results/other", "results/other minus results/a <b>"
        await user.sees_soon("20 × 19 × 16 voxels", *titles)
        before = slices(user)
        slider = user.control("Slice across z")
        user.fire(slider, "input", str(slider.props["value"] + 3))
        await user.until(lambda: "z = 8.75 mm" in slices(user)[0][1] and slices(user)[2] != before[2])
        assert [a != b for a, b in zip(slices(user), before, strict=True)] == [True] * 3 + [False] * 6
        await user.open("results", "In this folder")  # what was chosen before is still there
        await user.until(lambda: len(slices(user)) == 9)
        user.put_tab("surface")
        await user.sees_soon("Level")
        assert user.html.count("<li><i style=") == 2
        stl = [e for e in user.scene_objects() if e.type == "stl"]
        for surface in stl:
            answer = await user.user.http_client.get(f"/{surface.args[0]}")
            assert (answer.status_code, answer.headers["content-type"]) == (200, "model/stl")
        assert len(stl) == 2


async def test_a_result_is_exported(folder, monkeypatch):
    monkeypatch.setattr(Jobs, "advance", lambda self: None)
    async with visiting(folder) as user:
        await user.open("results", "Figures for print")
        user.put_tab("export")
        user.put("Format", ".nc")
        line = ["nerif", "export", "results/a <b>", "-o", "exports/a <b>.nc"]
        assert line in user.lines()
        user.click("Export")
        await user.until(lambda: line[1:] in [list(job.arguments) for job in user.work.jobs.all()])


async def test_a_film_is_moved_through_time(folder):
    async with visiting(folder) as user:
        await user.open("results", "In this folder")
        user.click("Show film.zarr")
        await user.sees_soon("0 ms (frame 1)")
        await user.until(lambda: len(slices(user)) == 3)
        before = slices(user)
        user.fire(user.control("Time"), "input", "2")
        await user.sees_soon("2 ms (frame 3)")
        await user.until(lambda: slices(user)[:1] not in ([], before[:1]))
        user.click("Play or pause the film")
        await user.sees_soon("0 ms (frame 1)")
        user.click("Play or pause the film")


async def test_the_app_on_a_result_opens_its_result_by_name(tmp_path):
    path = tmp_path / "flame <3"
    result(path, 8, 0.0)
    async with visiting(path) as user:
        await user.open("results", "In this folder")
        await user.until(lambda: len(slices(user)) == 3)
        assert [e.props["aria-label"] for e in user.all(ui.element) if "card" in e.classes][1] == "flame <3"
        user.put_tab("surface")
        await user.sees_soon("Level")
        assert "</i>flame &lt;3</li>" in user.html
        assert ["nerif", "export", ".", "-o", "exports/flame <3.vti"] in user.lines()
        assert user.all(title="Report of flame <3")


def test_reports_and_surfaces_come_from_the_folder_alone(server):
    cookie = {"Cookie": server.cookie()}
    status, headers, answer = server.get("/report?of=results/a%20%3Cb%3E", cookie)
    assert (status, answer) == (200, REPORT)
    assert headers["content-security-policy"].startswith("sandbox allow-scripts allow-downloads; default-src 'none'")
    live = f"of={OUT.replace(' ', '%20').replace('<', '%3C').replace('>', '%3E')}"
    assert server.get(f"/live-surface?{live}", cookie)[0] == 200
    assert server.get("/report?of=results/a%20%3Cb%3E")[0] == server.get(f"/live-surface?{live}")[0] == 403
    for request in ("../x", "results", "%00", "/etc"):
        for path in ("report", "surface", "live-surface", "bodies"):
            assert server.get(f"/{path}?of={request}&quantity=n", cookie)[0] == 404
    assert server.get("/surface?of=film.zarr&quantity=index_excess&level=x", cookie)[0] == 404
    assert server.get("/", cookie)[1]["location"] == "/design"
