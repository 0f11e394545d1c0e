"""Sequences on a cluster: workers that die, commands that are killed, schedulers that do not answer, SLURM."""

from __future__ import annotations

import asyncio
import errno
import gc
import importlib
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from sequence_films import COLD, QUICK, blank

pytest.importorskip("distributed", reason="pip install '.[sequence]'")

from nerif import __version__
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.common.locks import locked
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.geometry import Grid
from nerif.workflow.sequence import cluster, run
from nerif.workflow.sequence.cluster import _gpus, check_workers, open_cluster, read_slurm, slurm_cluster
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.reconstruct_sequence import reconstruct_sequence
from nerif.workflow.sequence.store import DONE, FAILED, MISSING, SequenceStore
from refusals import refused

pytestmark = pytest.mark.filterwarnings("ignore:unclosed <(socket|ssl):ResourceWarning")


@pytest.fixture(autouse=True)
def _sockets_that_dask_leaves() -> Iterator[None]:
    """Collect them here: Dask drops the socket of a connection that it refuses, or that ends as the cluster does."""
    gc.freeze()  # only what the test makes is looked through
    yield
    gc.collect()


CHUNKS = ["--workers", "2", "--threads", "1", "--chunk", "6"]


def command(film: Path, out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "nerif", "sequence", str(film), "-o", str(out), *QUICK, *CHUNKS, *more]


def status_of(out: Path) -> np.ndarray:
    try:
        return SequenceStore(out).status
    except InputError:  # not begun yet
        return np.array([])


def wait(out: Path, frames: int, process: subprocess.Popen, seconds: float = 120) -> None:
    """Wait until that number of frames is complete or failed."""
    end = time.monotonic() + seconds
    while (status_of(out) != MISSING).sum() < frames:
        assert process.poll() is None, "the command ended before it was to be killed"
        assert time.monotonic() < end
        time.sleep(0.05)


def workers_of(process: subprocess.Popen | psutil.Process) -> list[psutil.Process]:
    """The processes that reconstruct."""
    children = psutil.Process(process.pid).children(recursive=True)
    return [c for c in children if any("spawn_main" in word for word in c.cmdline())]


@pytest.fixture(scope="module")
def local() -> Iterator:
    """A client of a local cluster of one worker."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("NUMBA_CACHE_DIR", raising=False)  # an empty one, which Windows does not inherit
        with open_cluster("local", 1) as (client, _):
            client.wait_for_workers(1)
            yield client


def listening() -> set[tuple[str, int]]:
    """Addresses that this process and its workers listen on, but no browser of other tests."""
    process = psutil.Process()
    connections = [c for p in (process, *workers_of(process)) for c in p.net_connections()]
    return {(c.laddr.ip, c.laddr.port) for c in connections if c.status == psutil.CONN_LISTEN}


def addresses_of(client) -> dict[str, str]:
    """Addresses of the processes of a cluster of one worker, by what they are."""
    information = client.scheduler_info()
    ((worker, about),) = information["workers"].items()
    return {"scheduler": information["address"], "worker": worker, "nanny": about["nanny"]}


def test_no_process_of_a_local_cluster_listens_beyond_the_loopback(local):
    ports = {int(address.rsplit(":", 1)[1]) for address in addresses_of(local).values()}
    addresses = listening()
    assert ports <= {port for _, port in addresses}
    assert {ip for ip, _ in addresses} == {"127.0.0.1"}


@pytest.mark.parametrize("certificate", ["none", "another"])
def test_nobody_without_the_certificate_runs_anything_in_a_local_cluster(local, certificate):
    import dask
    from distributed import Security, rpc
    from distributed.protocol.pickle import dumps

    security = None if certificate == "none" else Security.temporary()

    async def run(address: str) -> int:
        arguments = {} if security is None else {"connection_args": security.get_connection_args("client")}
        async with rpc(address, **arguments) as process:
            return await process.run(function=dumps(os.getpid), args=(), kwargs={}, wait=True)

    for address in addresses_of(local).values():
        assert address.startswith("tls://")
        address = address if security else address.replace("tls://", "tcp://")
        with dask.config.set({"distributed.comm.timeouts.connect": "1s"}), pytest.raises(OSError):
            asyncio.run(run(address))
    assert list(local.run(os.getpid).values()) != [os.getpid()]  # with it, the worker answers


def test_a_local_cluster_shows_nothing_by_http(local):
    for _, port in listening():
        for page in ("status", "metrics", "json/identity.json", "info/main/workers.html", "health"):
            with pytest.raises((urllib.error.URLError, OSError)) as error:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=5)
            assert getattr(error.value, "code", 404) == 404


def test_workers_have_the_empty_variable_that_windows_does_not_inherit(local):
    """Without it, Numba takes the place of its compiled code from a file of the current folder."""
    assert list(local.run(os.getenv, "NUMBA_CACHE_DIR").values()) == [""]


@pytest.mark.skipif(sys.platform == "win32", reason="modes of POSIX")
def test_no_other_user_can_write_where_dask_looks_for_modules(local):
    def searched() -> list[str]:
        return [path for path in sys.path if "dask-scratch-space" in path]

    ((*paths,),) = local.run(searched).values()
    folders = {path.split("dask-scratch-space")[0] for path in (*paths, *searched())}
    assert folders
    assert {stat.S_IMODE(os.stat(folder).st_mode) for folder in folders} == {0o700}


@pytest.mark.parametrize(("package", "field"), [("bokeh", "dashboard"), ("cryptography", "cluster")])
def test_packages_that_are_not_installed(monkeypatch, package, field):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == package else name)
    with refused(field), open_cluster("local", 1, None, True):
        pass


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="kills processes by POSIX signals")
def test_killed_workers_a_killed_command_and_a_frame_of_nan_leave_a_complete_store(film, tmp_path):
    spoilt = Path(shutil.copytree(film, tmp_path / "film.zarr"))
    blank(spoilt, 9)
    calm, out = tmp_path / "calm.zarr", tmp_path / "out.zarr"
    done = subprocess.run(command(spoilt, calm), capture_output=True, text=True, timeout=200, check=True)
    assert "23 of 24 frames done" in done.stdout

    first = subprocess.Popen(command(spoilt, out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait(out, 3, first)
    workers = workers_of(first)
    assert len(workers) == 2
    workers[0].send_signal(signal.SIGKILL)
    wait(out, 8, first)
    orphans = workers_of(first)
    first.send_signal(signal.SIGKILL)
    first.wait()
    _, alive = psutil.wait_procs(orphans, timeout=60)
    assert not alive, "workers went on without their command"
    assert (status_of(out) == MISSING).any()

    again = subprocess.run(command(spoilt, out), capture_output=True, text=True, timeout=200, check=True)
    assert "1 failed:\n  frame 9:" in again.stdout
    assert "no valid pixel" in again.stdout
    status = status_of(out)
    assert np.flatnonzero(status == FAILED).tolist() == [9]
    assert (np.delete(status, 9) == DONE).all()
    for i in range(24):
        a, b = (SequenceStore(path).volume(i, "index_excess").values.numpy() for path in (calm, out))
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-9)

    third = subprocess.run(command(spoilt, out), capture_output=True, text=True, timeout=100, check=True)
    assert "frames to reconstruct" not in third.stdout  # nothing is repeated


@pytest.mark.parametrize(
    ("visible", "count", "expected"), [(None, 2, ["0", "1"]), ("4, 7", 2, ["4", "7"]), ("", 0, [])]
)
def test_workers_share_the_gpus_that_are_left_to_the_command(monkeypatch, visible, count, expected):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.setattr("torch.cuda.device_count", lambda: count)
    assert _gpus() == expected


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_keeps_complete_frames_and_states_how_to_continue(film, tmp_path, number, code):
    out, scratch = tmp_path / "out.zarr", tmp_path / "scratch"
    scratch.mkdir()
    slowly = command(film, out, "--max-steps", "200", "--warm-steps", "100")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": {**os.environ, "TMPDIR": str(scratch)}}
    process = subprocess.Popen(slowly, text=True, **pipes)
    wait(out, 2, process)
    process.send_signal(number)
    text, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert not list(scratch.glob("nerif-*"))
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    assert "missing; run the same command again" in text
    assert "Traceback" not in errors
    assert (status_of(out) == DONE).sum() >= 2


@pytest.mark.slow
def test_a_frame_whose_worker_dies_three_times_is_recorded(film, tmp_path, monkeypatch):
    plan = _plan(film, tmp_path / "out.zarr", 6)
    deadly = tmp_path / "deadly.py"
    monkeypatch.syspath_prepend(tmp_path)  # workers get it
    deadly.write_text(
        "import os\nfrom nerif.workflow.sequence.run import _in_worker as real\n"
        "from nerif.workflow.sequence import chunk\n"
        "before = chunk._frame\n"
        "def _frame(plan, settings, measurement, *rest):\n"
        "    if abs(float(measurement.displacement.abs().sum()) - TOTAL) < 1e-6 * TOTAL:\n        os._exit(9)\n"
        "    return before(plan, settings, measurement, *rest)\n"
        "def work(plan, first, last, topic):\n    chunk._frame = _frame\n    real(plan, first, last, topic)\n"
    )
    total = float(MeasurementSequence.read(film).frame(7).displacement.abs().sum())
    deadly.write_text(f"TOTAL = {total!r}\n" + deadly.read_text())
    module = importlib.import_module("deadly")
    monkeypatch.setattr(run, "_in_worker", module.work)
    with open_cluster("local", 2) as (client, _):
        progress = run.run_sequence(client, plan)
    store = SequenceStore(plan.out)
    assert np.flatnonzero(store.status == FAILED).tolist() == [7]
    assert (store.status == DONE).sum() == 23
    assert "its worker died 3 times" in store.reasons[7]
    assert (progress.done, progress.failed) == (23, 1)


def raising(real, plan, first, last, event):
    real(plan, first, min(last, 1), event)
    if first == 0:
        raise KeyError("layer 7")
    real(plan, first, last, event)


def dying(real, plan, first, last, event):
    from distributed import KilledWorker

    if first == 0:
        raise KilledWorker("frames", SimpleNamespace(address=""), 0)
    real(plan, first, last, event)


def filling(*_):
    raise OSError(errno.ENOSPC, "no space")


@pytest.mark.parametrize(
    ("work", "workers", "status", "loss"),
    [
        pytest.param(raising, 1, [DONE, FAILED, FAILED, DONE, DONE], "", marks=pytest.mark.slow),
        (dying, 1, [MISSING] * 3 + [DONE] * 2, "workers died 10 times; "),  # before they begin a frame
        (filling, 1, [MISSING] * 5, None),  # fails no frame
        (raising, 0, [MISSING] * 5, "workers died 0 times; ended, since no worker is left"),
    ],
)
def test_a_run_whose_chunks_or_workers_fail(five, tmp_path, monkeypatch, work, workers, status, loss):
    from distributed import Client

    plan = _plan(five, tmp_path / "out.zarr", 3)
    monkeypatch.setattr(run, "reconstruct_frames", partial(work, run.reconstruct_frames))
    for name in ("LOOK_EVERY", "WITHOUT_WORKERS") if not workers else ():
        monkeypatch.setattr(run, name, 0.1)
    with Client(processes=False, n_workers=workers, threads_per_worker=1, dashboard_address=None) as client:
        if loss is None:
            with pytest.raises(OSError) as error:
                run.run_sequence(client, plan)
            assert error.value.errno == errno.ENOSPC
        else:
            progress = run.run_sequence(client, plan)
            assert (progress.done, progress.failed) == (status.count(DONE), status.count(FAILED))
            assert progress.loss.startswith(loss)
    store = SequenceStore(plan.out)
    assert store.status.tolist() == status
    assert {*store.reasons} <= {"", "KeyError: 'layer 7'"}


@pytest.mark.parametrize(
    ("status", "code"), [([DONE, FAILED], 0), ([DONE, MISSING], 1), ([FAILED, FAILED], 1)]
)  # fmt: skip
def test_a_command_that_leaves_frames_missing_fails(five, monkeypatch, status, code):
    from nerif.cli.commands import sequence

    monkeypatch.setattr(sequence, "run", lambda settings: SimpleNamespace(status=np.array(status)))
    assert main(["sequence", str(five), "-o", "r.zarr"]) == code


def _plan(film: Path, out: Path, chunk: int) -> SequencePlan:
    sequence = MeasurementSequence.read(film)
    grid = Grid.of_resolution(sequence.fullest().box, 10)
    SequenceStore.begin(out, sequence, grid, ("index_excess",), COLD.network, {})
    settings = SequenceSettings(chunk=chunk, warm_steps=10, voxels=10, quantities=("index_excess",))
    return SequencePlan(film, out, COLD, settings, threads=1)


def test_a_scheduler_that_is_there_already_is_used(five, tmp_path):
    from distributed import LocalCluster

    out = tmp_path / "out.zarr"
    network = {"processes": False, "protocol": "tcp://", "dashboard_address": None}  # words go by sockets all the same
    with LocalCluster(n_workers=1, threads_per_worker=1, **network) as running:
        address = running.scheduler_address
        arguments = [*QUICK, "--max-steps", "4", "--warm-steps", "2", "--chunk", "12", "--threads", "1"]
        assert main(["sequence", str(five), "-o", str(out), *arguments, "--cluster", address]) == 0
    assert (status_of(out) == DONE).all()


@pytest.mark.parametrize("answer", [__version__, "9.9", ModuleNotFoundError("No module named 'nerif'")], ids=str)
def test_workers_that_could_not_read_the_job_are_refused(answer):
    def ask(function, words):
        if isinstance(answer, Exception):
            raise answer
        assert function(words) == __version__  # the expression makes sense here
        return {"tcp://node7": answer}

    client = SimpleNamespace(run=ask, wait_for_workers=lambda count: None)
    with nullcontext() if answer == __version__ else refused("cluster"):
        check_workers(client)


SLURM = """
jobs: 4
queue: gpu
cores: 8
memory: 32GB
walltime: "02:00:00"
job_extra_directives: ["--gres=gpu:1"]
job_script_prologue: ["source ~/nerif/bin/activate"]
"""


def commands(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Put sbatch and scancel of one shell script first on the path, and nothing else if it is empty."""
    (folder / "bin").mkdir()
    for name in ("sbatch", "scancel") if script else ():
        (folder / "bin" / name).write_text(f"#!/bin/sh\n{script}\n")
        (folder / "bin" / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(folder / "bin"), prepend=":" if script else None)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("", "cluster: no command sbatch here; start nerif on a login node"),
        ("echo error: invalid partition >&2; exit 1", r"cluster: sbatch refused the job \(error: invalid partition\)"),
        ("echo no number", "cluster: sbatch refused the job .*no number"),
    ],
)
def test_jobs_that_cannot_be_submitted_end_the_command(script, words, tmp_path, monkeypatch, capfd):
    pytest.importorskip("dask_jobqueue", reason="pip install '.[cluster]'")
    file = tmp_path / "slurm.yaml"
    file.write_text(SLURM)
    commands(tmp_path, monkeypatch, script)
    with pytest.raises(InputError, match=words), open_cluster(str(file), shared=tmp_path):
        pass
    assert "Traceback" not in capfd.readouterr().err


def test_the_job_script_of_slurm_asks_for_what_the_file_says(tmp_path, monkeypatch):
    pytest.importorskip("dask_jobqueue", reason="pip install '.[cluster]'")
    file = tmp_path / "slurm.yaml"
    file.write_text(SLURM)
    assert read_slurm(file)["cores"] == 1  # one chunk at a time in a job
    commands(tmp_path, monkeypatch, "echo Submitted batch job $$; echo x >> $0.log")
    with slurm_cluster(file, tmp_path) as jobs:
        script = jobs.job_script()
        (folder,) = tmp_path.glob(".nerif-*")
        modes = [stat.S_IMODE(path.stat().st_mode) for path in (folder, folder / "key.pem")]
        assert jobs.scheduler_address.startswith("tls://")
        assert len((tmp_path / "bin" / "sbatch.log").read_text().split()) == 4
    assert len((tmp_path / "bin" / "scancel.log").read_text().split()) == 4
    for line in ("#SBATCH -p gpu", "#SBATCH --cpus-per-task=8", "#SBATCH -t 02:00:00", "#SBATCH --gres=gpu:1"):
        assert line in script
    assert "--nthreads 1" in script
    # by TLS, with a key that is in no script and that nobody else can read
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    assert f"--protocol tls:// --tls-ca-file {certificate} --tls-cert {certificate} --tls-key {key}" in script
    assert modes == [0o700, 0o600]
    assert not folder.exists()
    assert "--no-dashboard --dashboard-address 127.0.0.1:0" in script
    assert 'export DASK_DISTRIBUTED__WORKER__HTTP__ROUTES="[]"' in script
    assert 'export DASK_TEMPORARY_DIRECTORY="$(mktemp -d)"' in script
    assert "export PYTHONSAFEPATH=1" in script
    # stack samples fill a worker's memory; switched off before what the file itself wants
    prologue = ["export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False", "source ~/nerif/bin/activate"]
    assert [line for line in script.splitlines() if line in prologue] == prologue


NO_SLURM = {
    "cores: [": "not a YAML file",
    "- 1": "expected names and values",
    "cores: 1\nmemory: 1GB\njob_script_prologue: module load x": "expected e.g. .'source ~.*got 'module load x'",
    "cores: 1\nmemory: 1GB\njob_extra_directives: --gres=gpu:1": "job_extra_directives: expected e.g. ",
    "cores: 1\nmemory: 1GB\njob_extra_directives: [1]": "job_extra_directives: expected e.g. ",
    "cores: [8]\nmemory: 1GB": r"cores: expected e.g. 8, got \[8\]",
    "cores: 1.5\nmemory: 1GB": "cores: expected e.g. 8, got 1.5",
    "cores: true\nmemory: 1GB": "cores: expected e.g. 8, got True",
    "cores: 1\nmemory: [1GB]": "memory: expected e.g. '32GB'",
    "cores: 1\nmemory: 1GB\nprocesses: {a: 1}": "processes: expected e.g. 1",
    "cores: 1\nmemory: 1GB\njobs: 0": "jobs: expected e.g. 4",
    "cores: 1\nmemory: 1GB\nqueue: [gpu]": "queue: expected a text or a number",
    "cores: 1\nmemory: 1GB\nwalltime: 10:00:00": "walltime: expected e.g. '02:00:00', got 36000",
    "cores: 1\nmemory: much": "memory: Could not interpret 'much'",
    "cores: 4": "expected 'memory' of a job",
    "cores: 1\nmemory: 1GB\nscheduler_options: eth0": "scheduler_options: expected e.g. {'host': '10.0.0.1'}",
    "cores: 4\nmemory: 8GB\nqueu: x": "unknown key 'queu'; the nearest known one is 'queue'",
}


def test_a_file_that_is_no_slurm_is_refused(tmp_path):
    file = tmp_path / "slurm.yaml"
    for text, words in NO_SLURM.items():
        file.write_text(text)
        with pytest.raises(InputError, match=words), slurm_cluster(file):
            pass


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--workers -1", "workers: "),
        ("--chunk 0", "chunk: "),
        ("--warm-rate 0", "--warm-rate: "),
        ("--quantities pressure", "quantities: "),
        ("--time-limit 5", "--time-limit: "),
        ("--from images", "from: "),
        ("--refine cameras", "refine: "),
        ("--withhold nobody", "withhold: "),
        ("--withhold 0deg 85deg 170deg", "withhold: all views"),
        ("--cluster tcp://127.0.0.1:9", "cluster: no scheduler answers at tcp://127.0.0.1:9"),
        ("--cluster nowhere.yaml", "cluster: expected local, tcp://HOST:PORT or a YAML file"),
        ("-o x.nc", "out: "),
    ],
)
def test_invalid_options(arguments, words, five, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cluster, "ANSWER_WITHIN", "0.2s")
    assert main(["sequence", str(five), "-o", "o.zarr", *QUICK, *arguments.split()]) == 2
    assert words in capsys.readouterr().err
    assert "cluster" in words or not list(tmp_path.iterdir())


def test_a_store_of_another_run_or_of_other_settings_is_left_alone(five, tmp_path, capsys):
    out = tmp_path / "o.zarr"
    arguments = ["sequence", str(five), "-o", str(out), *QUICK, "--cluster", "nowhere.yaml"]
    with locked(out):
        assert main([*arguments, "--force"]) == 2
    assert "another run writes to it" in capsys.readouterr().err
    assert not out.exists()
    assert main(arguments) == 2  # the store is there now
    capsys.readouterr()
    assert main([*arguments, "--seed", "4"]) == 2
    assert "seed: expected 0" in capsys.readouterr().err


@pytest.mark.slow
def test_from_python_in_one_call(five, tmp_path):
    out, lines, progress = tmp_path / "r.zarr", [], []
    settings = SequenceSettings(chunk=3, warm_steps=10, voxels=10)
    arguments = {"workers": 1, "threads": 1, "say": lines.append}
    store = reconstruct_sequence(out, five, COLD, settings, on_progress=progress.append, **arguments)
    assert (store.status == DONE).all()
    assert {*store.quantities} == {"index_excess", "density"}
    assert store.attributes["gas"]["wavelength_nm"] == MeasurementSequence.read(five).fullest().wavelength_nm
    assert lines[0].endswith("r.zarr: 5 of 5 frames to reconstruct, in chunks of 3")
    assert lines[-1].startswith("5 of 5 frames done")
    assert progress[-1].done == 5
    lines.clear()
    reconstruct_sequence(str(out), str(five), COLD, settings, **arguments)
    assert len(lines) == 1  # nothing is repeated
    with pytest.raises(InputError, match=r"chunk: expected 3, .* got 4"):
        reconstruct_sequence(out, five, COLD, replace(settings, chunk=4), **arguments)


def slurm_answers() -> bool:
    if shutil.which("sbatch") is None:
        return False
    return subprocess.run(["sinfo"], capture_output=True, timeout=20, check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not slurm_answers(), reason="no SLURM answers here (Debian: slurm-wlm, one node)")
def test_jobs_reconstruct_a_film(film, tmp_path):
    pytest.importorskip("dask_jobqueue", reason="pip install '.[cluster]'")
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
