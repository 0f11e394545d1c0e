"""Workers for the frames: processes of this machine, jobs of SLURM, or an existing Dask scheduler."""

from __future__ import annotations

import importlib.util
import inspect
import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from nerif import __version__
from nerif.common.conventions import InputError
from nerif.common.files import check_known, read_yaml
from nerif.common.installation import install

if TYPE_CHECKING:
    from distributed import Client, Security

__all__ = ["check_workers", "open_cluster", "slurm_cluster"]

DASK_SETTINGS = {
    "distributed.scheduler.allowed-failures": 0,  # run.py counts deaths by frame
    "distributed.deploy.lost-worker-timeout": "120s",  # a process or job whose worker does not return by then is ended
    "distributed.scheduler.worker-saturation": 1.0,  # chunks queue at the scheduler, not at workers
    "distributed.comm.timeouts.connect": "60s",
    "distributed.worker.profile.enabled": False,  # an hour of stack samples is a gigabyte
}
ANSWER_WITHIN = "5s"  # of an existing scheduler
LOOPBACK = "127.0.0.1"
NO_HTTP: dict[str, Any] = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
"""Without a dashboard, Dask still serves logs and file names by HTTP by default."""
JOB_PROLOGUE = [
    "export PYTHONSAFEPATH=1",  # no imports from the folder of a job; SLURM may not pass the environment on
    "export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False",
    'export DASK_DISTRIBUTED__WORKER__HTTP__ROUTES="[]"',
    'export DASK_TEMPORARY_DIRECTORY="$(mktemp -d)"',  # as in open_cluster
    "trap 'rm -rf \"$DASK_TEMPORARY_DIRECTORY\"' EXIT",
]
"""Shell lines of a job, which does not inherit the configuration of the command."""
EXAMPLES: dict[str, Any] = {
    "jobs": 4, "cores": 8, "processes": 1, "job_cpu": 8, "memory": "32GB", "walltime": "02:00:00",
    "job_script_prologue": ["source ~/nerif/bin/activate"], "job_extra_directives": ["--gres=gpu:1"],
    "job_directives_skip": ["-t"], "worker_extra_args": ["--lifetime", "55m"],
    "scheduler_options": {"host": "10.0.0.1"},
}  # fmt: skip
"""Settings of SLURM; others are texts, numbers, or true and false. YAML reads 10:00:00 without quotes as a number."""
PROTOCOLS = ("tcp://", "tls://", "ucx://", "ws://", "wss://")


def _cores() -> int:
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)  # available to the container or job


@contextmanager
def open_cluster(
    where: str, workers: int = 0, shared: Path | None = None, dashboard: bool = False
) -> Iterator[tuple[Client, int]]:
    """Give a client of a cluster, and the threads per worker (0: by default of the worker); close it at the end.

    Any client of a Dask process can run code in it. The processes of a cluster made here therefore communicate by TLS
    with the certificate of this run; those on this machine listen on the loopback only.

    Parameters
    ----------
    where : "local"; "tcp://host:port" of a scheduler; or a YAML file for SLURM (docs/sequences.md)
    workers : of a local cluster; 0: one per GPU, or per two cores
    shared : directory for the certificate that all jobs of SLURM can read (default: current)
    dashboard : serve the Dask dashboard on the loopback, visible to all users of this machine
    """
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise InputError(f"Dask is not installed; {install('sequence')}", field="cluster") from None
    if where.startswith(PROTOCOLS):
        with dask.config.set({"distributed.comm.timeouts.connect": ANSWER_WITHIN}):
            try:
                client = Client(where)
            except (OSError, TimeoutError, ValueError) as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise InputError(f"no scheduler answers at {where} ({reason})", field="cluster") from None
        with client:
            yield client, 0
        return
    if dashboard and importlib.util.find_spec("bokeh") is None:
        raise InputError(f"Bokeh is not installed; {install('sequence')}", field="dashboard")
    settings = DASK_SETTINGS if dashboard else DASK_SETTINGS | NO_HTTP
    # no other user can write to this directory, as Dask puts it on sys.path; its default has a fixed name
    private = tempfile.TemporaryDirectory(prefix="nerif-", ignore_cleanup_errors=True)
    with private as scratch, dask.config.set({**settings, "temporary-directory": scratch}):
        if where == "local":
            count = workers or torch.cuda.device_count() or max(1, _cores() // 2)
            cluster, threads = _local_cluster(count, dashboard), max(1, _cores() // count)
        else:
            cluster, threads = slurm_cluster(Path(where), shared, dashboard), 0
        with cluster as running, Client(running) as client:
            yield client, threads


def _certificate() -> Security:
    """Return the certificate of this run, in memory."""
    from distributed import Security

    if importlib.util.find_spec("cryptography") is None:
        raise InputError(f"cryptography is not installed; {install('sequence')}", field="cluster")
    return Security.temporary()


def check_workers(client: Client) -> None:
    """Wait for a worker, and check that all have this version of nerif: tasks that they cannot read would never end."""
    client.wait_for_workers(1)
    expression = "(__import__('nerif.workflow.sequence.run'), __import__('nerif').__version__)[1]"
    try:
        versions = client.run(eval, expression)
    except ImportError as error:
        raise InputError(
            f"a worker cannot import nerif ({error}); {install('sequence')} there, or activate its environment in "
            "job_script_prologue",
            field="cluster",
        ) from None
    for worker, version in versions.items():
        if version != __version__:
            raise InputError(f"worker {worker}: expected nerif {__version__} as here, got {version}", field="cluster")


@contextmanager
def _certificate_files(shared: Path) -> Iterator[Security]:
    """Give the certificate as files for jobs, and remove them at the end (those of dask-jobqueue may stay)."""
    from distributed import Security

    temporary = _certificate()
    with tempfile.TemporaryDirectory(prefix=".nerif-", dir=shared, ignore_cleanup_errors=True) as folder:
        certificate, key = Path(folder) / "certificate.pem", Path(folder) / "key.pem"
        certificate.write_text(temporary.tls_ca_file, encoding="utf-8")
        key.touch(0o600)
        key.write_text(temporary.tls_worker_key, encoding="utf-8")
        files = {f"tls_{role}_cert": str(certificate) for role in ("client", "scheduler", "worker")}
        files |= {f"tls_{role}_key": str(key) for role in ("client", "scheduler", "worker")}
        yield Security(require_encryption=True, tls_ca_file=str(certificate), **files)


def _local_cluster(workers: int, dashboard: bool = False) -> Any:
    """Return a cluster of processes on the loopback, each with a GPU of its own where there are GPUs."""
    from distributed import Nanny, Scheduler, SpecCluster

    gpus, security = _gpus(), _certificate()
    # dashboard_address is that of the HTTP server, which Dask opens with or without a dashboard
    common = {"host": LOOPBACK, "port": 0, "dashboard_address": f"{LOOPBACK}:0"}
    common |= {"protocol": "tls://", "security": security}
    options = {
        **common, "nthreads": 1, "memory_limit": 0, "dashboard": False,
        "silence_logs": logging.CRITICAL,  # errors of tasks are returned; a heartbeat may fail at the end
    }  # fmt: skip
    # Windows inherits no empty variable, without which Numba reads .numba_config.yaml of the current folder (cli.py)
    caches = {"NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR", "")}
    devices = [{"CUDA_VISIBLE_DEVICES": gpus[i % len(gpus)]} if gpus else {} for i in range(workers)]
    environments = [caches | device for device in devices]
    nannies = {i: {"cls": Nanny, "options": {**options, "env": env}} for i, env in enumerate(environments)}
    scheduler = {"cls": Scheduler, "options": {**common, "dashboard": dashboard}}
    return SpecCluster(workers=nannies, scheduler=scheduler, security=security, silence_logs="ERROR")


def _gpus() -> list[str]:
    """Return the names of the GPUs available to this process, as in CUDA_VISIBLE_DEVICES."""
    count = torch.cuda.device_count()
    names = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return (names or [str(i) for i in range(count)])[:count]


@contextmanager
def slurm_cluster(path: Path, shared: Path | None = None, dashboard: bool = False) -> Iterator[Any]:
    """Give the SLURM cluster of a YAML file with `jobs` and parameters of dask_jobqueue.SLURMCluster.

    Scheduler and workers listen on the network, but communicate by TLS. Certificate and key are in a subdirectory of
    `shared` that no other user can enter.
    """
    settings = {"shared_temp_directory": shared or Path.cwd(), **read_slurm(path)}
    jobs = settings.pop("jobs", 1)
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError:
        raise InputError(f"dask-jobqueue is not installed; {install('cluster')}", field="cluster") from None
    check_known(settings, _slurm_names(), str(path), more="; see docs/sequences.md")
    http = f"{LOOPBACK}:0"
    options, words = (_site_setting(path, settings, name) for name in ("scheduler_options", "worker_extra_args"))
    settings |= {
        "scheduler_options": {"dashboard": dashboard, "dashboard_address": http, **options},
        "worker_extra_args": [*words, "--no-dashboard", "--dashboard-address", http],
    }
    with (
        _certificate_files(Path(settings["shared_temp_directory"])) as security,
        SLURMCluster(**settings, security=security) as cluster,
    ):
        cluster.sync(_submit, cluster, jobs)
        yield cluster


async def _submit(cluster: Any, jobs: int) -> None:
    """Submit jobs; Dask's own `scale` leaves errors of sbatch to the log, and the command would wait without end."""
    from distributed.core import Status

    for _ in range(jobs):
        cluster.worker_spec.update(cluster.new_worker_spec())
    try:
        await cluster
    except (OSError, RuntimeError, ValueError) as error:
        for job in cluster.workers.values():
            if job.job_id is None:
                job.status = Status.failed  # without it, Dask refuses to close the cluster
        reason = " ".join((str(error).partition("stderr:")[2].strip() or str(error)).split())
        text = f"sbatch refused the job ({reason})"
        if isinstance(error, FileNotFoundError):
            text = "no command sbatch here; start nerif on a login node of SLURM"
        raise InputError(text, field="cluster") from None


def _site_setting(path: Path, settings: dict[str, Any], name: str) -> Any:
    """Return a setting of the file, or of Dask's own configuration of SLURM, or an empty one."""
    import dask

    value = settings.get(name) or dask.config.get(f"jobqueue.slurm.{name.replace('_', '-')}", None)
    _check_setting(path, name, value)
    return value or type(EXAMPLES[name])()


def _check_setting(path: Path, name: str, value: Any) -> None:
    """Refuse a value of another type than that of the setting."""
    example = EXAMPLES.get(name, "text")
    kinds = (type(example),) if name in EXAMPLES else (str, int, float)
    valid = isinstance(value, kinds)
    if isinstance(example, int):
        valid &= isinstance(value, int) and not isinstance(value, bool) and value >= 1
    if isinstance(example, list):
        valid &= all(isinstance(entry, str) for entry in value)
    if not valid and value is not None:
        expected = f"e.g. {example!r}" if name in EXAMPLES else "a text or a number"
        raise InputError(f"{name}: expected {expected}, got {value!r}", field=path)


def _slurm_names() -> list[str]:
    """Return the parameters of SLURMCluster and its jobs that are not set here."""
    from dask_jobqueue.core import Job, JobQueueCluster
    from dask_jobqueue.slurm import SLURMJob

    parts = (inspect.signature(part.__init__).parameters.values() for part in (JobQueueCluster, Job, SLURMJob))
    names = {p.name for part in parts for p in part if p.kind is not p.VAR_KEYWORD}
    return sorted(names - {"self", "scheduler", "job_cls", "security", "protocol"})


def read_slurm(path: Path) -> dict[str, Any]:
    """Read the settings of a SLURM cluster, by default with one process and one thread per job."""
    from dask.utils import parse_bytes

    if not path.is_file():
        raise InputError(f"expected local, tcp://HOST:PORT or a YAML file for SLURM, got '{path}'", field="cluster")
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"expected names and values such as 'queue: gpu', got {type(content).__name__}", field=path)
    settings = {str(k).replace("-", "_"): v for k, v in content.items()}
    for name, example in (("cores", "8"), ("memory", "32GB")):
        if settings.get(name) is None:
            raise InputError(f"expected '{name}' of a job, e.g. '{name}: {example}'", field=path)
    for name, value in settings.items():
        _check_setting(path, name, value)
    try:
        parse_bytes(settings["memory"])
    except ValueError as error:
        raise InputError(f"memory: {error}", field=path) from None
    prologue = settings.get("job_script_prologue") or []
    # a job is one worker that reconstructs one chunk at a time on all its cores
    settings = {"processes": 1, "job_cpu": settings["cores"], **settings, "cores": 1}
    return settings | {"job_script_prologue": [*JOB_PROLOGUE, *prologue]}
