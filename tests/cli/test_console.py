"""Consoles that are not UTF-8 show question marks, not a traceback."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_a_name_that_the_console_cannot_show(encoding):
    words = [sys.executable, "-m", "nerif", "info", "Kamera Ω.nc"]
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run(words, env=environment, capture_output=True, check=False)
    assert done.returncode == 2
    assert b"Kamera ?.nc" in done.stderr
    assert b"Traceback" not in done.stderr
