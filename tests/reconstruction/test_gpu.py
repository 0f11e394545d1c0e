"""Runs on a GPU, without one: tensors are marked as being there, and must not be combined with others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

from nerif.analysis.prediction import reproject
from nerif.fields.network_shape import NetworkShape
from nerif.fields.voxel_field import VoxelField
from nerif.forward.deflection import LeverArm
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.ray_tracing import CurvedRays
from nerif.geometry import Grid, Lens
from nerif.reconstruction.detail.detail import Detail
from nerif.reconstruction.neural.presets import PRESETS
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation

pytestmark = pytest.mark.filterwarnings("ignore:User provided device_type of 'cuda'")

CPU, GPU, APPLE = (torch.device(name) for name in ("cpu", "cuda:7", "mps:0"))
READ = ("tolist", "item", "__float__", "__int__", "__bool__", "nonzero", "unique")
"""Functions that wait for the GPU."""


def place(x: Tensor) -> torch.device:
    return x.__dict__.get("place", CPU)


class PretendedGPU(TorchFunctionMode):
    """Keeps all numbers on the CPU, marks tensors that are on the GPU, and raises where torch would raise there.

    Records for what the CPU waits, such as copies that are not `non_blocking`, and products of reduced precision.
    Apple's has no double precision, not for a moment between two conversions either, and no pinned memory.
    """

    def __init__(self, gpu: torch.device = GPU) -> None:
        super().__init__()
        self.gpu, self.computed = gpu, 0  # operations there
        self.waits: list[str] = []
        self.rounded: set[str] = set()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = dict(kwargs or {}), func.__name__
        tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        there = any(place(x) == self.gpu for x in tensors)
        if name == "__get__" and func in (Tensor.device.__get__, Tensor.is_cuda.__get__):
            return place(args[0]) if func == Tensor.device.__get__ else there
        if name in ("device", "_parse_to", "_has_compatible_shallow_copy_type"):
            return func(*args, **kwargs)
        if name == "pin_memory":
            assert self.gpu != APPLE
            return args[0].detach()
        if name in ("to", "cpu"):
            return self._moved(args[0], "cpu" if name == "cpu" else args[1:], kwargs)
        self._check(name, args, tensors, there)
        to_gpu = self.gpu in tree_leaves((args, kwargs)) or there
        self.computed += there
        if to_gpu and name in ("tensor", "new_tensor"):
            self.waits.append(name)
        args, kwargs = tree_map(lambda x: CPU if isinstance(x, torch.device) else x, (args, kwargs))
        output = func(*args, **kwargs)
        if name == "__set__" and func == Tensor.data.__set__:
            args[0].__dict__["place"] = place(args[1])
        for x in tree_leaves(output) if to_gpu else ():
            if isinstance(x, Tensor):
                self._put(x, self.gpu)
        return output

    def _put(self, x: Tensor, where: torch.device) -> None:
        if where == APPLE and x.dtype in (torch.float64, torch.complex128):
            raise TypeError("Cannot convert a MPS Tensor to float64 dtype as the MPS framework doesn't support float64")
        x.__dict__["place"] = where

    def _check(self, name: str, args: Any, tensors: list[Tensor], there: bool) -> None:
        if name in ("einsum", "bmm") and torch.get_float32_matmul_precision() != "highest":
            self.rounded.add(name)
        if there and name in READ:
            self.waits.append(name)
        if there and name == "numpy":
            raise TypeError("numpy: expected a tensor on the CPU")
        if name in ("__getitem__", "__setitem__") and place(args[0]) == self.gpu:
            index = [i for i in tree_leaves(args[1]) if isinstance(i, Tensor)]
            self.waits += [name for i in index if i.dtype == torch.bool or place(i) == CPU]
        elif there and name not in ("copy_", "__set__") and any(place(x) == CPU and x.ndim for x in tensors):
            raise RuntimeError(f"{name}: expected all tensors on one device")

    def _moved(self, x: Tensor, wanted_device: Any, kwargs: dict[str, Any]) -> Tensor:
        target, dtype = place(x), x.dtype
        for a in tree_leaves((wanted_device, kwargs.get("device"), kwargs.get("dtype"), kwargs.get("other"))):
            if isinstance(a, Tensor):
                target, dtype = place(a), a.dtype
            elif isinstance(a, torch.dtype):
                dtype = a
            elif isinstance(a, torch.device | str):
                target = torch.device(a)
        if target != place(x) and not kwargs.get("non_blocking"):
            self.waits.append("to")
        same = target == place(x) and dtype == x.dtype and not kwargs.get("copy")
        with torch._C.DisableTorchFunction():
            moved = x if same else x.to(dtype, copy=True)
        if dtype == torch.float64 and place(x) != CPU:
            self._put(moved, self.gpu)  # torch converts a tensor before it is copied from a GPU
        self._put(moved, target)
        return moved


@pytest.fixture
def gpu(monkeypatch, unchecked) -> PretendedGPU:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 8)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: False)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: 0)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1 << 34, 1 << 34))
    return PretendedGPU()


@pytest.fixture
def apple(monkeypatch, unchecked) -> PretendedGPU:
    monkeypatch.setattr(torch.mps, "device_count", lambda: 1)
    return PretendedGPU(APPLE)


def test_projections_are_on_the_device_of_the_rays(measurement, ball, gpu):
    rays, _, _ = measurement.rays()
    with gpu:
        projected = project(PathIntegral(LeverArm(1.0003), 4), ball, rays[:9].to(GPU), GPU)
    assert place(projected) == GPU


SHAPE = NetworkShape(depth=2, width=8, octaves=2, skip=1, head_width=4, gradient_head=True)
SMALL = {"device": str(GPU), "compile": "off", "max_steps": 4, "samples": (6, 8), "sample_jitter": 1}
SMALL |= {"points_per_batch": 200, "epochs": 0.0, "stop_ratio": 0.0}
RUNS = {name: replace(p, network=SHAPE, **SMALL) for name, p in PRESETS.items()}
RUNS["curved"] = replace(RUNS["fast"], model="curved")
RUNS["symmetric"] = replace(
    RUNS["fast"], symmetry="axis+1", axis_sigma_mm=0.0, axis_sigma_deg=0.0, network=replace(SHAPE, gradient_head=False)
)
RUNS["refined"] = replace(RUNS["fast"], refine=("cameras", "shift"), max_steps=3)
RUNS["bounded"] = replace(RUNS["fast"], upper=0.0)
RUNS["voxels"] = TotalVariation(voxels=6, iterations=1, regularisation=1e-3, device=str(GPU))
LONG = ("refined", "voxels", "curved", "symmetric", "bounded")  # those without double precision mix no devices either


@pytest.mark.parametrize(
    ("name", "lens"),
    [
        *((name, None) for name in RUNS if name not in LONG),
        ("fast", Lens(12.0)),
        *(
            pytest.param("fast", Lens(window=3.0), marks=pytest.mark.slow),
            pytest.param("paper", Lens(12.0), marks=pytest.mark.slow),
        ),
        *(pytest.param(name, lens, marks=pytest.mark.slow) for name in LONG for lens in (None, Lens(12.0))),
    ],
)
def test_no_run_mixes_devices_or_rounds_outside_the_network(measurement, gpu, name, lens):
    projected = replace(measurement, cameras=tuple(replace(c, lens=lens) for c in measurement.cameras))
    with gpu:
        result = RUNS[name](projected)
    assert not result.outcome.failed
    assert result.device == str(GPU)
    assert not gpu.rounded


RUNS["default"] = replace(PRESETS["fast"], **(SMALL | {"max_steps": 3}))
RUNS["Tikhonov"] = Tikhonov(voxels=6, iterations=1, regularisation=1e-3)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == "refined" else n for n in RUNS])
def test_a_run_on_a_gpu_without_double_precision(measurement, apple, name):
    with apple:
        result = replace(RUNS[name], device="mps")(measurement)
    assert not result.outcome.failed
    assert result.device == "mps:0"
    assert apple.computed > 100
    assert result.outcome.message.endswith("; mps:0 has no double precision: what needs it ran on the CPU")


def test_voxels_in_double_precision_are_on_the_cpu(measurement, apple):
    with apple:
        result = replace(RUNS["Tikhonov"], precision="float64", device="mps")(measurement)
    assert (result.device, apple.computed) == ("cpu", 0)
    assert result.outcome.message.endswith("; mps:0 has no double precision: all ran on the CPU")


@pytest.mark.parametrize("model", [PathIntegral(LeverArm(1.0003), 4), CurvedRays(4, 1.0003)])
def test_projections_without_double_precision(measurement, ball, apple, model):
    grid = Grid.of_resolution(measurement.box, 8)
    values, (rays, _, _) = ball.sample(grid), measurement.rays()
    with apple:
        field = VoxelField.through(values.to(APPLE), grid)
        projected = project(model, field, rays[:9].to(APPLE), APPLE)
    assert place(field.coefficients) == place(projected) == APPLE
    assert torch.equal(projected, project(model, VoxelField.through(values, grid), rays[:9]))


@pytest.mark.parametrize(
    ("symmetry", "device"),
    [("axis", "cpu"), *(pytest.param("none", str(device), marks=pytest.mark.slow) for device in (GPU, APPLE))],
)
def test_a_rig_and_detail_beside_voxels_mix_no_devices(measurement, request, monkeypatch, symmetry, device):
    """The operators of a symmetric flow run on the CPU, and all that is combined with them."""
    gpu = request.getfixturevalue("apple" if device == str(APPLE) else "gpu")
    monkeypatch.setattr("nerif.reconstruction.voxels.descent.ROUNDS", 1)
    settings = Tikhonov(
        voxels=8, iterations=1, regularisation=1e-3, symmetry=symmetry, axis_sigma_mm=0.0, axis_sigma_deg=0.0,
        refine=("cameras",), coarse_to_fine=False, device=str(gpu.gpu),
    )  # fmt: skip
    one, withheld = (measurement.select([name]) for name in measurement.names[:2])
    with gpu:
        result = settings(one)
        detail = Detail(result.field, one, replace(settings, model="curved"), result.axis, 1, 8)
        posterior = detail.solve(detail.first(blurred=True), iterations=1)
        error = detail.prediction_error(detail.others(withheld), posterior.coefficients)
    assert result.device == device
    assert error > 0


@pytest.mark.slow
@pytest.mark.parametrize("exact", [0.0, torch.inf])
def test_views_predicted_without_double_precision(measurement, apple, monkeypatch, exact):
    """By splines through the network, and exactly."""
    monkeypatch.setattr("nerif.analysis.prediction.EXACT_WORK", {"cpu": 0.0, "gpu": exact})
    field = replace(RUNS["fast"], device="cpu", max_steps=1)(measurement).field
    with apple:
        (projected,) = reproject(field, measurement, device=str(APPLE)).maps.values()
    assert float(projected.nan_to_num().abs().max()) > 0
    assert apple.computed


@pytest.mark.slow
@pytest.mark.parametrize("device", [GPU, APPLE])
def test_a_run_from_images(measurement, request, device):
    gpu = request.getfixturevalue("apple" if device == APPLE else "gpu")
    draw = torch.Generator().manual_seed(0)
    reference = 100 + 30 * torch.randn(measurement.shape, generator=draw)
    flow = 1.1 * reference + torch.randn(measurement.shape, generator=draw)
    images = replace(measurement, maps={"reference": reference, "flow": flow}, displacement=None, sigma=None)
    with gpu:
        assert not replace(RUNS["fast"], device=str(device))(images).outcome.failed
    assert not gpu.rounded


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fast", "paper"])
def test_a_step_waits_for_nothing(measurement, gpu, name):
    counts = []
    with gpu:
        for steps in (3, 7):
            gpu.waits.clear()
            replace(RUNS[name], max_steps=steps)(measurement)
            counts.append(len(gpu.waits))
    assert counts[1] <= counts[0]
