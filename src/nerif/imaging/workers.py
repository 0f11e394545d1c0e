"""The same work on many things, in several processes where it is worth their start."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_all_start_methods, get_context
from typing import Any, TypeVar

__all__ = ["cores", "start_method", "work"]

Common = TypeVar("Common")
Task = TypeVar("Task")
Result = TypeVar("Result")


def cores() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def start_method() -> str:
    """Return how processes start: by a server that has no threads, where there is one, else each from nothing."""
    return "forkserver" if "forkserver" in get_all_start_methods() else "spawn"


def work(
    function: Callable[[Common, Task], Result], common: Common, tasks: Iterable[Task], processes: int
) -> Iterator[tuple[int, Result]]:
    """Yield function(common, task) with the number of each task, in the order in which they are done.

    Parameters
    ----------
    function : of a module, so that other processes find it
    common : what all tasks need; each process gets it once
    processes : 1 for none but this
    """
    tasks = list(tasks)
    processes = min(processes, len(tasks))
    if processes <= 1:
        for i, task in enumerate(tasks):
            yield i, function(common, task)
        return
    context = get_context(start_method())
    context.set_forkserver_preload([function.__module__])  # imported once for all processes; no matter elsewhere
    with ProcessPoolExecutor(processes, context, _begin, (function, common)) as pool:
        futures = {pool.submit(_one, task): i for i, task in enumerate(tasks)}
        try:
            for future in as_completed(list(futures)):
                yield futures.pop(future), future.result()
                del future  # or its result stays in memory
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


_common: tuple[Callable[[Any, Any], Any], Any]


def _begin(function: Callable[[Any, Any], Any], common: object) -> None:
    """Give a process what all its tasks have in common."""
    global _common
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command alone hears Ctrl-C
    cv2.setNumThreads(1)
    _common = function, common


def _one(task: object) -> Any:
    function, common = _common
    return function(common, task)
