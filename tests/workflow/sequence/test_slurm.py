"""Sequences as jobs of a real SLURM, where one answers."""

from __future__ import annotations

import shutil
import subprocess
import sys

import numpy as np
import pytest

from sequence_films import QUICK

pytest.importorskip("dask_jobqueue", reason="pip install '.[cluster]'")

from nerif.workflow.sequence.store import DONE, SequenceStore


def slurm_answers() -> bool:
    if shutil.which("sbatch") is None:
        return False
    return subprocess.run(["sinfo"], capture_output=True, timeout=20, check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not slurm_answers(), reason="no SLURM answers here (Debian: slurm-wlm, one node)")
def test_jobs_reconstruct_a_film(film, tmp_path):
    out, file = tmp_path / "out.zarr", tmp_path / "slurm.yaml"
    file.write_text(
        f"jobs: 2\ncores: 1\nmemory: 2GB\nwalltime: '00:10:00'\nlog_directory: {tmp_path / 'logs'}\n"
        f"local_directory: {tmp_path}\ninterface: lo\n"
    )
    command = [sys.executable, "-m", "nerif", "sequence", str(film), "-o", str(out), *QUICK]
    done = subprocess.run(
        [*command, "--chunk", "6", "--cluster", str(file)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "24 of 24 frames done" in done.stdout
    assert (SequenceStore(out).status == DONE).all()
    assert np.isfinite(SequenceStore(out).array("index_excess")[:]).all()
    assert len(list((tmp_path / "logs").glob("*.err"))) == 2  # one for each job
    queue = subprocess.run(["squeue", "-h"], capture_output=True, text=True, timeout=20, check=True)
    assert queue.stdout.strip() == ""  # nothing is left behind
