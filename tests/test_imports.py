"""What an import loads: the core stays light, and nerif --help loads nothing. Rooms and circles: make rooms."""

from __future__ import annotations

import subprocess
import sys

from nerif.cli.arguments import INPUTS
from nerif.cli.cli import main

HEAVY = (
    "xarray",
    "matplotlib",
    "vtkmodules",
    "skimage",
    "pydantic",
    "tyro",
    "rich",
    "safetensors",
    "scipy",
    "numba",
    "psutil",
    "cv2",
    "tifffile",
    "imageio",
    "zarr",
    "dask",
    "distributed",
)


def loaded_by(statement: str, after: str = "") -> set[str]:
    """Modules that a statement loads which another has not: those at the top, and PyTorch's compiler."""
    code = f"import sys\n{after}\nbefore = set(sys.modules)\n{statement}\n"
    code += "print(*sorted(m for m in set(sys.modules) - before if '.' not in m or m == 'torch._dynamo'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_core_imports_torch_and_numpy_only():
    core = "import nerif.geometry, nerif.fields.phantoms, nerif.fields.network, nerif.fields.voxel_field\n"
    core += "import nerif.simulation.simulate\n"
    core += "import nerif.physics.gas_optics, nerif.forward.ray_tracing, nerif.reconstruction.neural.presets\n"
    core += "import nerif.reconstruction.voxels.operator, nerif.reconstruction.voxels.total_variation\n"
    core += "from nerif.fields.network import Network, NetworkShape as Shape\n"
    core += "from nerif.reconstruction.neural.optimiser import NetworkOptimiser as Optimiser\n"
    core += "Optimiser('muon', Network(Shape(depth=2, width=8)), (0.9, 0.99), 0.9).zero_grad()"
    # scipy and sympy come in through torch itself, if at all: what torch loads is not ours to hold
    assert not loaded_by(core, after="import torch, jaxtyping") & {*HEAVY, "torch._dynamo"}


def test_help_loads_neither_torch_nor_numpy():
    assert not loaded_by("from nerif.cli.cli import main; main(['--help'])") & {"torch", "numpy", *HEAVY}


def test_a_missing_input_is_refused_before_anything_heavy_is_loaded():
    for command in INPUTS:
        refused = f"from nerif.cli.cli import main; assert main(['{command}', 'absent', '-o', 'x']) == 2; print()"
        assert not loaded_by(refused) & {"torch", "numpy", *HEAVY}


def test_help_needs_no_input():
    assert main(["figures", "absent", "--help"]) == 0
