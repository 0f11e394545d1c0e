"""A small finished result, made once by the command line."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from nerif.cli.cli import main
from report.browsing import open_browser

RIG = ["--image-size", "18", "22", "--pixel-pitch", "0.2", "--views", "4", "--steps", "20", "--truth-voxels", "16"]
QUICK = [
    "--network.depth", "2", "--network.width", "24", "--network.octaves", "2", "--max-steps", "60",
    "--samples", "12", "16", "--sample-jitter", "2", "--points-per-batch", "600", "--voxels", "16", "--device", "cpu",
    "--precision", "float32",
]  # fmt: skip


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four views of balls in a box of three different edges, one withheld, with error bars and a truth."""
    folder = tmp_path_factory.mktemp("report")
    measurement, out = str(folder / "m.nc"), str(folder / "balls")
    box = ["--box", "50", "40", "30"]
    assert main(["simulate", "--phantom", "gaussians", "--noise", "0.05", "-o", measurement, *RIG, *box]) == 0
    run = ["reconstruct", measurement, "-o", out, "--withhold", "170deg", *QUICK]
    assert main([*run, "--uncertainty", "fast", "--no-report"]) == 0
    assert main(["evaluate", out, "--truth", str(folder / "m.truth.nc")]) == 0
    assert main(["report", out]) == 0
    return folder / "balls"


@pytest.fixture
def copy(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy to damage; the measurement and the truth that it names are in the current folder."""
    monkeypatch.chdir(whole.parent)
    return Path(shutil.copytree(whole, tmp_path / "copy"))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    driver = open_browser(tmp_path_factory.mktemp("profile"))
    yield driver
    driver.quit()
