"""How many threads compute, on a machine that others use too."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest
import torch

from nerif.reconstruction import threads
from nerif.reconstruction.threads import Cores, free_threads

NUMBA_STARTS = """
import torch
torch.set_num_threads(1)
from nerif.reconstruction import fused, operator
operator._compiled()
print(torch.get_num_threads())
"""


@pytest.mark.parametrize(
    ("idle", "own", "most", "found"),
    [
        (0.0, 2.0, 2, 2),  # alone
        (0.0, 1.7, 2, 2),  # beside a browser
        (0.0, 1.0, 2, 1),  # another run
        (1.0, 1.0, 2, 2),  # it has ended
        (0.0, 0.6, 2, 1),  # two others
        (30.0, 8.0, 8, 8),  # of a node with many cores
        (0.0, 14.7, 16, 15),
    ],
)
def test_threads_are_taken_where_cores_are_free(idle, own, most, found):
    assert free_threads(idle, own, most) == found


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


class Machine:
    """A clock and what two cores have done by then, in place of the machine's own."""

    def __init__(self) -> None:
        self.clock, self.idle, self.own = 0.0, 0.0, 0.0

    def spend(self, seconds: float, idle: float, own: float) -> None:
        self.clock += seconds
        self.idle += idle * seconds
        self.own += own * seconds

    def used(self) -> tuple[float, float, float]:
        return self.clock, self.idle, self.own

    def perf_counter(self) -> float:
        return self.clock


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    found = Machine()
    monkeypatch.setattr(threads, "_used", found.used)
    monkeypatch.setattr(threads.time, "perf_counter", found.perf_counter)
    return found


@pytest.mark.usefixtures("two_threads")
def test_a_core_is_left_to_another_program_and_taken_back_after_it(machine):
    with Cores(torch.device("cpu")) as cores:
        machine.spend(0.4, 0.0, 1.0)
        cores.look()  # too early to tell
        assert torch.get_num_threads() == 2
        machine.spend(0.4, 0.0, 1.0)
        cores.look()
        assert torch.get_num_threads() == 1
        machine.spend(3.0, 1.0, 1.0)
        cores.look()
        assert torch.get_num_threads() == 2
        machine.spend(3.0, 0.0, 1.0)
        cores.look()
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_no_more_threads_are_taken_than_were_given(machine):
    torch.set_num_threads(1)
    with Cores(torch.device("cpu")) as cores:
        machine.spend(3.0, 1.0, 1.0)
        cores.look()
        assert torch.get_num_threads() == 1


def test_what_the_machine_does_can_be_read():
    clock, idle, own = threads._used()
    later = threads._used()
    assert later[0] >= clock
    assert later[1] >= idle >= 0
    assert later[2] >= own > 0


def test_numba_leaves_torch_the_threads_it_has():
    said = subprocess.run([sys.executable, "-c", NUMBA_STARTS], capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.split() == ["1"]
