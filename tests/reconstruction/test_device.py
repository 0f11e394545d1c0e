"""Devices and precisions, as far as they can be told without a GPU."""

from __future__ import annotations

from contextlib import suppress

import pytest
import torch

from nerif.fields.network import Network, NetworkShape
from nerif.reconstruction.device import (
    autocast_dtype,
    float32_products,
    keep_freed_memory,
    peak_memory,
    resolve_device,
)
from nerif.reconstruction.neural.losses import MixedPrecision
from nerif.reconstruction.neural.presets import PRESETS, preset
from refusals import refused


def test_auto_takes_the_gpu_where_there_is_one(monkeypatch):
    for there, kind, settings in ((True, "cuda", "best"), (False, "cpu", "fast")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        monkeypatch.setattr(torch.cuda, "device_count", lambda there=there: int(there))
        assert resolve_device("auto").type == kind
        assert preset("auto") == PRESETS[settings]


def test_gpu_that_is_not_there(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert resolve_device("cuda:1") == torch.device("cuda:1")
    with refused("device"):
        resolve_device("cuda:2")
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert resolve_device("cuda") == torch.device("cuda:1")  # under torchrun
    for name in ("tpu0", "meta"):
        with refused("device"):
            resolve_device(name)


@pytest.mark.parametrize(
    ("precision", "tf32", "low"),
    [("auto", True, True), ("bf16", True, True), ("tf32", True, False), ("float32", False, False)],
)
def test_precision_on_a_gpu(monkeypatch, precision, tf32, low):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: not including_emulation)
    mixed = MixedPrecision(Network(NetworkShape(depth=1, width=4, octaves=1)), torch.device("cuda"), precision, "off")
    assert (mixed.dtype is torch.bfloat16) is low
    assert mixed.products == ("high" if tf32 else "highest")
    assert torch.get_float32_matmul_precision() == "highest"


def test_a_gpu_that_emulates_bf16_is_not_asked_for_it(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation)
    assert autocast_dtype("auto", torch.device("cuda")) is None


def test_the_precision_of_products_is_what_it_was_afterwards():
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


def test_bf16_on_a_cpu_only_where_the_hardware_has_it(monkeypatch):
    cpu = torch.device("cpu")
    for there in (True, False):
        monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda there=there: there)
        assert (autocast_dtype("auto", cpu) is torch.bfloat16) is there
        assert autocast_dtype("bf16", cpu) is torch.bfloat16
        assert autocast_dtype("float32", cpu) is None


def test_peak_memory_counts_this_process():
    before = peak_memory(torch.device("cpu"))
    block = torch.ones(64 << 20, dtype=torch.uint8)
    assert peak_memory(torch.device("cpu")) >= max(before, block.numel())
    keep_freed_memory()  # must do no harm where it is called twice, or on another libc
    keep_freed_memory()
