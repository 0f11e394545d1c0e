"""A browser for the tests of the app, one for all files and as new for each, a server, and a project to copy."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.projects import AMBIENT, BOX, images, result, watched
from app.serving import Served, served
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.phantoms import Flame
from nerif.geometry import Grid, Ring
from nerif.simulation.simulation import Simulation
from report.browsing import open_browser


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    """The event loop of tests that are coroutines."""
    return "asyncio"


@pytest.fixture(scope="session", autouse=True)
def state_of_nobody(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A state directory of the tests: nothing is written into the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of three views, one with a broken image and one without flow; something of everything else."""
    project = tmp_path_factory.mktemp("project")
    images(project / "run", ("cam1", "cam <2>", "cam3"), {"target": 3, "background": 1, "reference": 2, "flow": 2})
    (project / "run" / "cam <2>" / "reference" / "p1.png").write_bytes(b"broken")
    shutil.rmtree(project / "run" / "cam3" / "flow")
    cameras = Ring(views=3, arc=(20.0, 100.0), image_size=(24, 30), pixel_pitch=0.2).cameras()
    write_cameras(project / "made.toml", [CalibratedCamera.from_camera(camera) for camera in cameras])
    Simulation(phantom="gaussians", truth_voxels=6, steps=20)(cameras)[0].write(project / "m.nc")
    result(project / "results" / "a <b>", 20, 0.0)
    result(project / "results" / "other", 16, 0.1)
    watched(project)
    grid = Grid.of_resolution(BOX, 12)
    store = VolumeSequence.create(project / "film.zarr", [0.0, 1e-3, 2e-3], grid, ("index_excess",), AMBIENT)
    for i in range(3):
        store.write(i, [Volume(Flame(BOX).sample(grid) * (1 - 0.4 * i), grid)])
    return project


@pytest.fixture(scope="module")
def folder(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project for the tests of a file."""
    return Path(shutil.copytree(project, tmp_path_factory.mktemp("copy") / "project"))


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A fresh Chromium."""
    driver = open_browser(tmp_path_factory.mktemp("browser"))
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def browser(chromium: Any) -> Iterator[Any]:
    """The browser with a window of a laptop, in the light, at rest; an empty page after the file, as scenes draw on."""
    chromium.get("about:blank")
    chromium.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    chromium.set_window_size(1440, 900)
    yield chromium
    chromium.get("about:blank")


@pytest.fixture(scope="session")
def server(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The app on a copy of the project."""
    with served(Path(shutil.copytree(project, tmp_path_factory.mktemp("served") / "project"))) as process:
        yield process
