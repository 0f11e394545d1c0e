"""The names of `nerif.*` have types for the type checkers of users, in the package that the wheel installs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CONSUMER = """
from pathlib import Path
from typing import assert_type

import xarray as xr
from matplotlib.figure import Figure
from torch import Tensor

import nerif


def reconstruct(path: Path) -> nerif.Reconstruction:
    measurement = nerif.Measurement.read(path)
    assert_type(measurement, nerif.Measurement)
    assert_type(measurement["0deg"], nerif.Measurement)
    assert_type(measurement.drop("0deg"), nerif.Measurement)
    assert_type(measurement.displacement, Tensor | None)
    method = nerif.preset("fast", max_steps=500)
    assert_type(method, nerif.NeRIF)
    return method(measurement)


def show(result: nerif.Reconstruction) -> Figure:
    assert_type(result.to_xarray(), xr.DataArray)
    volume = result.volume(60)
    assert_type(volume, nerif.Volume)
    assert_type(volume.values, Tensor)
    assert_type(volume.to_xarray(), xr.DataArray)
    result.write("density.nc", force=True)
    return volume.plot()


def simulate() -> nerif.Measurement:
    rig = nerif.Ring(views=6, arc=(0, 150), image_size=(24, 30), pixel_pitch=0.15)
    box = nerif.Box((-25, -25, -20), (25, 25, 20))
    return nerif.simulate(nerif.make_phantom("flame", box), rig.cameras(), box, n_ambient=1.00027, noise=0.05)


def evaluate(result: nerif.Reconstruction, path: Path) -> float:
    content = nerif.read(path / "m.nc")
    if isinstance(content, nerif.Measurement):
        print(content.names, nerif.evaluate_views(nerif.reproject(result.field, content))[0]["name"])
    truth = nerif.read_volume(path / "truth.nc")
    nerif.export(path / "truth.vti", [truth], force=True)
    try:
        return float(nerif.evaluate_volume(result.field, truth, content.n_ambient)["cc"])  # a mistake
    except nerif.InputError as error:
        assert_type(error.field, str)
        raise


nerif.Tikhonov(voxel=40)  # a mistake
nerif.Measurement.read(path=3)  # a mistake
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with the wheel, beside the packages of this one."""
    folder = tmp_path_factory.mktemp("types")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "src" / "nerif", source / "src" / "nerif", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "env")], check=True)
    python = folder / "env" / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    command = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    site = Path(subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip())
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site), str(source)]
    subprocess.run(pip, check=True)
    (site / "others.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return python


@pytest.mark.slow
def test_a_script_of_a_user_passes_the_strict_checker_and_its_mistakes_do_not(python: Path, tmp_path: Path) -> None:
    script = tmp_path / "consumer.py"
    script.write_text(CONSUMER, encoding="utf-8")
    words = ["--strict", "--config-file=", "--python-executable", str(python), "--cache-dir", str(tmp_path / "cache")]
    command = [sys.executable, "-m", "mypy", *words, script.name]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}  # the wheel only
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    errors = {int(line.split(":")[1]) for line in done.stdout.splitlines() if ": error:" in line}
    mistakes = {i for i, line in enumerate(CONSUMER.splitlines(), 1) if line.endswith("# a mistake")}
    assert errors == mistakes, done.stdout + done.stderr
