"""Every script of benchmarks/ runs, at its smallest, and writes its table."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
SMALLEST = {
    "calibration": "--views 2 --arc 20 --pixels 320 --poses 8 --backgrounds 2",
    "choices": "--points 256 --pixels 12 --time-limit 5",
    "displacement": "--pixels 64 --phantom gaussians --background dots --method correlation",
    "flame": "--pixels 12 --noise 0.1 --preset fast --time-limit 5 --voxels 12",
    "paper_preset": "--phantom gaussians --seeds 1 --pixels 12 --points 300 --epochs 0.05",
    "methods": "--phantom gaussians --noise 0.1 --pixels 12 --voxels 12 --time-limit 5",
    "one_camera": "--phantom gaussian-jet --noise 0.1 --half-angle 5 --pixels 16 --seeds 1 --only peers",
    "particles": "--per-pixel 0.05 --pixels 48 --depth 12 --displacement 1 --window 12 --seeds 1",
    "sequence": "--views 3 --frames 2 --compared 1 --interval 1e-4 --pixels 12 --voxels 12 --cold 5 --warm 5",
    "verdicts": "--cases 1 --method tv",
    "voxel_cost": "--voxels 8 --basis linear --iterations 1 --pixels 12",
    "watching": "--pixels 12 --seconds 3 --turns 1",
    "warm_start": "--pixels 12 --seconds 8 --voxels 12 --fit-steps 5",
}
SHARED = ("abel_peers", "bench", "random_flows", "spoiling")  # by the scripts
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem not in SHARED)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_script(name, tmp_path):
    if name == "one_camera":
        pytest.importorskip("abel", reason="pip install '.[benchmarks]'")
    table = tmp_path / "results" / "table.md"
    words = [*SMALLEST[name].split(), "--write", str(table)] if name in SMALLEST else ["--help"]
    command = [sys.executable, str(FOLDER / f"{name}.py"), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    if name in SMALLEST:
        lines = table.read_text().splitlines()
        assert lines[0].startswith("# ")
        assert lines[2].startswith(f"Command: `python benchmarks/{name}.py --")
        rule = next(i for i, line in enumerate(lines) if line.startswith("|---"))
        head, row = lines[rule - 1], lines[rule + 1]
        assert head.count("|") == row.count("|") > 3
        assert "nan" not in row
