"""What the benchmarks share: the machine in words, and a table that is printed row by row and kept in a file."""

from __future__ import annotations

import argparse
import datetime
import multiprocessing
import platform
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

import torch

from nerif.common.files import atomic

__all__ = ["N_AMBIENT", "Table", "add_write", "alone", "machine"]

N_AMBIENT = 1.00027

T = TypeVar("T")


def machine(device: str = "auto") -> str:
    """One line on the processor or GPU that `device` is, with the version of PyTorch."""
    if torch.cuda.is_available() and device != "cpu":
        return f"{torch.cuda.get_device_name(None if device == 'auto' else device)}, torch {torch.__version__}"
    return f"{platform.machine()}, {torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}, " + (
        f"torch {torch.__version__}"
    )


def head(more: str = "") -> list[str]:
    """Command, machine and date, `more` after the date: the first lines of every result."""
    script = Path(sys.argv[0])
    command = shlex.join([f"benchmarks/{script.name}", *sys.argv[1:]])
    return [
        f"Command: `python {command}`  ",
        f"Machine: {machine()}  ",
        f"Date: {datetime.date.today().isoformat()}{more}",
        "",
    ]


def alone(function: Callable[..., T], *values: object) -> T:
    """Call a function in a process of its own, whose peak of memory is that of this call."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *values).result()


def add_write(parser: argparse.ArgumentParser) -> None:
    """Give a parser the option --write."""
    parser.add_argument("--write", type=Path, help="also write the table to this file, row by row")


class Table:
    """A table in Markdown under a title: each row is printed as it comes, and the file rewritten with it.

    Parameters
    ----------
    title : heading of the file
    columns : head of the table
    path : of the file; None for none
    more : what stands after the date
    """

    def __init__(self, title: str, columns: Sequence[str], path: Path | None, more: str = "") -> None:
        self.title, self.path, self.lines = title, path, head(more)
        self.say("\n".join(self.lines))
        self.begin(columns)

    def begin(self, columns: Sequence[str]) -> None:
        """Begin a table, the first or another one."""
        self.text("| " + " | ".join(columns) + " |", "|" + "---|" * len(columns))

    def row(self, cells: Iterable[str]) -> None:
        """Add a row."""
        self.text("| " + " | ".join(cells) + " |")

    def text(self, *lines: str) -> None:
        """Add lines as they are."""
        self.lines += lines
        self.say("\n".join(lines))
        if self.path:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic(self.path) as part:
                part.write_text(f"# {self.title}\n\n" + "\n".join(self.lines) + "\n")

    @staticmethod
    def say(text: str) -> None:
        """Print at once."""
        print(text, flush=True)
