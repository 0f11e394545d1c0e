"""Short films of a small flame."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("zarr", reason="pip install 'nerif[sequence]'")

from sequence.films import simulated


@pytest.fixture(scope="session")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty-four frames of three views."""
    return simulated(tmp_path_factory.mktemp("film") / "film.zarr", 24)


@pytest.fixture
def short(tmp_path: Path) -> Path:
    """Five frames, to spoil."""
    return simulated(tmp_path / "short.zarr", 5)
