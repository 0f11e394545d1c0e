"""Every projector: an exact adjoint, compiled as plain kernels, the path integral of its field, and a turned rig.

One matrix of technique, geometry and basis. The gradient of a linear map is its adjoint.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import torch

from nerif.fields.phantoms import GaussianBalls
from nerif.forward.forward_model import ForwardModel, midpoints
from nerif.forward.images import Images
from nerif.forward.path_integral import PathIntegral
from nerif.forward.registry import TECHNIQUES
from nerif.geometry import BackgroundPoints, Box, Grid, Lens, Rays
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.voxels.layout import InSpace, Layout, Symmetric
from nerif.reconstruction.voxels.operator import VoxelOperator, rays_through
from techniques import BOX, RING, Cubic, Knife

DRAW = torch.Generator().manual_seed(0)
PATTERNS = {name: 100 * torch.rand(5, 18, 23, generator=DRAW) for name in ("reference", "flow")}
LIGHT = SimpleNamespace(n_ambient=1.00027, wavelength_nm=532.0, cameras=RING.cameras(), maps=PATTERNS)
KINDS = {**{name: kind for name, kind in TECHNIQUES.items() if not kind.derived}, "knife": Knife, "cubic": Cubic}
MODELS = {name: kind.of(LIGHT, {"deflection": "lever_arm", "absorption": "absorbance"}.get(name, "auto"))
          for name, kind in KINDS.items()}  # fmt: skip
MODELS["images"] = Images.of(LIGHT, "lever_arm").linear_twin
LENSES = {"thin": None, "lens": Lens(12.5), "window": Lens(window=4.0)}
SYMMETRIES = ("axis", "planar", "axis+2")
BALLS = GaussianBalls(torch.tensor([[-3.0, 0.0, 1.0], [3.0, 4.0, -1.0]]), torch.tensor([3.0, 2.6]), torch.ones(2))

MATRIX = [(name, geometry, "cubic") for name in MODELS for geometry in ("thin", "lens", "axis")]
MATRIX += [("deflection", geometry, basis) for geometry in (*LENSES, *SYMMETRIES) for basis in ("linear", "cubic")]
MATRIX += [(name, "thin", "linear") for name in ("absorption", "knife")]
MATRIX = sorted(set(MATRIX))
# each is compiled for several seconds: of techniques of others, and of the linear basis, the simplest are enough
QUICK = [m for m in MATRIX if m[2] == "cubic" and m[0] not in ("knife", "cubic")]
QUICK += [("knife", "thin", "cubic"), ("cubic", "thin", "cubic"), ("deflection", "thin", "linear")]
COMPILED = [m if m in QUICK else pytest.param(*m, marks=pytest.mark.slow) for m in MATRIX]
EVERY = pytest.mark.parametrize(("name", "geometry", "basis"), COMPILED)
IN_SPACE = pytest.mark.parametrize(
    ("name", "geometry", "basis"), [c for c, m in zip(COMPILED, MATRIX, strict=True) if m[1] in LENSES]
)


@cache
def rays_of(geometry: str) -> Rays:
    """Rays of all views, with the ends of those without a background as well."""
    cameras = tuple(replace(camera, lens=LENSES.get(geometry)) for camera in RING.cameras())
    each = [c.rays(c.pixel_grid().reshape(-1, 2), view=i) for i, c in enumerate(cameras)]
    rays = Rays.concatenate(each).clip(BOX)
    return rays[rays.crosses][::13].to(dtype=torch.float64)


def operator(
    model: ForwardModel, geometry: str, basis: str, step: float | None = None
) -> tuple[VoxelOperator, Layout, Grid]:
    common = {"box": BOX, "faces": ("x-", "z+"), "basis": basis, "step": step, "dtype": torch.float64}
    if geometry in SYMMETRIES:
        direction = (0.1, 1.0, 0.03) if geometry == "planar" else (0.1, 0.05, 1.0)
        layout: Layout = Symmetric(symmetry=Symmetry.about(geometry, (1.0, 2.0, 0.0), direction, 0.2), **common)
        grid = layout.grid(14)
    else:
        layout, grid = InSpace(**common), Grid(BOX, (11, 9, 13))
    return layout.operator(rays_of(geometry), grid, model), layout, grid


def random(shape, seed: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@EVERY
def test_the_adjoint_is_exact(name, geometry, basis):
    """<A c, y> = <c, A^T y>, relative to the lengths of both; and the matrix of a symmetric operator."""
    a, _, _ = operator(MODELS[name], geometry, basis)
    c, y = random(a.domain_shape, 0), random(a.range_shape, 1)
    forward = a(c)
    assert float(forward.norm()) > 0
    assert abs(float((forward * y).sum() - (c * a.T(y)).sum())) <= 1e-11 * float(forward.norm() * y.norm())
    if geometry in SYMMETRIES:
        atol = 1e-11 * float(forward.abs().max())
        torch.testing.assert_close(a.matrix() @ c.flatten(), forward, rtol=0, atol=atol)


@IN_SPACE
def test_compiled_and_plain_kernels_are_equal(name, geometry, basis):
    a, _, _ = operator(MODELS[name], geometry, basis)
    c, y = random(a.domain_shape, 0), random(a.range_shape, 1)
    compiled = a(c), a.T(y)
    a.compiled = False
    for plain, fast in zip((a(c), a.T(y)), compiled, strict=True):
        assert torch.allclose(plain, fast, rtol=1e-12, atol=1e-12 * float(fast.abs().max()))


@EVERY
def test_the_operator_is_the_path_integral_of_its_field(name, geometry, basis):
    """Through a lens both have the same rays."""
    a, layout, grid = operator(MODELS[name], geometry, basis, 0.05)
    c, rays = layout.sample(BALLS, grid).double(), rays_of(geometry)
    each = rays_through(rays, min(grid.spacing))
    assert (each > 1) == (geometry in ("lens", "window"))
    spread = rays.spread(each) if each > 1 else rays
    s, step = midpoints(spread, 400)
    exact = PathIntegral(MODELS[name]).along(layout.field(c, grid), spread, s, step)
    exact = spread.mean_of(each, exact) if each > 1 else exact
    assert float((a(c) - exact).norm() / exact.norm()) < 0.01


@pytest.mark.parametrize("name", [name for name in MODELS if name != "images"])
def test_turning_rig_and_flow_by_a_right_angle_changes_nothing(name):
    rays, (ax, ay, az), (bx, by, bz) = rays_of("thin"), BOX.lower, BOX.upper
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)  # x to y, y to -x
    ends = BackgroundPoints(rays.ends.sensitivity @ turn.T, rays.ends.distance)
    turned = replace(rays, origin=rays.origin @ turn.T, direction=rays.direction @ turn.T, background=ends)
    a = VoxelOperator(rays, Grid(BOX, (6, 8, 10)), MODELS[name], dtype=torch.float64)
    around = Grid(Box((-by, ax, az), (-ay, bx, bz)), (6, 10, 8))
    b = VoxelOperator(turned, around, MODELS[name], dtype=torch.float64)
    c = random((6, 8, 10), 0)
    assert torch.allclose(b(c.permute(0, 2, 1).flip(2)), a(c), rtol=1e-9, atol=1e-9 * float(a(c).abs().max()))
