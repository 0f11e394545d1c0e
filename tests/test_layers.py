"""The architecture, kept by force: imports run downward, the core stays light, nerif --help loads nothing."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "nerif"

LAYERS = (
    ("atomic", "conventions", "netcdf"),
    ("geometry",),
    ("measurement_file", "measurement", "measurement_sequence"),
    ("volume", "volume_sequence", "vti", "exports", "reprojection"),
    ("imaging",),
    ("fields",),
    ("physics",),
    ("metrics", "resolution", "simulation", "rendering"),
    ("experiment",),
    ("reconstruction",),
    ("result", "monitor"),
    ("prediction", "evaluation", "consistency", "mistakes"),
    ("members",),
    ("report", "sequence"),
    ("workflow",),
    ("commands",),
    ("cli", "__main__"),
)
"""Bottom first; a module may import from its own layer and from those below (docs/architecture.md)."""

HEIGHT = {name: height for height, layer in enumerate(LAYERS) for name in layer}


def imports(path: Path) -> set[str]:
    """Top-level parts of nerif that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = [node.module or ""]
            if node.module in ("nerif", "nerif.commands"):
                names += [f"{node.module}.{alias.name}" for alias in node.names]
        found |= {name.split(".")[1] for name in names if name.startswith("nerif.")}
    return found


FILES = sorted(p for p in SOURCE.rglob("*.py") if p != SOURCE / "__init__.py")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SOURCE)))
def test_imports_run_downward(path):
    part = path.relative_to(SOURCE).parts[0].removesuffix(".py")
    assert part in HEIGHT, f"{part} has no layer; give it one here and in docs/architecture.md"
    upward = {name for name in imports(path) if name in HEIGHT and HEIGHT[name] > HEIGHT[part]}
    unknown = {name for name in imports(path) if name not in HEIGHT and name != "__version__"}
    assert not upward
    assert not unknown


def test_the_check_can_fail(tmp_path):
    bad = tmp_path / "x.py"
    bad.write_text("def f():\n    from nerif.report.figures import draw_slice\n")
    assert imports(bad) == {"report"}


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SOURCE)))
def test_files_stay_small(path):
    assert len(path.read_text().splitlines()) <= 450


def test_fields_and_imaging_know_nothing_of_each_other():
    for path in FILES:
        part = path.relative_to(SOURCE).parts[0]
        if part in ("imaging", "fields", "physics"):
            assert not imports(path) & ({"imaging"} if part != "imaging" else {"fields", "physics"}), path


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


def loaded_by(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(*sorted(m for m in sys.modules if '.' not in m))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_core_imports_torch_and_numpy_only():
    core = "import nerif.geometry, nerif.fields.phantoms, nerif.fields.mlp, nerif.fields.grid, nerif.simulation\n"
    core += "import nerif.physics.gas_optics, nerif.physics.ray_tracing, nerif.reconstruction.presets\n"
    core += "import nerif.reconstruction.operator, nerif.reconstruction.total_variation"
    # scipy and sympy come in through torch itself, if at all: what torch loads is not ours to hold
    ours = loaded_by(core) - loaded_by("import torch, jaxtyping")
    assert not ours & set(HEAVY)


def test_help_loads_neither_torch_nor_numpy():
    assert not loaded_by("from nerif.cli import main; main(['--help'])") & {"torch", "numpy", *HEAVY}
