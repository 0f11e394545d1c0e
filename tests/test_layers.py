"""The architecture, kept by force: imports run downward, the core stays light, nerif --help loads nothing."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "nerif"

LAYERS = (
    ("atomic", "conventions", "finding", "installing", "interruption", "json_file", "netcdf", "own_files",
     "pauses", "toml", "transfer"),
    ("geometry",),
    ("techniques",),
    ("drawing",),
    ("notebook",),
    ("observation", "measurement_file", "measurement_summary", "measurement", "measurement_sequence"),
    ("meridian", "volume", "volume_file", "volume_sequence", "vti", "exports", "reprojection"),
    ("imaging",),
    ("fields",),
    ("physics",),
    ("alignment", "metrics", "residuals", "resampling", "resolution", "simulation", "rendering"),
    ("experiment", "particles"),
    ("reconstruction",),
    ("result", "glance", "monitor"),
    (
        "prediction", "halves", "evaluation", "consistency", "corrected", "rig_check", "mistakes", "quick_views",
        "symptoms", "unrelated", "gains", "verdict",
    ),
    ("kept_run", "members", "first_look", "live"),
    ("report", "sequence"),
    ("workflow",),
    ("commands",),
    ("app",),
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


def module(path: Path) -> str:
    """Name of a file as it is imported."""
    return ".".join(["nerif", *path.relative_to(SOURCE).with_suffix("").parts]).removesuffix(".__init__")


def modules_imported(path: Path, known: set[str]) -> set[str]:
    """Modules out of `known` that a file imports when it runs, anywhere in it: not those for the type checker alone."""
    tree = ast.parse(path.read_text())
    for_types = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    names: set[str] = set()
    for node in ast.walk(tree):
        if node in for_types:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= (inner & known) | ({node.module or ""} if inner - known else set())
    return names & known - {module(path)}


def circles(imported: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module (Tarjan, SIAM J. Comput. 1 (1972))."""
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    waiting: list[str] = []
    found = []

    def visit(name: str) -> None:
        order[name] = lowest[name] = len(order)
        waiting.append(name)
        for other in sorted(imported[name]):
            if other not in order:
                visit(other)
                lowest[name] = min(lowest[name], lowest[other])
            elif other in waiting:
                lowest[name] = min(lowest[name], order[other])
        if lowest[name] == order[name]:
            component = waiting[waiting.index(name) :]
            del waiting[waiting.index(name) :]
            if len(component) > 1:
                found.append(sorted(component))

    for name in sorted(imported):
        if name not in order:
            visit(name)
    return found


def test_no_modules_import_one_another_in_a_circle():
    known = {module(p) for p in SOURCE.rglob("*.py")}
    assert not circles({module(p): modules_imported(p, known) for p in SOURCE.rglob("*.py")})


def test_the_search_for_circles_can_fail(tmp_path):
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [["b", "c"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    here = SOURCE / "x.py"  # never written
    source = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from nerif.a import A\n"
    source += "def f():\n    from nerif import b\n"

    class File:
        read_text = staticmethod(lambda: source)
        relative_to = staticmethod(here.relative_to)

    assert modules_imported(File, {"nerif.a", "nerif.b"}) == {"nerif.b"}


def test_the_check_can_fail(tmp_path):
    bad = tmp_path / "x.py"
    bad.write_text("def f():\n    from nerif.report.figures import draw_slice\n")
    assert imports(bad) == {"report"}


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


def loaded_by(statement: str, after: str = "") -> set[str]:
    """Modules that a statement loads which another has not: those at the top, and PyTorch's compiler."""
    code = f"import sys\n{after}\nbefore = set(sys.modules)\n{statement}\n"
    code += "print(*sorted(m for m in set(sys.modules) - before if '.' not in m or m == 'torch._dynamo'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_core_imports_torch_and_numpy_only():
    core = "import nerif.geometry, nerif.fields.phantoms, nerif.fields.network, nerif.fields.grid, nerif.simulation.simulate\n"
    core += "import nerif.physics.gas_optics, nerif.forward.ray_tracing, nerif.reconstruction.neural.presets\n"
    core += "import nerif.reconstruction.voxels.operator, nerif.reconstruction.voxels.total_variation\n"
    core += "from nerif.fields.network import Network, NetworkShape as Shape\n"
    core += "from nerif.reconstruction.neural.optimiser import NetworkOptimiser as Optimiser\n"
    core += "Optimiser('muon', Network(Shape(depth=2, width=8)), (0.9, 0.99), 0.9).zero_grad()"
    # scipy and sympy come in through torch itself, if at all: what torch loads is not ours to hold
    assert not loaded_by(core, after="import torch, jaxtyping") & {*HEAVY, "torch._dynamo"}


def test_help_loads_neither_torch_nor_numpy():
    assert not loaded_by("from nerif.cli.cli import main; main(['--help'])") & {"torch", "numpy", *HEAVY}
