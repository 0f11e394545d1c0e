"""How many threads compute, on a machine that others use too."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest
import torch

from nerif.analysis.consistency import check_consistency
from nerif.analysis.prediction import predict, reproject
from nerif.analysis.rig_check import check_rig
from nerif.common.pauses import at_pauses, pause
from nerif.fields.grid import VoxelField
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction import device as threads
from nerif.reconstruction.device import Cores, Used, free_threads
from nerif.simulation.simulate import view_displacement

NUMBA_STARTS = """
import torch
torch.set_num_threads(1)
from nerif.reconstruction.neural import fused
from nerif.reconstruction.voxels import operator
from nerif.reconstruction.device import share_threads
from nerif.reconstruction.voxels import kernels_numba
share_threads()
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
        (0.0, 8 / 3, 8, 2),  # two other runs on eight cores
        (0.0, 14.8, 16, 15),
        (0.3, 15.5, 16, 16),
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
        self.used = Used(0.0, 0.0, 0.0, 0.0)
        self.silent = False

    def spend(self, seconds: float, idle: float, own: float) -> None:
        more = (seconds, idle * seconds, 0.0 if self.silent else 2 * seconds, own * seconds)
        self.used = Used(*(a + b for a, b in zip(self.used, more, strict=True)))

    def perf_counter(self) -> float:
        return self.used.clock


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    found = Machine()
    monkeypatch.setattr(threads, "_used", lambda: found.used)
    monkeypatch.setattr(threads.time, "perf_counter", found.perf_counter)
    monkeypatch.setattr(threads, "_quota", lambda: 64)
    return found


@pytest.mark.usefixtures("two_threads")
def test_a_core_is_left_to_another_program_and_taken_back_after_it(machine):
    def after(seconds: float, idle: float, own: float) -> int:
        machine.spend(seconds, idle, own)
        cores.look()
        return torch.get_num_threads()

    with Cores(torch.device("cpu")) as cores:
        assert after(0.4, 0.0, 1.0) == 2  # too early to tell
        assert after(0.4, 0.0, 1.0) == 1
        assert after(3.0, 1.0, 1.0) == 1
        assert after(3.0, 1.0, 1.0) == 2  # there is room for good
        assert after(3.0, 0.0, 1.0) == 1  # there was not
        assert [after(3.0, 1.0, 1.0) for _ in range(4)] == [1, 1, 1, 2]  # so more has to be seen
        assert after(3.0, 0.0, 1.0) == 1
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_threads_stay_where_the_machine_does_not_tell(machine, monkeypatch):
    with Cores(torch.device("cpu")) as cores:
        machine.silent = True
        machine.spend(3.0, 0.0, 1.0)
        cores.look()
        assert torch.get_num_threads() == 2
        monkeypatch.setattr(threads, "_used", lambda: None)
        for _ in range(2):
            machine.spend(3.0, 0.0, 1.0)
            cores.look()
        assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_a_container_has_the_cores_it_may_use(machine, monkeypatch):
    monkeypatch.setattr(threads, "_quota", lambda: 1)
    with Cores(torch.device("cpu")):
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
    first, later = threads._used(), threads._used()
    assert first is not None
    assert later is not None
    assert all(b >= a > 0 for a, b in zip(first, later, strict=True))


def test_numba_leaves_torch_the_threads_it_has():
    said = subprocess.run([sys.executable, "-c", NUMBA_STARTS], capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.split() == ["1"]


@pytest.mark.usefixtures("two_threads")
def test_short_pieces_of_work_go_on_with_what_is_known(machine):
    """Each would end before its first look: a core that is taken stays so from one to the next."""
    used = []
    with Cores(torch.device("cpu")):
        for _ in range(6):
            with Cores(torch.device("cpu")):
                machine.spend(0.3, 0.0, 1.0)
                pause()
                used.append(torch.get_num_threads())
    assert used == [2, 1, 1, 1, 1, 1]
    assert torch.get_num_threads() == 2
    machine.spend(9.0, 0.0, 1.0)
    pause()  # nobody looks any more
    assert torch.get_num_threads() == 2


def _grid_of(field) -> None:
    field.sample(Grid(Box.cube(2.0), (2, 3, 4)))


def _seen_of(field) -> None:
    predict(field, Ring(views=1, image_size=(5, 6), pixel_pitch=0.5).cameras(), Box.cube(40.0), 1.00027, samples=8)


def _traced(field) -> None:
    (camera,) = Ring(views=1, image_size=(5, 6), pixel_pitch=0.5).cameras()
    view_displacement(field, camera, Box.cube(40.0), 1.00027, 4)


def _through_voxels(field) -> None:
    grid = Grid(Box.cube(40.0), (4, 5, 6))
    cameras = Ring(views=1, image_size=(5, 6), pixel_pitch=0.5).cameras()
    predict(VoxelField.through(torch.zeros(grid.shape), grid), cameras, grid.box, 1.00027)


@pytest.mark.parametrize("work", [_grid_of, _seen_of, _traced, _through_voxels])
def test_long_work_pauses(work):
    count = []
    with at_pauses(lambda: count.append(1)):
        work(make_phantom("gaussians", Box.cube(40.0), 0))
    assert count


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("function", [reproject, predict, check_consistency, check_rig])
def test_stages_look_for_free_cores(function, monkeypatch):
    entered = []
    monkeypatch.setattr(Cores, "__enter__", lambda cores: entered.append(cores))
    with pytest.raises(TypeError):
        function()
    assert entered
