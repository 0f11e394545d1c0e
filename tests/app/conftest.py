"""A browser and a server for the tests of the app."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.serving import Served, served
from report.browsing import open_browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A fresh Chromium with a window of a laptop."""
    driver = open_browser(tmp_path_factory.mktemp("browser"))
    driver.set_window_size(1440, 900)
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Served]:
    """The app on the folder of a test's file."""
    with served(folder) as found:
        yield found
