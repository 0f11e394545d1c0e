"""Of two processes that write to one place, the second is refused; a lock ends with its process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from commands import run
from nerif.common.locks import LOCK, locked
from refusals import refused

HOLD = """
import sys
from pathlib import Path
from nerif.common.locks import locked
with locked(Path(sys.argv[1]), inside=sys.argv[2] == "True"):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture(params=[True, False], ids=["inside", "beside"])
def holder(request, tmp_path) -> Iterator[tuple[subprocess.Popen[str], Path, bool]]:
    """Another process that holds the lock of an output, the output, and whether the lock lies in it."""
    out, inside = tmp_path / "new" / "out", request.param
    line = [sys.executable, "-c", HOLD, str(out), str(inside)]
    with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process, out, inside
        process.kill()


def test_the_second_is_refused_until_the_first_has_ended(holder):
    process, out, inside = holder
    with refused(out) as error, locked(out, inside):
        pass
    assert f"(process {process.pid} on " in str(error.value)
    process.communicate("")
    assert process.returncode == 0
    assert not out.parent.exists()  # nor what was made for it
    with locked(out, inside):
        assert out.parent.exists()


def test_a_killed_process_leaves_no_lock(holder):
    process, out, inside = holder
    process.kill()
    process.wait()
    with locked(out, inside):
        assert any(path.name.endswith(LOCK) for path in out.parent.rglob(".*"))
    assert [path.name for path in out.parent.rglob("*")] == (["out"] if inside else [])


def test_waiting_for_the_other(holder):
    process, out, inside = holder
    process.stdin.close()
    with locked(out, inside, wait=True):
        pass
    assert process.wait(20) == 0


@pytest.mark.parametrize(
    ("line", "inside"),
    [
        ("simulate -o {out}/new.zarr --times 0:1e-3:2 --views 3 --image-size 6 8 --truth-voxels 5", False),
        ("render -o {out}/new.zarr --views 3 --image-size 6 8", True),
    ],
)
def test_commands_hold_the_lock(line, inside, tmp_path, capsys):
    if "times" in line:
        pytest.importorskip("zarr", reason="pip install '.[sequence]'")
    with locked(tmp_path / "new.zarr", inside):
        assert run(*line.format(out=tmp_path).split()) == 2
    assert "another run writes to it" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def no_locks(*_: object) -> None:
        raise OSError(95, "not supported")

    monkeypatch.setattr("nerif.common.locks._lock", no_locks)
    with locked(tmp_path / "out"), locked(tmp_path / "out"):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name == "nt", reason="links of POSIX")
def test_a_link_in_place_of_the_lock_leads_nowhere(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / LOCK).symlink_to(precious)
    with pytest.raises(OSError), locked(tmp_path, inside=True):
        pass
    assert precious.read_text() == "mine"
