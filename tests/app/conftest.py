"""A browser for the tests of the app."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from report.browsing import open_browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A fresh Chromium with a window of a laptop."""
    driver = open_browser(tmp_path_factory.mktemp("browser"))
    driver.set_window_size(1440, 900)
    yield driver
    driver.quit()
