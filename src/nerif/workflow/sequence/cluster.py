"""Where the frames are reconstructed: workers on this machine, jobs of SLURM, or a Dask scheduler that runs already."""

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
from nerif.common.files import check_known
from nerif.common.installation import install

if TYPE_CHECKING:
    from distributed import Client, Security

__all__ = ["check_workers", "open_cluster", "slurm_cluster"]

CONFIG = {
    "distributed.scheduler.allowed-failures": 0,  # deaths are counted by frame, in run.py
    "distributed.scheduler.worker-saturation": 1.0,  # a chunk waits for a worker, not at one
    "distributed.comm.timeouts.connect": "60s",
    "distributed.worker.profile.enabled": False,  # an hour of stack samples is a gigabyte
}
ANSWER_WITHIN = "5s"  # a scheduler that is there already
LOOPBACK = "127.0.0.1"
SILENT: dict[str, Any] = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
"""Dask opens an HTTP server whether or not there is a dashboard; by default it shows logs and file names to anybody."""
IN_JOBS = [
    "export PYTHONSAFEPATH=1",  # nothing in the folder of a job is imported; SLURM may not pass the environment on
    "export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False",
    'export DASK_DISTRIBUTED__WORKER__HTTP__ROUTES="[]"',
    'export DASK_TEMPORARY_DIRECTORY="$(mktemp -d)"',  # see _private
    "trap 'rm -rf \"$DASK_TEMPORARY_DIRECTORY\"' EXIT",
]
"""Shell lines of a job, which does not inherit the configuration of the command."""
PREFIX = ("tcp://", "tls://", "ucx://", "ws://", "wss://")


def _cores() -> int:
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)  # what a container or job leaves of the machine


@contextmanager
def open_cluster(
    where: str, workers: int = 0, shared: Path | None = None, dashboard: bool = False
) -> Iterator[tuple[Client, int]]:
    """Give a client of the cluster and the threads that each worker may use (0: as it finds them); close it at the end.

    Whoever can send a message to a Dask process can run code in it. So the processes of a cluster made here talk by
    TLS and accept only the certificate of this run; those on this machine listen on the loopback alone.

    Parameters
    ----------
    where : "local"; "tcp://host:port" of a scheduler; or a YAML file for SLURM (docs/sequences.md)
    workers : of a local cluster; 0 for one for each GPU, or for each two cores
    shared : directory that all jobs of SLURM can read, for their certificate; by default the current one
    dashboard : serve Dask's dashboard on the loopback, where every user of this machine can look at it

    Raises
    ------
    InputError
        If there is no such file or scheduler, the file is not understood, or a package is missing.
    """
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise InputError(f"Dask is not installed; {install('sequence')}", field="cluster") from None
    if where.startswith(PREFIX):
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
    with _private() as scratch, dask.config.set({**CONFIG, **({} if dashboard else SILENT), **scratch}):
        if where == "local":
            count = workers or torch.cuda.device_count() or max(1, _cores() // 2)
            cluster, threads = _local_cluster(count, dashboard), max(1, _cores() // count)
        else:
            cluster, threads = slurm_cluster(Path(where), shared, dashboard), 0
        with cluster as running, Client(running) as client:
            yield client, threads


@contextmanager
def _private() -> Iterator[dict[str, str]]:
    """Give Dask a scratch directory of its own, which no other user can write to: it puts that directory on sys.path.

    Its default is a directory of a fixed name in the temporary directory, which anybody may have made before.
    """
    with tempfile.TemporaryDirectory(prefix="nerif-", ignore_cleanup_errors=True) as scratch:
        yield {"temporary-directory": scratch}


def _certificate() -> Security:
    """A certificate of this run, held in memory, which every process of the cluster asks of the others."""
    from distributed import Security

    if importlib.util.find_spec("cryptography") is None:
        raise InputError(f"cryptography is not installed; {install('sequence')}", field="cluster")
    return Security.temporary()


def check_workers(client: Client) -> None:
    """Wait for a worker, and see that all have this version of nerif: work that they cannot read would never end.

    Raises
    ------
    InputError
        If one cannot import nerif, or has another version.
    """
    client.wait_for_workers(1)
    ask = "(__import__('nerif.workflow.sequence.run'), __import__('nerif').__version__)[1]"
    try:
        versions = client.run(eval, ask)
    except ImportError as error:
        raise InputError(
            f"a worker cannot import nerif ({error}); {install('sequence')} where it runs, or name "
            "that environment in job_script_prologue",
            field="cluster",
        ) from None
    for worker, version in versions.items():
        if version != __version__:
            raise InputError(f"worker {worker}: expected nerif {__version__} as here, got {version}", field="cluster")


@contextmanager
def _certificate_files(shared: Path) -> Iterator[Security]:
    """Such a certificate as files, for jobs: dask-jobqueue's own ones stay until its garbage is collected."""
    from distributed import Security

    temporary = _certificate()
    with tempfile.TemporaryDirectory(prefix=".nerif-", dir=shared, ignore_cleanup_errors=True) as folder:
        certificate, key = Path(folder) / "certificate.pem", Path(folder) / "key.pem"
        certificate.write_text(temporary.tls_ca_file)
        key.touch(0o600)
        key.write_text(temporary.tls_worker_key)
        files = {f"tls_{role}_cert": str(certificate) for role in ("client", "scheduler", "worker")}
        files |= {f"tls_{role}_key": str(key) for role in ("client", "scheduler", "worker")}
        yield Security(require_encryption=True, tls_ca_file=str(certificate), **files)


def _local_cluster(workers: int, dashboard: bool = False) -> Any:
    """A process for each worker, each with a GPU of its own where there are GPUs; none listens beyond the loopback."""
    from distributed import Nanny, Scheduler, SpecCluster

    gpus, security = _gpus(), _certificate()
    # dashboard_address is that of the HTTP server, which Dask opens with or without a dashboard
    common = {"host": LOOPBACK, "port": 0, "dashboard_address": f"{LOOPBACK}:0"}
    common |= {"protocol": "tls://", "security": security}
    specification = {}
    for i in range(workers):
        environment = {"CUDA_VISIBLE_DEVICES": gpus[i % len(gpus)]} if gpus else {}
        specification[i] = {
            "cls": Nanny,
            "options": {
                **common,
                "nthreads": 1,
                "env": environment,
                "memory_limit": 0,
                "dashboard": False,
                "silence_logs": logging.CRITICAL,  # errors of work come back with it; a heartbeat may fail at the end
            },
        }
    scheduler = {"cls": Scheduler, "options": {**common, "dashboard": dashboard}}
    return SpecCluster(workers=specification, scheduler=scheduler, security=security, silence_logs="ERROR")


def _gpus() -> list[str]:
    """The GPUs that this process may use, by the names that CUDA_VISIBLE_DEVICES takes."""
    count = torch.cuda.device_count()
    named = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return (named or [str(i) for i in range(count)])[:count]


@contextmanager
def slurm_cluster(path: Path, shared: Path | None = None, dashboard: bool = False) -> Iterator[Any]:
    """Give the SLURM cluster of a YAML file: `jobs`, and what dask_jobqueue.SLURMCluster takes.

    Scheduler and workers listen on the network, since jobs run on other machines, but talk by TLS. While they are
    there, certificate and key are in a directory of `shared` that no other user can enter.

    Raises
    ------
    InputError
        If the file is missing or no YAML, a key is unknown, or dask-jobqueue is not installed.
    """
    settings = {"shared_temp_directory": shared or Path.cwd(), **read_slurm(path)}
    jobs = settings.pop("jobs", 1)
    if not isinstance(jobs, int) or jobs < 1:
        raise InputError(f"jobs: expected a number of jobs of 1 or more, got {jobs!r}", field=path)
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError:
        raise InputError(f"dask-jobqueue is not installed; {install('cluster')}", field="cluster") from None
    check_known(settings, _slurm_names(), str(path), more="; see docs/sequences.md")
    http = f"{LOOPBACK}:0"
    options = _of_site(path, settings, "scheduler_options", {"host": "10.0.0.1"})
    scheduler = {"dashboard": dashboard, "dashboard_address": http, **options}
    words = _of_site(path, settings, "worker_extra_args", ["--lifetime", "55m"])
    extra = [*words, "--no-dashboard", "--dashboard-address", http]
    given = {**settings, "scheduler_options": scheduler, "worker_extra_args": extra}
    with (
        _certificate_files(Path(settings["shared_temp_directory"])) as security,
        SLURMCluster(**given, security=security) as cluster,
    ):
        cluster.scale(jobs=jobs)
        yield cluster


def _of_site(path: Path, settings: dict[str, Any], name: str, example: Any) -> Any:
    """A setting of the file or, without one, of Dask's own configuration of SLURM, of the type of the example."""
    import dask

    value = settings.get(name) or dask.config.get(f"jobqueue.slurm.{name.replace('_', '-')}", None) or type(example)()
    if not isinstance(value, type(example)):
        raise InputError(f"{name}: expected e.g. {example}, got {value!r}", field=path)
    return value


def _slurm_names() -> list[str]:
    """What SLURMCluster understands and is not fixed here: its own parameters and those of its jobs."""
    from dask_jobqueue.core import Job, JobQueueCluster
    from dask_jobqueue.slurm import SLURMJob

    parts = (inspect.signature(part.__init__).parameters.values() for part in (JobQueueCluster, Job, SLURMJob))
    named = [p.name for part in parts for p in part if p.kind is not p.VAR_KEYWORD]
    return sorted(set(named) - {"self", "scheduler", "job_cls", "security", "protocol"})


def read_slurm(path: Path) -> dict[str, Any]:
    """Read the settings of a SLURM cluster, with our defaults: one process, one thread."""
    import yaml

    if not path.is_file():
        raise InputError(f"expected local, tcp://HOST:PORT or a YAML file for SLURM, got '{path}'", field="cluster")
    try:
        found = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"not a YAML file ({' '.join(str(error).split())})", field=path) from None
    if not isinstance(found, dict):
        raise InputError(f"expected names and values such as 'queue: gpu', got {type(found).__name__}", field=path)
    wanted = {str(k).replace("-", "_"): v for k, v in found.items()}
    for name in ("cores", "memory"):
        if name not in wanted:
            raise InputError(
                f"expected '{name}' of a job, e.g. '{name}: {'8' if name == 'cores' else '32GB'}'", field=path
            )
    # a job is one worker that takes one chunk of time at once, on all cores of the job
    prologue = wanted.get("job_script_prologue") or []
    if not isinstance(prologue, list):
        raise InputError(
            f'job_script_prologue: expected a list of shell lines, ["source ~/nerif/bin/activate"], got {prologue!r}',
            field=path,
        )
    prologue = [*IN_JOBS, *prologue]
    return {"processes": 1, "job_cpu": wanted["cores"], **wanted, "cores": 1, "job_script_prologue": prologue}
