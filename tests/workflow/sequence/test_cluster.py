"""Sequences on a cluster: workers that die, commands that are killed, schedulers that do not answer, SLURM."""

from __future__ import annotations

import asyncio
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
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from sequence_films import COLD, QUICK, blank, simulated

pytest.importorskip("distributed", reason="pip install '.[sequence]'")

from nerif import __version__
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.workflow.sequence import cluster
from nerif.workflow.sequence.cluster import _gpus, check_workers, open_cluster, read_slurm, slurm_cluster
from nerif.workflow.sequence.plan import SequenceSettings
from nerif.workflow.sequence.reconstruct import reconstruct_sequence
from nerif.workflow.sequence.store import DONE, FAILED, MISSING, SequenceStore
from refusals import refused

pytestmark = pytest.mark.filterwarnings("ignore:unclosed <(socket|ssl):ResourceWarning")


@pytest.fixture(autouse=True)
def _sockets_that_dask_leaves() -> Iterator[None]:
    """Collect them here: Dask drops the socket of a connection that it refuses, or that ends as the cluster does."""
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
    """Wait until so many frames are settled."""
    end = time.monotonic() + seconds
    while (status_of(out) != MISSING).sum() < frames:
        assert process.poll() is None, "the command ended before it was to be killed"
        assert time.monotonic() < end
        time.sleep(0.05)


def workers_of(process: subprocess.Popen) -> list[psutil.Process]:
    """The processes that reconstruct."""
    children = psutil.Process(process.pid).children(recursive=True)
    return [c for c in children if any("spawn_main" in word for word in c.cmdline())]


@pytest.fixture(scope="module")
def local() -> Iterator:
    """A client of a local cluster of one worker."""
    with open_cluster("local", 1) as (client, _):
        client.wait_for_workers(1)
        yield client


def listening() -> set[tuple[str, int]]:
    """Addresses that this process and its children listen on."""
    own = psutil.Process()
    found = [c for each in (own, *own.children(recursive=True)) for c in each.net_connections()]
    return {(c.laddr.ip, c.laddr.port) for c in found if c.status == psutil.CONN_LISTEN}


def addresses_of(client) -> dict[str, str]:
    """Addresses of the processes of a cluster of one worker, by what they are."""
    information = client.scheduler_info()
    ((worker, about),) = information["workers"].items()
    return {"scheduler": information["address"], "worker": worker, "nanny": about["nanny"]}


def test_no_process_of_a_local_cluster_listens_beyond_the_loopback(local):
    ports = {int(address.rsplit(":", 1)[1]) for address in addresses_of(local).values()}
    found = listening()
    assert ports <= {port for _, port in found}
    assert {ip for ip, _ in found} == {"127.0.0.1"}


@pytest.mark.parametrize("certificate", ["none", "another"])
def test_nobody_without_the_certificate_runs_anything_in_a_local_cluster(local, certificate):
    import dask
    from distributed import Security, rpc
    from distributed.protocol.pickle import dumps

    security = None if certificate == "none" else Security.temporary()

    async def run(address: str) -> int:
        given = {} if security is None else {"connection_args": security.get_connection_args("client")}
        async with rpc(address, **given) as process:
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
            with pytest.raises((urllib.error.URLError, OSError)) as refused:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=5)
            assert getattr(refused.value, "code", 404) == 404


@pytest.mark.skipif(sys.platform == "win32", reason="modes of POSIX")
def test_no_other_user_can_write_where_dask_looks_for_modules(local):
    def searched() -> list[str]:
        return [path for path in sys.path if "dask-scratch-space" in path]

    ((*found,),) = local.run(searched).values()
    found = {path.split("dask-scratch-space")[0] for path in (*found, *searched())}
    assert found
    assert {stat.S_IMODE(os.stat(path).st_mode) for path in found} == {0o700}


def test_a_dashboard_that_cannot_be_is_refused(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "bokeh" else name)
    with refused("dashboard"), open_cluster("local", 1, None, True):
        pass


def test_without_cryptography_no_cluster_is_opened(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "cryptography" else name)
    with refused("cluster"), open_cluster("local", 1):
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
    assert "frames to do" not in third.stdout  # nothing is done twice


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
def test_ctrl_c_keeps_what_is_done_and_says_how_to_go_on(film, tmp_path):
    out = tmp_path / "out.zarr"
    slowly = command(film, out, "--max-steps", "200", "--warm-steps", "100")
    process = subprocess.Popen(slowly, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait(out, 2, process)
    process.send_signal(signal.SIGINT)
    text, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "missing; the same command again does them" in text
    assert "Traceback" not in errors
    assert (status_of(out) == DONE).sum() >= 2


@pytest.mark.slow
def test_memory_of_the_command_and_of_each_worker_stays_flat_over_500_frames(tmp_path, capsys):
    film, out = simulated(tmp_path / "long.zarr", 500), tmp_path / "out.zarr"
    process = subprocess.Popen(command(film, out, "--chunk", "25"), stdout=subprocess.DEVNULL)
    seen: dict[int, list[tuple[int, int]]] = {}
    while process.poll() is None:
        with suppress(psutil.NoSuchProcess):
            done = int((status_of(out) != MISSING).sum())
            for each in (psutil.Process(process.pid), *workers_of(process)):
                seen.setdefault(each.pid, []).append((done, each.memory_info().rss))
        time.sleep(0.1)
    assert process.returncode == 0
    assert (status_of(out) == DONE).all()
    assert len(seen) == 3
    for pid, looks in seen.items():
        early, late = (np.median([rss for done, rss in looks if low <= done < low + 100]) / 2**20 for low in (100, 400))
        name = "command" if pid == process.pid else "worker"
        with capsys.disabled():
            print(f"\n{name}: {early:.1f} MiB at frames 100 to 200, {late:.1f} MiB at frames 400 to 500", end="")
        assert late < 1.05 * early, name


@pytest.mark.slow
def test_a_frame_whose_worker_dies_three_times_is_recorded(film, tmp_path, monkeypatch):
    from nerif.workflow.sequence import run
    from nerif.workflow.sequence.run import run_sequence

    plan = _plan(film, tmp_path / "out.zarr", 6)
    deadly = tmp_path / "deadly.py"
    monkeypatch.syspath_prepend(tmp_path)  # workers get it
    deadly.write_text(
        "import os\nfrom nerif.workflow.sequence.run import _in_worker as real\n"
        "from nerif.workflow.sequence import frames\n"
        "before = frames._frame\n"
        "def _frame(plan, settings, measurement, *rest):\n"
        "    if abs(float(measurement.displacement.abs().sum()) - TOTAL) < 1e-6 * TOTAL:\n        os._exit(9)\n"
        "    return before(plan, settings, measurement, *rest)\n"
        "def work(plan, first, last, topic):\n    frames._frame = _frame\n    real(plan, first, last, topic)\n"
    )
    total = float(MeasurementSequence.read(film).frame(7).displacement.abs().sum())
    deadly.write_text(f"TOTAL = {total!r}\n" + deadly.read_text())
    module = importlib.import_module("deadly")
    monkeypatch.setattr(run, "_in_worker", module.work)
    with open_cluster("local", 2) as (client, _):
        progress = run_sequence(client, plan)
    store = SequenceStore(plan.out)
    assert np.flatnonzero(store.status == FAILED).tolist() == [7]
    assert (store.status == DONE).sum() == 23
    assert "its worker died 3 times" in store.reasons[7]
    assert (progress.done, progress.failed) == (23, 1)


def test_a_chunk_whose_work_raises_fails_with_the_reason_and_the_rest_goes_on(five, tmp_path, monkeypatch):
    from distributed import Client

    from nerif.workflow.sequence import run

    plan, real = _plan(five, tmp_path / "out.zarr", 3), run.reconstruct_frames

    def work(plan, first, last, event):
        real(plan, first, min(last, 1), event)
        if first == 0:
            raise KeyError("layer 7")
        real(plan, first, last, event)

    monkeypatch.setattr(run, "reconstruct_frames", work)
    with Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None) as client:
        progress = run.run_sequence(client, plan)
    store = SequenceStore(plan.out)
    assert store.status.tolist() == [DONE, FAILED, FAILED, DONE, DONE]
    assert store.reasons[1] == "KeyError: 'layer 7'"
    assert (progress.done, progress.failed) == (3, 2)


def _plan(film: Path, out: Path, chunk: int):
    from nerif.geometry import Grid
    from nerif.workflow.sequence.plan import SequencePlan

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


class Workers:
    """A client whose workers answer so."""

    def __init__(self, answer: str | Exception) -> None:
        self.answer = answer

    def wait_for_workers(self, count: int) -> None:
        assert count == 1

    def run(self, function, words):
        if isinstance(self.answer, Exception):
            raise self.answer
        assert function(words) == __version__  # what is asked makes sense here
        return {"tcp://node7": self.answer}


def test_workers_that_could_not_read_the_job_are_refused():
    check_workers(Workers(__version__))
    with refused("cluster"):
        check_workers(Workers("9.9"))
    with refused("cluster"):
        check_workers(Workers(ModuleNotFoundError("No module named 'nerif'")))


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("tcp://127.0.0.1:9", "no scheduler answers at tcp://127.0.0.1:9"),
        ("nowhere.yaml", "expected local, tcp://HOST:PORT or a YAML file"),
    ],
)
def test_a_cluster_that_is_not_there_is_refused(where, words, five, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cluster, "ANSWER_WITHIN", "0.2s")
    assert main(["sequence", str(five), "-o", str(tmp_path / "o.zarr"), *QUICK, "--cluster", where]) == 2
    assert words in capsys.readouterr().err


SLURM = """
jobs: 4
queue: gpu
cores: 8
memory: 32GB
walltime: "02:00:00"
job_extra_directives: ["--gres=gpu:1"]
job_script_prologue: ["source ~/nerif/bin/activate"]
"""


def test_the_job_script_of_slurm_asks_for_what_the_file_says(tmp_path, monkeypatch):
    pytest.importorskip("dask_jobqueue", reason="pip install '.[cluster]'")
    file = tmp_path / "slurm.yaml"
    file.write_text(SLURM)
    assert read_slurm(file)["cores"] == 1  # one chunk at a time in a job
    file.write_text(SLURM.replace("jobs: 4", "jobs: 0"))
    with pytest.raises(InputError, match="jobs: expected"), slurm_cluster(file):
        pass
    file.write_text(SLURM)
    monkeypatch.setattr("dask_jobqueue.SLURMCluster.scale", lambda self, jobs: None)  # sbatch is not to be run
    with slurm_cluster(file, tmp_path) as jobs:
        script = jobs.job_script()
        (folder,) = tmp_path.glob(".nerif-*")
        modes = [stat.S_IMODE(path.stat().st_mode) for path in (folder, folder / "key.pem")]
        assert jobs.scheduler_address.startswith("tls://")
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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("cores: [", "not a YAML file"),
        ("- 1", "expected names and values"),
        ("cores: 1\nmemory: 1GB\njob_script_prologue: module load x", "expected a list of shell lines"),
        ("cores: 4", "expected 'memory' of a job"),
        ("cores: 1\nmemory: 1GB\nscheduler_options: eth0", "scheduler_options: expected e.g. {'host': '10.0.0.1'}"),
        ("cores: 4\nmemory: 8GB\nqueu: x", "unknown key 'queu'; the nearest known one is 'queue'"),
    ],
)
def test_a_file_that_is_no_slurm_is_refused(text, words, tmp_path):
    file = tmp_path / "slurm.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=words), slurm_cluster(file):
        pass


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--workers", "-1"], "workers: expected 0 or more"),
        (["--chunk", "0"], "chunk: expected 1 or more"),
        (["--warm-rate", "0"], "warm_rate: expected a share above 0"),
        (["--quantities", "pressure"], "quantities: expected some of"),
        (["--time-limit", "5"], "time_limit: expected none in a sequence"),
        (["--withhold", "nobody"], "withhold: expected views out of"),
        (["--withhold", "0deg", "85deg", "170deg"], "every view is held out"),
    ],
)
def test_wrong_settings_are_refused_before_anything_is_made(arguments, words, five, tmp_path, capsys):
    out = tmp_path / "o.zarr"
    assert main(["sequence", str(five), "-o", str(out), *QUICK, *arguments]) == 2
    assert words in capsys.readouterr().err
    assert not out.exists()


def test_a_store_begun_with_other_settings_is_left_alone(five, tmp_path, capsys):
    out = tmp_path / "o.zarr"
    arguments = ["sequence", str(five), "-o", str(out), *QUICK, "--cluster", "nowhere.yaml"]
    assert main(arguments) == 2  # the store is there now
    capsys.readouterr()
    assert main([*arguments, "--seed", "4"]) == 2
    assert "seed: expected 0, with which it was begun, got 4" in capsys.readouterr().err
    assert main(["sequence", str(five), "-o", str(tmp_path / "o.nc"), *QUICK]) == 2
    assert "ending in .zarr" in capsys.readouterr().err


@pytest.mark.slow
def test_from_python_in_one_call(five, tmp_path):
    out, said, told = tmp_path / "r.zarr", [], []
    settings = SequenceSettings(chunk=3, warm_steps=10, voxels=10)
    arguments = {"workers": 1, "threads": 1, "say": said.append}
    store = reconstruct_sequence(out, five, COLD, settings, on_progress=told.append, **arguments)
    assert (store.status == DONE).all()
    assert {*store.quantities} == {"index_excess", "density"}
    assert store.attributes["gas"]["wavelength_nm"] == MeasurementSequence.read(five).fullest().wavelength_nm
    assert said[0].endswith("r.zarr: 5 of 5 frames to do, in chunks of 3")
    assert said[-1].startswith("5 of 5 frames done")
    assert told[-1].done == 5
    said.clear()
    reconstruct_sequence(str(out), str(five), COLD, settings, **arguments)
    assert len(said) == 1  # nothing is done twice
    with pytest.raises(InputError, match="chunk: expected 3, with which it was begun, got 4"):
        reconstruct_sequence(out, five, COLD, replace(settings, chunk=4), **arguments)
