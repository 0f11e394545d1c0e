"""What is loaded, and when: the core is light, arguments are checked without PyTorch. Rooms, circles: make rooms."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from nerif.cli.cli import main

HEAVY = str.split("xarray matplotlib vtkmodules skimage rich safetensors scipy numba psutil cv2 tifffile imageio zarr")
HEAVY += ["dask", "distributed"]
STAGES = {
    "help": "main(['--help'])",
    "missing input": "for c in INPUTS: assert main([c, 'absent', '-o', 'x']) == 2",
    "settings": "for c in COMMANDS: assert (main([c, '--help']), main([c, '--of-no-command', '1'])) == (0, 2)",
    "methods": "for m in METHODS: main(['reconstruct', '-o', 'x', '.', '--method', m, '--voxels', 'many'])",
    # scipy and sympy come in through torch itself, if at all: what torch loads is not ours to hold
    "torch": "import torch, jaxtyping",
    "core": """
import nerif.geometry, nerif.fields.phantoms, nerif.fields.network, nerif.fields.voxel_field, nerif.simulation.simulate
import nerif.physics.gas_optics, nerif.forward.ray_tracing, nerif.reconstruction.neural.presets
import nerif.reconstruction.voxels.operator, nerif.reconstruction.voxels.total_variation
from nerif.fields.network import Network
from nerif.fields.network_shape import NetworkShape as Shape
from nerif.reconstruction.neural.optimiser import NetworkOptimiser as Optimiser
Optimiser('muon', Network(Shape(depth=2, width=8)), (0.9, 0.99), 0.9).zero_grad()
""",
}
"""Statements that one interpreter runs in turn."""
RUN = """
import contextlib, io, json, sys
from nerif.cli.arguments import INPUTS
from nerif.cli.cli import COMMANDS, main
loaded = {}
for stage, code in json.loads(sys.argv[1]).items():
    before = set(sys.modules)
    if stage == 'methods':
        from nerif.reconstruction.methods import METHODS
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        exec(code)
    loaded[stage] = [m for m in {*sys.modules} - before if '.' not in m or m == 'torch._dynamo']
print(json.dumps(loaded))
"""


@pytest.fixture(scope="module")
def loaded() -> dict[str, set[str]]:
    """The modules that each stage loads: those at the top, and PyTorch's compiler."""
    done = subprocess.run([sys.executable, "-c", RUN, json.dumps(STAGES)], capture_output=True, text=True, check=True)
    return {stage: set(modules) for stage, modules in json.loads(done.stdout).items()}


@pytest.mark.parametrize("stage", ["help", "missing input"])
def test_help_and_a_missing_input_load_little(loaded, stage):
    assert not loaded[stage] & {"torch", "numpy", "pydantic", *HEAVY}


@pytest.mark.parametrize("stage", ["settings", "methods"])
def test_settings_of_all_commands_are_checked_without_torch(loaded, stage):
    assert loaded[stage] & {"torch", *HEAVY} == set()


def test_core_imports_torch_and_numpy_only(loaded):
    assert "torch" in loaded["torch"]
    assert not loaded["core"] & {*HEAVY, "torch._dynamo"}


def test_help_needs_no_input():
    assert main(["figures", "absent", "--help"]) == 0
