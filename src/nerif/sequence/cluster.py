"""Where the frames are reconstructed: workers on this machine, jobs of SLURM, or a Dask scheduler that runs already."""

from __future__ import annotations

import inspect
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from nerif import __version__
from nerif.conventions import InputError
from nerif.toml import check_known

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["check_workers", "open_cluster", "slurm_cluster"]

CONFIG = {
    "distributed.scheduler.allowed-failures": 0,  # deaths are counted by frame, in run.py
    "distributed.scheduler.worker-saturation": 1.0,  # a chunk waits for a worker, not at one
    "distributed.comm.timeouts.connect": "60s",
    "distributed.worker.profile.enabled": False,  # an hour of stack samples is a gigabyte
}
ANSWER_WITHIN = "5s"  # a scheduler that is there already
NO_PROFILE = "export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False"  # a job does not inherit CONFIG
PREFIX = ("tcp://", "tls://", "ucx://", "ws://", "wss://")


def _cores() -> int:
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)  # what a container or job leaves of the machine


@contextmanager
def open_cluster(where: str, workers: int = 0) -> Iterator[tuple[Client, int]]:
    """Give a client of the cluster and the threads that each worker may use (0: as it finds them); close it at the end.

    Parameters
    ----------
    where : "local"; "tcp://host:port" of a scheduler; or a YAML file for SLURM (docs/sequences.md)
    workers : of a local cluster; 0 for one for each GPU, or for each two cores

    Raises
    ------
    InputError
        If there is no such file or scheduler, or the file is not understood.
    """
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise InputError("cluster: Dask is not installed; pip install 'nerif[sequence]'") from None
    if where.startswith(PREFIX):
        with dask.config.set({"distributed.comm.timeouts.connect": ANSWER_WITHIN}):
            try:
                client = Client(where)
            except (OSError, TimeoutError, ValueError) as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise InputError(f"cluster: no scheduler answers at {where} ({reason})") from None
        with client:
            yield client, 0
        return
    with dask.config.set(CONFIG):
        if where == "local":
            count = workers or torch.cuda.device_count() or max(1, _cores() // 2)
            cluster, threads = _local_cluster(count), max(1, _cores() // count)
        else:
            cluster, threads = slurm_cluster(Path(where)), 0
        with cluster, Client(cluster) as client:
            yield client, threads


def check_workers(client: Client) -> None:
    """Wait for a worker, and see that all have this version of nerif: work that they cannot read would never end.

    Raises
    ------
    InputError
        If one cannot import nerif, or has another version.
    """
    client.wait_for_workers(1)
    ask = "(__import__('nerif.sequence.run'), __import__('nerif').__version__)[1]"
    try:
        versions = client.run(eval, ask)
    except ImportError as error:
        raise InputError(
            f"cluster: a worker cannot import nerif ({error}); install 'nerif[sequence]' where it runs, or name that "
            "environment in job_script_prologue"
        ) from None
    for worker, version in versions.items():
        if version != __version__:
            raise InputError(f"cluster: worker {worker}: expected nerif {__version__} as here, got {version}")


def _local_cluster(workers: int) -> Any:
    """A process for each worker, each with a GPU of its own where there are GPUs."""
    from distributed import Nanny, Scheduler, SpecCluster

    gpus = _gpus()
    specification = {}
    for i in range(workers):
        environment = {"CUDA_VISIBLE_DEVICES": gpus[i % len(gpus)]} if gpus else {}
        specification[i] = {
            "cls": Nanny,
            "options": {
                "nthreads": 1,
                "env": environment,
                "memory_limit": 0,
                "dashboard": False,
                "silence_logs": logging.ERROR,
            },
        }
    dashboard = {"dashboard": True, "dashboard_address": "localhost:0"} if _has_bokeh() else {"dashboard": False}
    scheduler = {"cls": Scheduler, "options": {"host": "localhost", "port": 0, **dashboard}}
    return SpecCluster(workers=specification, scheduler=scheduler, silence_logs="ERROR")


def _gpus() -> list[str]:
    """The GPUs that this process may use, by the names that CUDA_VISIBLE_DEVICES takes."""
    count = torch.cuda.device_count()
    named = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    return (named or [str(i) for i in range(count)])[:count]


def _has_bokeh() -> bool:
    try:
        import bokeh  # noqa: F401
    except ImportError:
        return False
    return True


def slurm_cluster(path: Path) -> Any:
    """Return the SLURM cluster of a YAML file: `jobs`, and what dask_jobqueue.SLURMCluster takes.

    Raises
    ------
    InputError
        If the file is missing or no YAML, a key is unknown, or dask-jobqueue is not installed.
    """
    settings = read_slurm(path)
    jobs = settings.pop("jobs", 1)
    if not isinstance(jobs, int) or jobs < 1:
        raise InputError(f"{path}: jobs: expected a number of jobs of 1 or more, got {jobs!r}")
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError:
        raise InputError("cluster: dask-jobqueue is not installed; pip install 'nerif[cluster]'") from None
    check_known(settings, _slurm_names(), str(path), more="; see docs/sequences.md")
    cluster = SLURMCluster(**settings)
    cluster.scale(jobs=jobs)
    return cluster


def _slurm_names() -> list[str]:
    """What SLURMCluster understands: its own parameters and those of its jobs."""
    from dask_jobqueue.core import Job, JobQueueCluster
    from dask_jobqueue.slurm import SLURMJob

    parts = (inspect.signature(part.__init__).parameters.values() for part in (JobQueueCluster, Job, SLURMJob))
    named = [p.name for part in parts for p in part if p.kind is not p.VAR_KEYWORD]
    return sorted(set(named) - {"self", "scheduler", "job_cls"})


def read_slurm(path: Path) -> dict[str, Any]:
    """Read the settings of a SLURM cluster, with the defaults that a worker of ours wants: one process, one thread."""
    import yaml

    if not path.is_file():
        raise InputError(f"cluster: expected local, tcp://HOST:PORT or a YAML file for SLURM, got '{path}'")
    try:
        found = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a YAML file ({' '.join(str(error).split())})") from None
    if not isinstance(found, dict):
        raise InputError(f"{path}: expected names and values such as 'queue: gpu', got {type(found).__name__}")
    wanted = {str(k).replace("-", "_"): v for k, v in found.items()}
    for name in ("cores", "memory"):
        if name not in wanted:
            raise InputError(f"{path}: expected '{name}' of a job, e.g. '{name}: {'8' if name == 'cores' else '32GB'}'")
    # a job is one worker that takes one chunk of time at once, on all cores of the job
    prologue = wanted.get("job_script_prologue") or []
    if not isinstance(prologue, list):
        raise InputError(
            f'{path}: job_script_prologue: expected a list of shell lines, ["source ~/nerif/bin/activate"], '
            f"got {prologue!r}"
        )
    prologue = [NO_PROFILE, *prologue]
    return {"processes": 1, "job_cpu": wanted["cores"], **wanted, "cores": 1, "job_script_prologue": prologue}
