"""Short films of a small flame."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytest.importorskip("zarr", reason="pip install '.[sequence]'")

from sequence_films import simulated


@pytest.fixture(scope="session")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty-four frames of three views."""
    return simulated(tmp_path_factory.mktemp("film") / "film.zarr", 24)


@pytest.fixture(scope="session")
def five(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five frames, and the truth beside them."""
    return simulated(tmp_path_factory.mktemp("five") / "short.zarr", 5)


@pytest.fixture
def short(five: Path, tmp_path: Path) -> Path:
    """A copy of the five frames, to spoil."""
    for name in ("short.zarr", "short.truth.zarr"):
        shutil.copytree(five.with_name(name), tmp_path / name)
    return tmp_path / "short.zarr"
