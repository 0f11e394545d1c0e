"""The voxel operator: an exact adjoint, the same as the readable road through a Field, and physically right."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from nerif.fields.grid import Boundary
from nerif.forward.deflection import MODELS
from nerif.geometry import BackgroundPoints, Box, Camera, Grid, Plane, Rays, Ring
from nerif.reconstruction.voxels.operator import VoxelOperator, operator_norm
from refusals import refused

GRID = (9, 11, 13)
FACES = Boundary(("x-", "y+", "z-"))


def general_camera(rotation_about, axis, angle, background: float = 420.0) -> Camera:
    """A camera 700 mm off that looks at the origin from anywhere, rolled about its axis."""
    rotation = rotation_about(axis, angle)
    outward = -rotation[2]
    intrinsics = torch.tensor([[500.0, 0, 10.2], [0, 480.0, 8.1], [0, 0, 1]], dtype=torch.float64)
    tilted = rotation_about((0.3, -0.8, 0.1), 0.15) @ outward
    return Camera(
        intrinsics=intrinsics, rotation=rotation, translation=-rotation @ (700 * outward), image_size=(17, 21),
        background=Plane(tilted, -background), distortion=torch.zeros(5, dtype=torch.float64), name=f"{angle:g}",
    )  # fmt: skip


@pytest.fixture(scope="module")
def rays(rotation_about, box) -> Rays:
    cameras = [
        general_camera(rotation_about, axis, angle)
        for axis, angle in (((1, 0.2, 0.3), 0.7), ((0.1, 1, -0.4), 2.1), ((0.5, -0.3, 1), 4.0), ((1, 0.4, -0.2), 5.5))
    ]
    every = Rays.concatenate([c.rays(c.pixel_grid().reshape(-1, 2)) for c in cameras]).clip(box)
    return every[every.crosses]


LEVER = MODELS["lever_arm"]()


def operator(rays: Rays, box: Box, **settings) -> VoxelOperator:
    # a little larger than the box, lest rays from face to face have samples just where a linear gradient jumps
    x, y, z = box.upper
    larger = Box((-x - 0.31, -y - 0.73, -z - 0.22), (x + 0.47, y + 0.11, z + 0.93))
    model = MODELS[settings.pop("model", "lever_arm")]()
    return VoxelOperator(rays, Grid(larger, GRID), model, **{"boundary": FACES, **settings})


def random(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).to(dtype)


@pytest.mark.parametrize(("dtype", "limit"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("basis", ["linear", "cubic"])
@pytest.mark.parametrize("model", ["lever_arm", "paraxial"])
def test_adjoint_is_exact(rays, box, dtype, limit, basis, model):
    """<A c, d> = <c, A^T d>, relative to the lengths of both."""
    a = operator(rays, box, dtype=dtype, basis=basis, model=model)
    c, d = random(*a.domain_shape, dtype=dtype), random(*a.range_shape, dtype=dtype, seed=1)
    forward, adjoint = a(c), a.T(d)
    there = float((forward.double() * d.double()).sum())
    back = float((c.double() * adjoint.double()).sum())
    assert abs(there - back) <= limit * float(forward.double().norm() * d.double().norm())
    assert float(forward.norm()) > 0


def plane_by_plane(field, ray: Rays, model) -> torch.Tensor:
    """One ray through a field: a sample on each of two planes a voxel across the axis it runs along most.

    NaN where one lies beyond the grid, where a spline of a grid and a field of a box go on in different ways.
    """
    grid = field.grid
    slow = [abs(float(d)) / h for d, h in zip(ray.direction[0], grid.spacing, strict=True)]
    axis = slow.index(max(slow))
    apart = grid.spacing[axis] / 2 / abs(float(ray.direction[0, axis]))
    heights = grid.box.lower[axis] + grid.spacing[axis] / 2 * (torch.arange(2 * grid.shape[2 - axis]) + 0.5).double()
    s = (heights - ray.origin[0, axis]) / ray.direction[0, axis]
    begin, end = torch.maximum(s - apart / 2, ray.near), torch.minimum(s + apart / 2, ray.far)
    s, share = s[end > begin][None], ((end - begin) / apart)[end > begin]
    weights = model.weights(ray, s, torch.full_like(s, apart))
    points = ray.origin + s[0, :, None] * ray.direction
    lower, upper = (points.new_tensor(corner) for corner in (grid.box.lower, grid.box.upper))
    if not bool(((points >= lower) & (points <= upper)).all()):
        return torch.full((1, 2), math.nan, dtype=torch.float64)
    gradient = field.value_and_gradient(points)[1]
    return torch.einsum("nij,m,mj->ni", weights.slope, weights.profile[0] * share, gradient)


@pytest.mark.parametrize("basis", ["linear", "cubic"])
@pytest.mark.parametrize("model", ["lever_arm", "paraxial"])
def test_agrees_with_the_readable_twin(rays, box, basis, model):
    """The forward model through the Field, ray by ray, and its gradient by autograd."""
    some = rays[torch.arange(0, len(rays), 25)].to(dtype=torch.float64)
    a = operator(some, box, dtype=torch.float64, basis=basis, model=model, step=0.5)
    small = 1e-9  # next to which the n of 1 / n is one
    c = (small * random(*a.domain_shape)).requires_grad_(True)
    d = torch.cat([plane_by_plane(a.field(c), some[i : i + 1], MODELS[model]()) for i in range(len(some))])
    within = ~d[:, 0].isnan()
    assert float(within.double().mean()) > 0.9
    d = torch.where(within[:, None], d, torch.zeros_like(d))
    d_fast, d_twin = a(c.detach()) * within[:, None], d.detach()
    assert torch.allclose(d_fast, d_twin, rtol=1e-6, atol=1e-8 * float(d_twin.abs().max()))
    weights = random(*a.range_shape, seed=2) * within[:, None]
    (gradient,) = torch.autograd.grad((weights * d).sum(), c)
    assert float((a.T(weights) - gradient).norm() / gradient.norm()) < 1e-6


@pytest.mark.parametrize("basis", ["linear", "cubic"])
def test_compiled_and_plain_kernels_agree(rays, box, basis):
    a = operator(rays, box, dtype=torch.float64, basis=basis)
    c, d = random(*a.domain_shape), random(*a.range_shape, seed=1)
    compiled, adjoint = a(c), a.T(d)
    a.compiled = False
    assert torch.allclose(a(c), compiled, rtol=1e-12, atol=1e-12 * float(compiled.abs().max()))
    assert torch.allclose(a.T(d), adjoint, rtol=1e-12, atol=1e-12 * float(adjoint.abs().max()))


def test_sum_does_not_depend_on_the_number_of_threads(rays, box):
    a = operator(rays, box)
    d, results = random(*a.range_shape, dtype=torch.float32), []
    before = torch.get_num_threads()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        results.append(a.T(d))
    torch.set_num_threads(before)
    assert torch.equal(*results)


def test_norm_is_the_largest_singular_value(rays, box):
    a = VoxelOperator(rays[::7], Grid(box, (3, 4, 5)), LEVER, dtype=torch.float64, boundary=FACES)
    columns = []
    for i in range(60):
        unit = torch.zeros(60, dtype=torch.float64)
        unit[i] = 1
        columns.append(a(unit.reshape(3, 4, 5)).reshape(-1))
    largest = float(torch.linalg.matrix_norm(torch.stack(columns, dim=1), 2))
    assert 0.97 * largest < operator_norm(a, a.T, torch.rand(3, 4, 5, dtype=torch.float64), 100) <= largest * (1 + 1e-9)


@pytest.mark.parametrize("basis", ["linear", "cubic"])
def test_quadrature_converges(measurement, ball, basis):
    """Finer voxels come to what the cameras saw of a smooth field (curved rays, 2 % noise)."""
    rays, d, _ = measurement.rays()
    errors = []
    for n in (12, 24, 48):
        grid = Grid.of_resolution(measurement.box, n)
        a = VoxelOperator(rays, grid, MODELS["lever_arm"](measurement.n_ambient), basis)
        errors.append(float((a(ball.sample(grid)) - d).norm() / d.norm()))
    assert all(fine < coarse for coarse, fine in pairwise(errors))
    assert errors[-1] < 0.08


def test_turning_rig_and_flow_by_a_right_angle_changes_nothing(measurement, ball):
    rays, _, _ = measurement.rays()
    (ax, ay, az), (bx, by, bz) = measurement.box.lower, measurement.box.upper
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x to y, y to -x
    turned_box = Box((-by, ax, az), (-ay, bx, bz))
    ends = BackgroundPoints(rays.ends.sensitivity @ turn.T, rays.ends.distance)
    turned = replace(rays, origin=rays.origin @ turn.T, direction=rays.direction @ turn.T, background=ends)
    a = VoxelOperator(rays, Grid(measurement.box, (6, 8, 10)), LEVER, dtype=torch.float64)
    b = VoxelOperator(turned, Grid(turned_box, (6, 10, 8)), LEVER, dtype=torch.float64)
    c = random(6, 8, 10)
    assert torch.allclose(b(c.permute(0, 2, 1).flip(2)), a(c), rtol=1e-5, atol=1e-6 * float(a(c).abs().max()))


def test_a_constant_moves_nothing_and_a_slope_all_alike(rays, box):
    """Without ambient faces a constant is invisible; of n = x the linear basis has the exact gradient inside."""
    a = operator(rays, box, boundary=Boundary(), dtype=torch.float64)
    assert float(a(torch.ones(GRID, dtype=torch.float64)).abs().max()) < 1e-9
    grid = Grid(box, (4, 4, 4))
    inner = Box((-8.9, -7.4, -5.9), (8.9, 7.4, 5.9))  # within the outermost centres, where mirroring begins
    through = rays.clip(inner)
    a = VoxelOperator(through, grid, LEVER, boundary=Boundary(), dtype=torch.float64, step=0.05)
    x = grid.points(torch.float64)[..., 0]
    lever = through.ends.distance - 0.5 * (through.near + through.far)
    exact = through.ends.sensitivity[:, :, 0] * (lever * (through.far - through.near))[:, None]
    assert torch.allclose(a(x), exact.double(), rtol=1e-4, atol=1e-4 * float(exact.abs().max()))


@pytest.mark.usefixtures("unchecked")
def test_what_cannot_be_right(rays, box):
    missing = rays.clip(Box((900.0, 900.0, 900.0), (901.0, 901.0, 901.0)))
    with refused("rays"):
        operator(missing, box)
    with refused("model"):
        operator(rays, box, model="curved")
    with refused("basis"):
        operator(rays, box, basis="quintic")
    with refused("step"):
        operator(rays, box, step=0.0)
    with refused("step"):
        operator(rays, box, step=0.7)
    with refused("voxels"):
        VoxelOperator(rays, Grid(box, (1, 4, 5)), LEVER, "cubic")
    with refused("rays"):
        VoxelOperator(rays, Grid(Box((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0)), GRID), LEVER)
    a = operator(rays, box)
    with refused("coefficients"):
        a(torch.zeros(9, 11, 12))
    with refused("projections"):
        a.T(torch.zeros(3, 2))


@pytest.mark.parametrize("basis", ["linear", "cubic"])
def test_rays_that_miss_the_box_see_nothing(rays, box, basis):
    away = replace(rays, origin=rays.origin + 500).clip(box)
    both = Rays.concatenate([rays[:30], away[:10]])
    a = operator(both, box, basis=basis, dtype=torch.float64)
    c = random(*a.domain_shape)
    assert torch.equal(a(c)[30:], torch.zeros(10, 2, dtype=torch.float64))
    assert torch.allclose(a(c)[:30], operator(rays[:30], box, basis=basis, dtype=torch.float64)(c))


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU here")
@pytest.mark.parametrize("basis", ["linear", "cubic"])
def test_cuda_gives_what_the_cpu_gives(rays, box, basis):
    here, there = (operator(rays, box, basis=basis, dtype=torch.float64, device=d) for d in ("cpu", "cuda"))
    c, d = random(*here.domain_shape), random(*here.range_shape, seed=1)
    assert torch.allclose(there(c).cpu(), here(c), rtol=1e-10, atol=1e-10 * float(here(c).abs().max()))
    assert torch.allclose(there.T(d).cpu(), here.T(d), rtol=1e-10, atol=1e-10 * float(here.T(d).abs().max()))


def test_a_small_box_far_from_its_camera_is_within_the_precision_of_its_rays():
    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    camera = Ring(views=1, image_size=(9, 11), pixel_pitch=2e-3, distance=500.0, background_distance=300.0).cameras()[0]
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).to(dtype=torch.float32).clip(box)
    assert VoxelOperator(rays, Grid(box, (1024, 1024, 1024)), LEVER).samples > 0
