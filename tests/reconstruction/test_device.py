"""Devices, precisions and memory without a GPU, and the number of threads on a machine with other load."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from types import SimpleNamespace

import pytest
import torch

from nerif.analysis.consistency import check_consistency
from nerif.analysis.prediction import predict, reproject
from nerif.analysis.rig_check import check_rig
from nerif.common.pauses import at_pauses, pause
from nerif.common.transfer import double_device
from nerif.fields.network import Network
from nerif.fields.network_shape import NetworkShape
from nerif.fields.phantoms import make_phantom
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction import device as threads
from nerif.reconstruction.device import (
    Cores,
    Used,
    autocast_dtype,
    float32_products,
    free_threads,
    keep_freed_memory,
    peak_memory,
    remark_on,
    resolve_device,
)  # fmt: skip
from nerif.reconstruction.neural import fused
from nerif.reconstruction.neural.losses import MixedPrecision
from nerif.reconstruction.neural.presets import PRESETS, preset
from nerif.simulation.simulate import view_displacement
from refusals import refused

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.fixture
def gpus(monkeypatch):
    """Set the numbers of GPUs by type."""

    def let(**counts: int) -> None:
        for kind in ("cuda", "xpu", "mps"):
            monkeypatch.setattr(getattr(torch, kind), "device_count", lambda kind=kind: counts.get(kind, 0))

    return let


@pytest.mark.parametrize(
    ("counts", "kind", "settings"),
    [({}, "cpu", "fast"), ({"cuda": 1, "xpu": 1}, "cuda", "best"), ({"xpu": 1, "mps": 1}, "xpu", "best"),
     ({"mps": 1}, "cpu", "fast")],
)  # fmt: skip
def test_auto_is_a_gpu_that_is_likely_faster(gpus, counts, kind, settings):
    gpus(**counts)
    assert resolve_device("auto").type == kind
    assert preset("auto") == PRESETS[settings]


def test_names_of_devices(gpus, monkeypatch):
    gpus(cuda=2, mps=1)
    assert resolve_device("cuda:1") == torch.device("cuda:1")
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert resolve_device("cuda") == torch.device("cuda:1")  # under torchrun
    for name in ("cuda:2", "tpu0", "meta", "mps:1"):
        with refused("device") as error:
            resolve_device(name)
        assert all(word in str(error.value) for word in (f"'{name}'", "cpu, cuda:0, cuda:1, mps:0"))
    with refused("device") as error:
        resolve_device("xpu")
    assert "XPU build" in str(error.value)


def test_double_precision_is_on_the_cpu_where_a_gpu_has_none(gpus, monkeypatch):
    gpus(cuda=1, xpu=2, mps=1)
    has = {0: True, 1: False}
    monkeypatch.setattr(torch.xpu, "get_device_properties", lambda device: SimpleNamespace(has_fp64=has[device.index]))
    double_device.cache_clear()
    for name, place in {"cuda:0": "cuda:0", "xpu:0": "xpu:0", "xpu:1": "cpu", "mps:0": "cpu", "cpu": "cpu"}.items():
        assert resolve_device(name, torch.float64) == torch.device(place)
        assert bool(remark_on(resolve_device(name))) is (place == "cpu" != name)
    double_device.cache_clear()


@pytest.mark.parametrize(
    ("precision", "tf32", "low"),
    [("auto", True, True), ("bf16", True, True), ("tf32", True, False), ("float32", False, False)],
)
def test_precision_on_a_gpu(monkeypatch, precision, tf32, low):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: not including_emulation)
    mixed = MixedPrecision(Network(NetworkShape(depth=1, width=4, octaves=1)), GPU, precision, "off")
    assert (mixed.dtype is torch.bfloat16) is low
    assert mixed.products == ("high" if tf32 else "highest")
    assert torch.get_float32_matmul_precision() == "highest"
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation)
    assert autocast_dtype("auto", GPU) is None  # a GPU that emulates bf16
    assert autocast_dtype("auto", torch.device("mps")) is None
    assert autocast_dtype("bf16", torch.device("mps")) is torch.bfloat16


def test_the_precision_of_products_is_restored():
    with suppress(ArithmeticError), float32_products("high"):
        assert torch.get_float32_matmul_precision() == "high"
        with float32_products("highest"):
            assert torch.get_float32_matmul_precision() == "highest"
        assert torch.get_float32_matmul_precision() == "high"
        raise ArithmeticError
    assert torch.get_float32_matmul_precision() == "highest"
    torch.backends.cuda.matmul.fp32_precision = "tf32"  # torch's newer switch, beside which the older cannot be read
    try:
        with float32_products("highest"):
            assert torch.backends.cuda.matmul.fp32_precision != "tf32"
        assert torch.backends.cuda.matmul.fp32_precision == "tf32"
    finally:
        torch.set_float32_matmul_precision("highest")


@pytest.mark.parametrize("available", [True, False])
def test_bf16_on_a_cpu_only_if_the_hardware_has_it(monkeypatch, available):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: available)
    assert (autocast_dtype("auto", CPU) is torch.bfloat16) is available
    assert autocast_dtype("bf16", CPU) is torch.bfloat16
    assert autocast_dtype("float32", CPU) is None


@pytest.mark.parametrize(
    ("shape", "precision", "compile", "expected"),
    [({}, "float32", "auto", True), ({}, "float32", "off", False), ({"activation": "tanh"}, "float32", "auto", False),
     ({"head_width": 4}, "float32", "auto", False), ({"skip": 2}, "float32", "auto", False),
     ({}, "bf16", "auto", False)],
)  # fmt: skip
def test_networks_with_fused_layers(shape, precision, compile, expected):
    mixed, calls = MixedPrecision(Network(NetworkShape(width=8, **shape)), CPU, precision, compile), []
    if mixed.fused is not None:
        mixed.fused = lambda *args: calls.append(args) or fused.value_and_gradient(*args)
    mixed.value_and_gradient(torch.rand(5, 3), False)
    assert bool(calls) == expected


def test_peak_memory_is_that_of_this_process():
    before = peak_memory(CPU)
    block = torch.ones(64 << 20, dtype=torch.uint8)
    assert peak_memory(CPU) >= max(before, block.numel())
    keep_freed_memory()  # harmless if called twice, or with another libc
    keep_freed_memory()


# -- threads -----------------------------------------------------------------------------------------------------------

NUMBA_STARTS = """
import torch
torch.set_num_threads(1)
from nerif.reconstruction.device import share_threads
from nerif.reconstruction.neural import fused
from nerif.reconstruction.voxels import kernels_numba
share_threads()
print(torch.get_num_threads())
"""


@pytest.mark.parametrize(
    ("idle", "process", "most", "free"),
    [
        (0.0, 2.0, 2, 2),  # alone
        (0.0, 1.7, 2, 2),  # beside a browser
        (0.0, 1.0, 2, 1),  # another run
        (1.0, 1.0, 2, 2),  # which has ended
        (0.0, 0.6, 2, 1),  # two others
        (30.0, 8.0, 8, 8),  # on a node with many cores
        (0.0, 8 / 3, 8, 2),  # two other runs on eight cores
        (0.0, 14.8, 16, 15),
        (0.3, 15.5, 16, 16),
    ],
)
def test_threads_for_a_load(idle, process, most, free):
    assert free_threads(idle, process, most) == free


class Machine:
    """A clock, and the counters of two cores."""

    def __init__(self) -> None:
        self.used = Used(0.0, 0.0, 0.0, 0.0)
        self.silent = False

    def spend(self, seconds: float, idle: float, process: float) -> None:
        more = (seconds, idle * seconds, 0.0 if self.silent else 2 * seconds, process * seconds)
        self.used = Used(*(a + b for a, b in zip(self.used, more, strict=True)))

    def threads_after(self, seconds: float, idle: float, process: float) -> int:
        self.spend(seconds, idle, process)
        pause()
        return torch.get_num_threads()


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[Machine]:
    """A machine on which torch has two threads."""
    machine, before = Machine(), torch.get_num_threads()
    monkeypatch.setattr(threads, "_used", lambda: machine.used)
    monkeypatch.setattr(threads.time, "perf_counter", lambda: machine.used.clock)
    monkeypatch.setattr(threads, "_quota", lambda: 64)
    torch.set_num_threads(2)
    yield machine
    torch.set_num_threads(before)


def test_a_core_is_left_to_another_program_and_used_again_after_it(machine):
    with Cores(CPU):
        assert machine.threads_after(0.4, 0.0, 1.0) == 2  # before the first measurement
        assert machine.threads_after(0.4, 0.0, 1.0) == 1
        assert machine.threads_after(3.0, 1.0, 1.0) == 1
        assert machine.threads_after(3.0, 1.0, 1.0) == 2  # free for good
        assert machine.threads_after(3.0, 0.0, 1.0) == 1  # it was not
        assert [machine.threads_after(3.0, 1.0, 1.0) for _ in range(4)] == [1, 1, 1, 2]  # so it takes longer
        assert machine.threads_after(3.0, 0.0, 1.0) == 1
    assert torch.get_num_threads() == 2


def test_a_fixed_number_of_threads_is_kept_whatever_the_load(machine):
    with Cores(CPU):
        with Cores(CPU, threads=3):
            assert machine.threads_after(3.0, 0.0, 1.0) == 3
            with Cores(CPU):
                assert machine.threads_after(3.0, 0.0, 1.0) == 3
        assert torch.get_num_threads() == 2
        assert machine.threads_after(3.0, 0.0, 1.0) == 1
    assert torch.get_num_threads() == 2


def test_threads_are_constant_without_counters(machine, monkeypatch):
    with Cores(CPU):
        machine.silent = True
        assert machine.threads_after(3.0, 0.0, 1.0) == 2
        monkeypatch.setattr(threads, "_used", lambda: None)
        assert [machine.threads_after(3.0, 0.0, 1.0) for _ in range(2)] == [2, 2]


def test_limits_of_a_container_and_of_the_user(machine, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(threads, "_quota", lambda: 1)
        with Cores(CPU):
            assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
    torch.set_num_threads(1)
    with Cores(CPU):
        assert machine.threads_after(3.0, 1.0, 1.0) == 1


def test_short_computations_share_the_measurements_of_an_outer_context(machine):
    counts = []
    with Cores(CPU):
        for _ in range(6):
            with Cores(CPU):
                counts.append(machine.threads_after(0.3, 0.0, 1.0))
    assert counts == [2, 1, 1, 1, 1, 1]
    assert torch.get_num_threads() == 2
    assert machine.threads_after(9.0, 0.0, 1.0) == 2  # nothing is measured outside of it


@pytest.mark.slow
def test_the_counters_of_this_machine_and_the_threads_of_numba():
    first, later = threads._used(), threads._used()
    assert first is not None
    assert later is not None
    assert all(b >= a > 0 for a, b in zip(first, later, strict=True))
    output = subprocess.run(
        [sys.executable, "-c", NUMBA_STARTS], capture_output=True, text=True, check=True, timeout=60
    )
    assert output.stdout.split() == ["1"]


RING = Ring(views=1, image_size=(5, 6), pixel_pitch=0.5)
BOX = Box.cube(40.0)
SPLINE = VoxelField.through(torch.zeros(4, 5, 6), Grid(BOX, (4, 5, 6)))
LONG_WORK = {
    "sample": lambda field: field.sample(Grid(Box.cube(2.0), (2, 3, 4))),
    "predict": lambda field: predict(field, RING.cameras(), BOX, 1.00027, samples=8),
    "trace": lambda field: view_displacement(field, RING.cameras()[0], BOX, 1.00027, 4),
    "voxels": lambda field: predict(SPLINE, RING.cameras(), BOX, 1.00027),
}


@pytest.mark.parametrize("work", LONG_WORK.values(), ids=LONG_WORK)
def test_long_work_pauses(work):
    count = []
    with at_pauses(lambda: count.append(1)):
        work(make_phantom("gaussians", BOX, 0))
    assert count


@pytest.mark.parametrize("function", [reproject, predict, check_consistency, check_rig])
def test_stages_run_on_free_cores(function, monkeypatch):
    entries = []
    monkeypatch.setattr(Cores, "__enter__", lambda cores: entries.append(cores))
    with pytest.raises(TypeError):
        function()
    assert entries
