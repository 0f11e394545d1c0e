"""Every example runs, and what it writes can be used."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from nerif.measurement import Measurement

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_own_data(tmp_path):
    path = tmp_path / "mine.nc"
    subprocess.run([sys.executable, str(EXAMPLES / "own_data.py"), str(path)], check=True)
    m = Measurement.read(path)
    assert m.names == ("left", "right")
    assert len(m.rays()[0]) > 10_000
    # a hot column is lighter than the ambient, so rays are bent outward: what is seen left of the axis comes
    # from further left, p0 < p, and d = p - p0 > 0 there
    left_half = m.displacement[0, 60, :99, 0]
    assert float(left_half.mean()) > 0


def test_examples_are_all_tested():
    assert {p.name for p in EXAMPLES.glob("*.py")} == {"own_data.py"}
