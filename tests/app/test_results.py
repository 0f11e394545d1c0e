"""The Results page in a real browser, on results made by hand: slices that move together, films, reports, exports."""

from __future__ import annotations

import math
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from app.serving import Served, opened, served
from app.test_pages import line
from nerif.app.project.folder import ProjectFolder
from nerif.app.project.jobs import Jobs
from nerif.app.views.result_table import rows_of
from nerif.app.views.result_view import ResultView
from nerif.app.views.result_volumes import FilmVolumes, ResultVolumes
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import Volume, export
from nerif.data.volume_file import read_volumes
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.phantoms import Flame
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid
from nerif.reconstruction.reconstructor import Outcome, Reconstruction
from nerif.results.directory import ResultDirectory
from nerif.results.metrics_file import Metrics
from refusals import refused
from report.browsing import errors, needs_browser, requests, text, wait_for

BOX = Box((-25.0, -24.0, -20.0), (25.0, 24.0, 20.0))
AMBIENT = 1.00027
REPORT = """<!doctype html><title>r</title><p id=said>nothing</p><script>
const said = document.querySelector('#said'); said.textContent = 'run';
try { parent.document.title = 'taken'; said.textContent += ' reached' } catch { said.textContent += ' not allowed' }
fetch('/design').then(() => { said.textContent += ' fetched' }, () => { said.textContent += ' refused' });
</script>"""


def result(path: Path, voxels: int, error: float) -> None:
    """A finished result of a flame, as nerif reconstruct leaves it, with standard deviations."""
    grid = Grid.of_resolution(BOX, voxels)
    values = Flame(BOX).sample(grid)
    field, place = VoxelField.through(values, grid), ResultDirectory(path)
    place.begin({"measurement": "m.nc", "method": "tikhonov"})
    place.write_field(Reconstruction(field, BOX, AMBIENT, [], Outcome("converged", "by hand"), {}))
    index = Volume.of(values * (1 + error), grid, "index_excess", AMBIENT)
    spread = Volume.of((values * 0.02).abs(), grid, "index_excess_std", AMBIENT)
    place.write_volumes([index, spread])
    views = [
        {"name": str(i), "withheld": i == 0, "measured": "displacement", "unit": "px", "cc": 0.99, "rms": 0.01,
         "ssim": 0.99, "psnr": 40.0, "pixels": 100, "rms_predicted": 0.5, "rms_measured": 0.5} for i in range(5)
    ]  # fmt: skip
    trials = {"kind": "fast", "trials": 2, "diverged_trials": [], "seconds": 4.0}
    place.write_metrics(Metrics(views=views, outcome="converged", seconds=12.0, uncertainty=trials))
    (path / "report.html").write_text(REPORT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("project")
    result(place / "results" / "a <b>", 20, 0.0)
    result(place / "results" / "other", 16, 0.1)
    grid = Grid.of_resolution(BOX, 12)
    store = VolumeSequence.create(place / "film.zarr", [0.0, 1e-3, 2e-3], grid, ("index_excess",), AMBIENT)
    for i in range(3):
        store.write(i, [Volume(Flame(BOX).sample(grid) * (1 - 0.4 * i), grid)])
    return place


def test_what_is_listed_and_what_is_said_of_it(folder):
    project = ProjectFolder(folder)
    first, second, film = rows_of(project, project.contents())
    assert (first.name, second.name, film.name) == ("results/a <b>", "results/other", "film.zarr")
    assert first.cells[:5] == ("Tikhonov", "use", "1.9% of the variation", "0.01 px", "converged")
    assert dict(film.figures)["Frames"] == "3 of 3"
    unfinished = folder / "results" / "z"
    ResultDirectory(unfinished).begin({"method": "nerif"})
    row = rows_of(project, project.contents())[2]
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
    copy = tmp_path / "r"
    copy.mkdir()
    export(copy / "volume.nc", [still.volume("index_excess")])
    before = ResultVolumes(copy).limits("index_excess")
    twice = still.volume("index_excess")
    export(copy / "volume.nc", [Volume.of(2 * twice.values, twice.grid, "index_excess", AMBIENT)], force=True)
    assert ResultVolumes(copy).limits("index_excess")[0] == pytest.approx(2 * before[0])


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
    low, high = film.limits("speed")
    assert low == pytest.approx(0, abs=0.1)
    assert high == pytest.approx(2, rel=0.2)
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
    look = ResultView(SimpleNamespace(project=ProjectFolder(tmp_path)), "a.zarr", ["b.zarr"], {}, lambda: None)
    look.source = FilmVolumes(tmp_path / "a.zarr")
    for step, time in ((1, 1e-3), (2, 2.4e-3)):
        panels, note = look._panels("index_excess", "b.zarr", step)
        assert [float(panel.volume.values.mean()) for panel in panels[:2]] == pytest.approx([step * 1e-3, time])
        assert note == ""
    with refused("b.zarr"):
        look._panels("index_excess", "b.zarr", 0)


def visit(driver: Any, server: Served) -> None:
    """Open the page and wait until it answers."""
    opened(driver, server, "results", "document.querySelector('[role=tab]') !== null")


def tab(driver: Any, name: str) -> None:
    """Turn to one of the tabs."""
    driver.find_element("xpath", f"//div[@role='tab'][contains(., '{name}')]").click()


def pick(driver: Any, label: str, option: str) -> None:
    """Choose something by its words."""
    driver.find_element("xpath", f"//*[@aria-label='{label}']").click()
    place = f"//div[@role='option'][contains(., '{option}')]"
    wait_for(driver, f"return document.evaluate({place!r}, document, null, 9, null).singleNodeValue?.offsetParent")
    driver.find_element("xpath", place).click()


def images(driver: Any) -> list[str]:
    """Addresses of the slices."""
    return list(driver.execute_script("return [...document.querySelectorAll('.cuts img[src]')].map(e => e.src)"))


@pytest.mark.slow
@needs_browser
def test_two_results_side_by_side_move_together(browser, server):
    from selenium.webdriver.common.keys import Keys

    visit(browser, server)
    wait_for(browser, "return document.querySelectorAll('.cuts img[src]').length === 3")
    assert text(browser, ".tabled tr.chosen td") == "Tikhonov"
    assert browser.execute_script("return document.querySelectorAll('main b i, main th b').length") == 0
    before = images(browser)
    browser.find_element("css selector", "[role=switch]").click()
    wait_for(browser, f"return document.querySelector('.cuts img').src !== {before[0]!r}")
    assert "Standard deviation" in text(browser, ".bars figcaption")
    browser.find_element("css selector", "[role=switch]").click()
    pick(browser, "Compare with", "results/other")
    wait_for(browser, "return document.querySelectorAll('.cuts img[src]').length === 9")
    assert "20 × 19 × 16 voxels" in text(browser, "main [aria-live=polite] .note")
    labels = browser.execute_script("return [...document.querySelectorAll('.bars figcaption')].map(e => e.textContent)")
    assert labels == ["results/a <b> and results/other", "results/other minus results/a <b>"]
    before = images(browser)
    slider = browser.find_element("css selector", "input[aria-label='Slice across z']")
    slider.send_keys(Keys.RIGHT * 3)
    alt = "document.querySelector('.cuts img').alt"
    wait_for(browser, f"return /z = 8.75 mm/.test({alt})")
    after = images(browser)
    assert [a != b for a, b in zip(after, before, strict=True)] == [True] * 3 + [False] * 6
    visit(browser, server)  # what was chosen before is still there
    wait_for(browser, "return document.querySelectorAll('.cuts img[src]').length === 9")
    assert errors(browser) == []
    here = f"http://127.0.0.1:{server.port}/", f"ws://127.0.0.1:{server.port}/"
    assert [address for address in requests(browser) if not address.startswith(here)] == []


@pytest.mark.slow
@needs_browser
def test_surface_report_and_export(browser, server, folder):
    visit(browser, server)
    wait_for(browser, "return document.querySelector('.cuts img[src]') !== null")
    pick(browser, "Compare with", "results/other")
    wait_for(browser, "return document.querySelectorAll('.cuts img[src]').length === 9")
    tab(browser, "In 3-D")
    wait_for(browser, "return document.querySelectorAll('.legend li').length === 2")
    wait_for(browser, "return document.querySelector('.surface canvas') !== null")
    tab(browser, "Report")
    wait_for(browser, "return document.querySelector('iframe.report') !== null")
    browser.switch_to.frame(browser.find_element("css selector", "iframe.report"))
    wait_for(browser, "return document.querySelector('#said')?.textContent.split(' ').length > 3")
    assert text(browser, "#said") == "run not allowed refused"
    browser.switch_to.default_content()
    surfaces = [address for address in requests(browser) if "/surface?" in address]
    assert len(surfaces) == 2
    for address in surfaces:
        status, headers, _ = server.get(address.partition(str(server.port))[2], {"Cookie": server.cookie()})
        assert (status, headers["content-type"]) == (200, "model/stl")
    tab(browser, "Export")
    wait_for(browser, "return document.querySelector('input[name=voxels]')?.offsetParent")
    pick(browser, "Format", "NetCDF")
    wait_for(browser, "return document.querySelector('.command code').textContent.includes('.nc')")
    assert line(browser) == ["nerif", "export", "results/a <b>", "-o", "exports/a <b>.nc"]
    browser.find_element("xpath", "//button[contains(., 'Export')]").click()
    jobs = Jobs(folder)
    wait_for(browser, "return /Runs/.test(document.querySelector('header').textContent)")
    for _ in range(400):
        if jobs.all() and jobs.all()[0].state == "done":
            break
        wait_for(browser, "return true")
        browser.execute_async_script("setTimeout(arguments[0], 50)")
    assert shlex.split(jobs.all()[0].line) == ["nerif", "export", "results/a <b>", "-o", "exports/a <b>.nc"]
    assert read_volumes(folder / "exports" / "a <b>.nc")["density"].grid.box == BOX


@needs_browser
def test_a_film_is_moved_through_time(browser, server):
    from selenium.webdriver.common.keys import Keys

    visit(browser, server)
    browser.find_element("xpath", "//button[@aria-label='Show film.zarr']").click()
    wait_for(browser, "return document.querySelector('.tabled tr.chosen')?.textContent.includes('film')")
    tab(browser, "Slices")
    wait_for(browser, "return document.querySelectorAll('.cuts img[src]').length === 3")
    before = images(browser)
    browser.find_element("css selector", "input[aria-label=Time]").send_keys(Keys.RIGHT * 2)
    wait_for(browser, "return document.querySelector('.time b').textContent === '2 ms (frame 3)'")
    wait_for(browser, f"return document.querySelector('.cuts img').src !== {before[0]!r}")
    browser.find_element("xpath", "//button[@aria-label='Play or pause the film']").click()
    wait_for(browser, "return document.querySelector('.time b').textContent === '0 ms (frame 1)'")
    browser.find_element("xpath", "//button[@aria-label='Play or pause the film']").click()
    assert errors(browser) == []


def test_reports_and_surfaces_come_from_the_folder_alone(server):
    cookie = {"Cookie": server.cookie()}
    status, headers, answer = server.get("/report?of=results/a%20%3Cb%3E", cookie)
    assert (status, answer) == (200, REPORT)
    assert headers["content-security-policy"].startswith("sandbox allow-scripts allow-downloads; default-src 'none'")
    assert server.get("/report?of=results/a%20%3Cb%3E")[0] == 403
    for request in ("/report?of=../x", "/report?of=results", "/report?of=%00", "/surface?of=/etc&quantity=n"):
        assert server.get(request, cookie)[0] == 404
    assert server.get("/surface?of=film.zarr&quantity=index_excess&level=x", cookie)[0] == 404


@needs_browser
def test_the_app_on_a_result_opens_its_result_by_name(browser, tmp_path):
    result(tmp_path / "flame <3", 8, 0.0)
    with served(tmp_path / "flame <3") as server:
        cookie = {"Cookie": server.cookie()}
        status, headers, _ = server.get("/", cookie)
        assert (status, headers["location"]) == (307, "/results")
        browser.get(server.link)
        wait_for(browser, "return location.pathname === '/results' && window.socket?.connected")
        wait_for(browser, "return document.querySelectorAll('.cuts img[src]').length === 3")
        assert text(browser, ".tabled tr.chosen th") == "flame <3"
        headings = browser.execute_script("return [...document.querySelectorAll('main h2')].map(e => e.textContent)")
        assert "flame <3" in headings
        assert "." not in headings
        tab(browser, "In 3-D")
        wait_for(browser, "return document.querySelector('.legend li')?.textContent === 'flame <3'")
        tab(browser, "Report")
        wait_for(browser, "return document.querySelector('iframe.report')?.title === 'Report of flame <3'")
        tab(browser, "Export")
        wait_for(browser, "return document.querySelector('input[aria-label=\"File to write\"]')?.offsetParent")
        panel = "[...document.querySelectorAll('.command code')].map(code => code.textContent)"
        assert "nerif export . -o 'exports/flame <3.vti'" in browser.execute_script(f"return {panel}")
        assert errors(browser) == []


def test_other_folders_open_on_the_first_page(server):
    status, headers, _ = server.get("/", {"Cookie": server.cookie()})
    assert (status, headers["location"]) == (307, "/design")
