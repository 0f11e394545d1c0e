"""Shared problems; every size differs from every other, so that a swapped axis shows."""

from __future__ import annotations

# ruff: noqa: E402
import gc
import itertools
import math
import os
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

# tests run side by side, each in a thread; threads that wait must not take the cores of other tests
os.environ |= {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

import jaxtyping
import pytest
import torch
from jaxtyping import install_import_hook
from matplotlib.figure import Figure

ROOMS = "geometry", "fields", "data", "physics", "imaging", "simulation", "reconstruction", "flow", "analysis", "report"
# what Numba compiles stays as it is written; schedule holds no array, and is asked many times a step
UNCHECKED = ("mesh_kernel", "spline_kernel", "kernels_numba", "kernels_symmetric", "fused", "schedule")
SOURCE = Path(__file__).parents[1] / "src" / "nerif"
FILES = [p for room in ROOMS for p in (SOURCE / room).rglob("[!_]*.py") if p.stem not in UNCHECKED]
CHECKED = [".".join(p.relative_to(SOURCE).with_suffix("").parts) for p in FILES]
CHECKED += ["common.conventions", "forward.path_integral", "forward.ray_tracing", "workflow.sequence"]
ALL = bool(os.environ.get("NERIF_CHECK_SHAPES"))  # make test-all
if ALL:  # shapes in annotations, on every call; before nerif is imported
    install_import_hook([f"nerif.{part}" for part in CHECKED], "typecheck.check")

from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.fields.phantoms import GaussianBalls
from nerif.geometry import Box, Camera, Ring
from nerif.reconstruction.neural import schedule
from nerif.simulation.simulate import simulate

torch.set_num_threads(1)  # tests run side by side


GROUPS = {"whole": "report", "experiment": "images", "five": "films", "film": "films"}
"""Fixtures of more than one file, by the group of the tests that use them."""
LONGEST = ("images", "films", "report", "test_cluster", "test_consistency", "test_neural")
"""Groups to begin with, so that both processes end at about the same time."""


WHOLE = ("cli", "workflow", "sequence", "mutation", "benchmarks", "report", "app")
WHOLE += ("test_docs", "test_examples", "test_asymmetry", "test_convergence", "test_refined_rig", "test_residuals")
"""Files and folders of tests that run whole commands: what these call is checked call by call in the other tests."""
DRAWN = "report", "plotting", "app", "test_cli_images", "test_cli_simple", "test_patterns", "test_telecentric"
"""Folders and files of tests whose figures are rendered; of others only in slow tests and in make test-all."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Check shapes by annotation, but not where whole commands run: that takes a sixth of their time."""
    whole = item.path.stem in WHOLE or item.path.parent.name in WHOLE
    jaxtyping.config.update("jaxtyping_disable", whole)
    with pytest.MonkeyPatch.context() as patch:
        if not (ALL or item.get_closest_marker("slow") or {item.path.stem, item.path.parent.name} & {*DRAWN}):
            patch.setattr(Figure, "savefig", lambda self, file, **_: isinstance(file, BytesIO) or Path(file).touch())
        return (yield)


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the tests of a file, or of a costly fixture, in one process, where what takes long is made once."""
    group = {}
    for item in items:
        shared = [g for fixture, g in GROUPS.items() if fixture in getattr(item, "fixturenames", ())]
        group[item] = shared[0] if shared else item.path.stem
        item.add_marker(pytest.mark.xdist_group(group[item]))
    items.sort(key=lambda item: LONGEST.index(group[item]) if group[item] in LONGEST else len(LONGEST))


def pytest_collection_finish() -> None:
    """Modules and tests stay: no collection of garbage goes through them."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Shapes are not checked by annotation, as when users call: the error has to be ours."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


@pytest.fixture
def lines() -> list[str]:
    """Lines that are reported, by their `append`."""
    return []


@pytest.fixture(scope="session")
def box() -> Box:
    """A box of three different edges, mm."""
    return Box((-12.0, -10.0, -8.0), (12.0, 10.0, 8.0))


@pytest.fixture(scope="session")
def ball() -> Field:
    """Two Gaussian balls well inside the box."""
    return GaussianBalls(
        torch.tensor([[1.0, -0.5, 0.4], [-2.0, 1.5, -0.8]], dtype=torch.float64),
        torch.tensor([1.6, 1.3], dtype=torch.float64),
        torch.tensor([-2.0e-4, -1.2e-4], dtype=torch.float64),
    )


@pytest.fixture(scope="session")
def cameras() -> tuple[Camera, ...]:
    """Five small views, taller or wider than square, looking slightly down."""
    ring = Ring(
        views=5, arc=(0.0, 144.0), elevation=8.0, image_size=(22, 28), pixel_pitch=0.1,
        distance=700.0, background_distance=450.0,
    )  # fmt: skip
    return ring.cameras()


@pytest.fixture(scope="session")
def measurement(ball: Field, cameras: tuple[Camera, ...], box: Box) -> Measurement:
    """What those views see of the balls, with 2 % noise."""
    return simulate(ball, cameras, box, n_ambient=1.00027, noise=0.02, seed=5, steps=60)


@pytest.fixture
def slow_clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Let every reading of a training's clock be a number of seconds after the one before."""

    def set_to(seconds: float) -> None:
        ticks = itertools.count()
        monkeypatch.setattr(schedule, "time", SimpleNamespace(perf_counter=lambda: seconds * next(ticks)))

    return set_to


@pytest.fixture(scope="session")
def rotation_about() -> Callable[[tuple[float, float, float], float], torch.Tensor]:
    """Rotation matrices by Rodrigues' formula; angle in radians."""
    return _rotation_about


def _rotation_about(axis: tuple[float, float, float], angle: float) -> torch.Tensor:
    k = torch.tensor(axis, dtype=torch.float64)
    k = k / k.norm()
    cross = torch.tensor([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
