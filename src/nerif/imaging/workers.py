"""Parallel work in several processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_all_start_methods, get_context
from typing import Any, TypeVar

from nerif.common.conventions import InputError

__all__ = ["cores", "start_method", "work"]

Common = TypeVar("Common")
Task = TypeVar("Task")
Result = TypeVar("Result")


def cores() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def start_method() -> str:
    """Return the start method of processes: a fork server, which has no threads, where the system has it."""
    return "forkserver" if "forkserver" in get_all_start_methods() else "spawn"


def work(
    function: Callable[[Common, Task], Result], common: Common, tasks: Iterable[Task], processes: int
) -> Iterator[tuple[int, Result]]:
    """Yield the number and result of function(common, task) for each task, as they finish.

    Parameters
    ----------
    function : of a module, so that other processes can import it
    common : argument of all tasks, sent once to each process
    processes : 1 for this one only

    Raises InputError if one of the processes is killed.
    """
    tasks = list(tasks)
    processes = min(processes, len(tasks))
    if processes <= 1:
        for i, task in enumerate(tasks):
            yield i, function(common, task)
        return
    context = get_context(start_method())
    context.set_forkserver_preload([function.__module__])  # imported once for all processes
    with ProcessPoolExecutor(processes, context, _begin, (function, common)) as pool:
        futures = {pool.submit(_one, task): i for i, task in enumerate(tasks)}
        try:
            for future in as_completed(list(futures)):
                yield futures.pop(future), future.result()
                del future  # frees its result
        except BrokenProcessPool:
            raise InputError(
                f"one of {processes} was killed, as the system does when memory runs out; end other programs, or, on "
                "Linux, work in one process by taskset -c 0 nerif ...",
                field="processes",
            ) from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


_work: tuple[Callable[[Any, Any], Any], Any]


def _begin(function: Callable[[Any, Any], Any], common: object) -> None:
    """Store the common argument in a new process."""
    global _work
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles Ctrl-C
    cv2.setNumThreads(1)
    _work = function, common


def _one(task: object) -> Any:
    function, common = _work
    return function(common, task)
