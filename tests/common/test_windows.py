"""What differs on Windows, simulated: encodings, open files, names of files, modules, signals, closed output."""

from __future__ import annotations

import ast
import errno
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import nerif
from nerif.cli import cli
from nerif.cli.closed_output import is_closed_output
from nerif.common import files, installation
from nerif.common.installation import command_line
from nerif.common.interruption import interrupt
from nerif.imaging.masks import MaskShape, write_masks
from nerif.reconstruction.device import peak_memory
from nerif.reconstruction.field_files import CHECKPOINT, read_state, write_state
from nerif.reconstruction.reconstructor import State
from refusals import refused

SOURCE = Path(__file__).parents[2] / "src" / "nerif"
MAPS = Path("/proc/self/maps")
"""Files mapped into the memory of this process, on Linux."""

AS_ON_WINDOWS = """
import functools, multiprocessing, os, signal, sys, types, warnings

if __name__ == "__main__":
    # first all packages of others: on Windows they have other code
    import cv2, h5netcdf, matplotlib.figure, numba, PIL.Image, psutil, pydantic, rich.progress, scipy.stats
    import distributed, torch, xarray

    # a file that is open or mapped can be neither replaced, renamed nor removed
    def closed_only(change, *paths, **more):
        in_use = {file.path for file in psutil.Process().open_files()}
        with open("/proc/self/maps", encoding="utf-8") as lines:
            maps = lines.read()
        for path in () if more else map(os.path.realpath, paths):
            if path in in_use or f" {path}\\n" in maps:
                raise PermissionError(13, "The process cannot access the file because it is in use", path)
        change(*paths, **more)

    for name in ("replace", "rename", "remove", "unlink"):
        setattr(os, name, functools.partial(closed_only, getattr(os, name)))
    for name in ("fcntl", "grp", "pwd", "resource", "termios", "tty"):
        sys.modules[name] = None
    for name in ("fork", "geteuid", "getuid", "getpgid", "killpg", "sched_getaffinity", "setsid", "uname"):
        delattr(os, name)
    for name in [n for n in dir(signal) if n.startswith("SIG") and n not in WINDOWS_HAS]:
        delattr(signal, name)
    psutil.Process.memory_info = lambda process: types.SimpleNamespace(peak_wset=1 << 30)
    multiprocessing.get_all_start_methods = lambda: ["spawn"]
    warnings.filterwarnings("error", category=EncodingWarning, module=r"nerif\\.")
    sys.modules["msvcrt"] = types.SimpleNamespace(LK_LOCK=1, LK_NBLCK=2, locking=lambda *_: None)
    from nerif.cli.cli import main
    from nerif.common import locks

    locks.WINDOWS = True
    for words in COMMANDS:
        if code := main(words):
            sys.exit(f"{words!a} ended with {code}")
"""
WINDOWS_HAS = ["SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM", "SIG_DFL", "SIG_IGN"]


def test_every_text_is_read_and_written_in_utf8() -> None:
    """The default of Windows is the code page of the country."""
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = getattr(node.func, "attr", getattr(node.func, "id", "")) if isinstance(node, ast.Call) else ""
            if name not in ("open", "read_text", "write_text"):
                continue
            names = {keyword.arg for keyword in node.keywords}
            modes = {a.value for a in node.args if isinstance(a, ast.Constant)} & {"r", "w", "a", "x", "r+", "w+"}
            is_text = name != "open" or bool(modes) or "newline" in names
            assert not is_text or "encoding" in names, f"{path}:{node.lineno}"


@pytest.mark.slow
@pytest.mark.skipif(not MAPS.is_file(), reason="needs the list of mapped files of Linux")
def test_commands_run_without_what_windows_lacks(tmp_path: Path) -> None:
    """In a folder that code page 1252 cannot write, with output in it."""
    folder = tmp_path / "Flamme Ω"
    folder.mkdir()
    rig = "--box 20 18 16 --views 3 --image-size 12 14 --pixel-pitch 0.2 --steps 30 --truth-voxels 8 --noise 0.05"
    network = "--network.depth 2 --network.width 8 --max-steps 3 --voxels 8 --withhold none --no-report"
    lines = [
        f"simulate {rig} -o Ω.nc", "info Ω.nc", f"reconstruct Ω.nc -o Γ {network}", "reconstruct --resume -o Γ",
        f"reconstruct Ω.nc -o Γ {network} --force", "evaluate Γ --truth Ω.truth.nc", "info Γ", "reconstruct --help",
        *(f"export Γ -o Γ{ending} --force" for ending in (".csv", ".vti", ".nc", ".npz", ".mat", ".nc")),
        "figures Γ -o figures", "figures Γ -o figures", "report Γ", "project Γ -o Γ.p.nc --cameras Ω.nc",
        "mask Ω.nc --threshold 0.5 -o Ω.mask.nc",
        *(f"pattern --width 40 --height 30 -o Ω{ending}" for ending in (".png", ".pdf")),
    ]  # fmt: skip
    script = tmp_path / "as_on_windows.py"
    commands = f"WINDOWS_HAS = {WINDOWS_HAS}\nCOMMANDS = {[line.split() for line in lines]}\n"
    script.write_text(commands + AS_ON_WINDOWS, encoding="utf-8")
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252"}
    words = [sys.executable, "-X", "warn_default_encoding", str(script)]
    done = subprocess.run(words, env=environment, cwd=folder, capture_output=True, encoding="cp1252", check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert (folder / "Γ" / "report.html").is_file()
    assert (folder / "Γ.csv").read_text(encoding="utf-8").startswith("x")

    # the result and its truth, copied from there to here
    path = folder / "Γ" / "metrics.json"
    metrics = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**metrics, "truth": "C:\\data\\Ω.truth.nc"}), encoding="utf-8")
    assert nerif.read(folder / "Γ").truth is not None


def test_an_open_file_is_replaced_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, failures, pauses, replace = tmp_path / "live.json", [2], [], os.replace

    def busy(source: Path, target: Path) -> None:
        failures[0] -= 1
        if failures[0] >= 0:
            raise PermissionError(errno.EACCES, "Access is denied", str(source))
        replace(source, target)

    monkeypatch.setattr(files, "WINDOWS", True)
    monkeypatch.setattr(files.os, "replace", busy)
    monkeypatch.setattr(files.time, "sleep", pauses.append)
    files.write_json(path, {"step": 1})
    assert path.is_file()
    assert pauses == list(files.ATTEMPTS_AFTER[:2])

    failures[0] = 99
    with pytest.raises(PermissionError) as error:
        files.write_json(path, {"step": 2})
    assert error.value.filename == str(path)
    assert [p.name for p in tmp_path.iterdir()] == ["live.json"]


@pytest.mark.skipif(not MAPS.is_file(), reason="only Linux lists what is mapped")
def test_a_checkpoint_that_was_read_can_be_replaced(tmp_path: Path) -> None:
    """Windows replaces no file that is mapped into memory: --resume reads the checkpoint, then writes it again."""
    write_state(tmp_path, State({"weights": torch.arange(9.0)}, {"step": 3}))
    state = read_state(tmp_path)
    assert CHECKPOINT not in MAPS.read_text(encoding="utf-8")
    assert torch.equal(state.tensors["weights"], torch.arange(9.0))


@pytest.mark.parametrize("name", ["cam:1", "con", "COM1.left", "cam1.", "cam1 ", 'a "left"', "a|b", "a?", "a*b", "<1>"])
def test_names_of_views_that_no_file_can_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    drawing = {name: [MaskShape("polygon", ((4, 2), (11, 2), (11, 8)))]}
    assert files.is_file_name(name)
    monkeypatch.setattr(files, "WINDOWS", True)
    assert files.is_file_name("console 1.5, 0deg")
    with refused("view"):
        write_masks(tmp_path / "masks", drawing, {name: (12, 20)})
    assert not list(tmp_path.iterdir())


def test_peak_memory_without_the_module_resource(monkeypatch: pytest.MonkeyPatch) -> None:
    process = SimpleNamespace(memory_info=lambda: SimpleNamespace(peak_wset=1 << 30))
    monkeypatch.setattr("psutil.Process", lambda: process)
    monkeypatch.setitem(sys.modules, "resource", None)
    assert peak_memory(torch.device("cpu")) == 1 << 30


class Closed(io.TextIOWrapper):
    """Standard output whose reader has ended, as Windows reports it."""

    def write(self, text: str) -> int:
        raise OSError(errno.EINVAL, "Invalid argument")


def test_output_whose_reader_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    invalid = OSError(errno.EINVAL, "Invalid argument")
    assert not is_closed_output(invalid)
    monkeypatch.setattr("nerif.cli.closed_output.WINDOWS", True)
    assert is_closed_output(invalid)
    assert not is_closed_output(OSError(errno.EINVAL, "Invalid argument", "m.nc"))
    silenced: list[bool] = []
    monkeypatch.setattr("nerif.cli.closed_output.silence", lambda: silenced.append(True))
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", Closed(io.BytesIO(), encoding="utf-8"))
        assert cli.main(["--version"]) == 141
    assert silenced


CTRL_BREAK = """
import signal, sys

signal.SIGBREAK = signal.CTRL_BREAK_EVENT = signal.SIGUSR1
from nerif.cli.cli import main

sys.argv[0] = "nerif"
sys.exit(main())
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="needs a signal to stand in for Ctrl-Break")
def test_ctrl_break_stops_a_run_as_ctrl_c_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measurement, out = tmp_path / "m.nc", tmp_path / "r"
    rig = "--box 20 18 16 --views 3 --image-size 12 14 --pixel-pitch 0.2 --steps 30 --truth-voxels 8 --noise 0.05"
    assert cli.main(["simulate", *rig.split(), "-o", str(measurement)]) == 0
    words = f"reconstruct {measurement} -o {out} --network.depth 2 --network.width 8 --voxels 8 --withhold none --live"
    arguments = [sys.executable, "-c", CTRL_BREAK, *words.split(), "--max-steps", "1000000", "--no-report"]
    monkeypatch.setattr(signal, "CTRL_BREAK_EVENT", signal.SIGUSR1, raising=False)
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as process:
        while not (out / "live.json").is_file():
            assert process.poll() is None
            time.sleep(0.1)
        interrupt(process.pid)
        assert "stopping after this step" in process.communicate()[1]
    assert (out / "field.safetensors").is_file()


def test_command_lines_are_quoted_for_the_shell_of_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "WINDOWS", True)
    assert command_line(["info", r"C:\data\m.nc", "a b.nc"]) == r'nerif info C:\data\m.nc "a b.nc"'
