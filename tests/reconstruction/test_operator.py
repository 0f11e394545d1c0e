"""The voxel operator: an exact adjoint, equal to the path integral through a Field, and physically correct.

Compiled and plain kernels are compared for every technique in tests/forward/test_techniques.py.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from nerif.fields.voxel_field import Boundary
from nerif.forward.deflection import MODELS
from nerif.geometry import Box, Camera, Grid, Plane, Rays, Ring
from nerif.reconstruction.voxels.operator import VoxelOperator, operator_norm
from refusals import refused

GRID = (9, 11, 13)
FACES = Boundary(("x-", "y+", "z-"))
LEVER = MODELS["lever_arm"]()
BASES = pytest.mark.parametrize("basis", ["linear", "cubic"])


@pytest.fixture(scope="module")
def rays(rotation_about, box) -> Rays:
    """Rays of cameras 700 mm away that look at the origin from anywhere, rolled about their axes."""
    cameras = []
    intrinsics = torch.tensor([[500.0, 0, 10.2], [0, 480.0, 8.1], [0, 0, 1]], dtype=torch.float64)
    for axis, angle in (((1, 0.2, 0.3), 0.7), ((0.1, 1, -0.4), 2.1), ((0.5, -0.3, 1), 4.0), ((1, 0.4, -0.2), 5.5)):
        rotation = rotation_about(axis, angle)
        background = Plane(rotation_about((0.3, -0.8, 0.1), 0.15) @ -rotation[2], -420.0)
        pose = {"rotation": rotation, "translation": rotation @ (700 * rotation[2])}
        cameras.append(Camera(
            intrinsics=intrinsics, image_size=(17, 21), background=background, name=f"{angle:g}",
            distortion=torch.zeros(5, dtype=torch.float64), **pose,
        ))  # fmt: skip
    rays = Rays.concatenate([c.rays(c.pixel_grid().reshape(-1, 2)) for c in cameras]).clip(box)
    return rays[rays.crosses]


def operator(rays: Rays, box: Box, **settings) -> VoxelOperator:
    # slightly larger than the box, so that no sample of a ray from face to face lies where a linear gradient jumps
    x, y, z = box.upper
    larger = Box((-x - 0.31, -y - 0.73, -z - 0.22), (x + 0.47, y + 0.11, z + 0.93))
    model = MODELS[settings.pop("model", "lever_arm")]()
    return VoxelOperator(rays, Grid(larger, GRID), model, **{"boundary": FACES, "dtype": torch.float64, **settings})


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@BASES
def test_adjoint_is_exact_in_single_precision_for_any_number_of_threads(rays, box, basis):
    """<A c, d> = <c, A^T d>, relative to the lengths of both."""
    a = operator(rays, box, dtype=torch.float32, basis=basis)
    c, d = random(*a.domain_shape).float(), random(*a.range_shape, seed=1).float()
    forward, adjoint = a(c).double(), a.T(d)
    difference = float((forward * d).sum() - (c.double() * adjoint).sum())
    assert abs(difference) <= 1e-5 * float(forward.norm() * d.norm())
    assert float(forward.norm()) > 0
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    assert torch.equal(a.T(d), adjoint)
    torch.set_num_threads(before)


def plane_by_plane(field, ray: Rays, model) -> torch.Tensor:
    """One ray through a field: a sample on each of two planes a voxel across the axis it follows most closely.

    NaN if one lies beyond the grid, where a spline of a grid and a field of a box are extended differently.
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
    if not bool(((points >= torch.tensor(grid.box.lower)) & (points <= torch.tensor(grid.box.upper))).all()):
        return torch.full((1, 2), math.nan, dtype=torch.float64)
    gradient = field.value_and_gradient(points)[1]
    return torch.einsum("nij,m,mj->ni", weights.slope, weights.profile[0] * share, gradient)


@BASES
@pytest.mark.parametrize("model", ["lever_arm", "paraxial"])
def test_agrees_with_the_readable_twin(rays, box, basis, model):
    """The forward model through the Field, ray by ray, and its gradient by autograd."""
    some = rays[torch.arange(0, len(rays), 25)].to(dtype=torch.float64)
    a = operator(some, box, basis=basis, model=model, step=0.5)
    c = (1e-9 * random(*a.domain_shape)).requires_grad_(True)  # so small that n is 1 in 1 / n
    d = torch.cat([plane_by_plane(a.field(c), some[i : i + 1], MODELS[model]()) for i in range(len(some))])
    within = ~d[:, :1].isnan()
    assert float(within.double().mean()) > 0.9
    d = torch.where(within, d, torch.zeros_like(d))
    assert torch.allclose(a(c.detach()) * within, d.detach(), rtol=1e-6, atol=1e-8 * float(d.detach().abs().max()))
    weights = random(*a.range_shape, seed=2) * within
    (gradient,) = torch.autograd.grad((weights * d).sum(), c)
    assert float((a.T(weights) - gradient).norm() / gradient.norm()) < 1e-6


def test_norm_is_the_largest_singular_value(rays, box):
    a = VoxelOperator(rays[::7], Grid(box, (3, 4, 5)), LEVER, dtype=torch.float64, boundary=FACES)
    matrix = torch.stack([a(unit.reshape(3, 4, 5)).flatten() for unit in torch.eye(60, dtype=torch.float64)])
    largest = float(torch.linalg.matrix_norm(matrix, 2))
    norm = operator_norm(a, a.T, torch.rand(3, 4, 5, generator=torch.Generator().manual_seed(0)).double(), 100)
    assert 0.97 * largest < norm <= largest * (1 + 1e-9)


@BASES
def test_quadrature_converges(measurement, ball, basis):
    """Finer voxels converge to the simulated displacement of a smooth field (curved rays, 2 % noise)."""
    rays, d, _ = measurement.rays()
    errors = []
    for n in (12, 24, 48):
        grid = Grid.of_resolution(measurement.box, n)
        a = VoxelOperator(rays, grid, MODELS["lever_arm"](measurement.n_ambient), basis)
        errors.append(float((a(ball.sample(grid)) - d).norm() / d.norm()))
    assert all(fine < coarse for coarse, fine in pairwise(errors))
    assert errors[-1] < 0.08


def test_a_constant_is_invisible_and_a_slope_exact(rays, box):
    """Without ambient faces; for n = x the linear basis has the exact gradient inside."""
    a = operator(rays, box, boundary=Boundary())
    assert float(a(torch.ones(GRID, dtype=torch.float64)).abs().max()) < 1e-9
    grid = Grid(box, (4, 4, 4))
    through = rays.clip(Box((-8.9, -7.4, -5.9), (8.9, 7.4, 5.9)))  # within the outermost centres, without mirroring
    a = VoxelOperator(through, grid, LEVER, boundary=Boundary(), dtype=torch.float64, step=0.05)
    lever = through.ends.distance - 0.5 * (through.near + through.far)
    exact = through.ends.sensitivity[:, :, 0] * (lever * (through.far - through.near))[:, None]
    x = grid.points(torch.float64)[..., 0]
    assert torch.allclose(a(x), exact.double(), rtol=1e-4, atol=1e-4 * float(exact.abs().max()))


@pytest.mark.usefixtures("unchecked")
def test_invalid_input(rays, box):
    outside = rays.clip(Box((900.0, 900.0, 900.0), (901.0, 901.0, 901.0)))
    wrong = {"model": {"model": "curved"}, "basis": {"basis": "quintic"}, "step": {"step": 0.0}}
    for field, settings in (*wrong.items(), ("step", {"step": 0.7})):
        with refused(field):
            operator(rays, box, **settings)
    with refused("rays"):
        operator(outside, box)
    with refused("voxels"):
        VoxelOperator(rays, Grid(box, (1, 4, 5)), LEVER, "cubic")
    with refused("rays"):
        VoxelOperator(rays, Grid(Box((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0)), GRID), LEVER)
    a = operator(rays, box)
    with refused("coefficients"):
        a(torch.zeros(9, 11, 12))
    with refused("projections"):
        a.T(torch.zeros(3, 2))


@BASES
def test_rays_that_miss_the_box_project_to_zero(rays, box, basis):
    away = replace(rays, origin=rays.origin + 500).clip(box)
    a = operator(Rays.concatenate([rays[:30], away[:10]]), box, basis=basis)
    c = random(*a.domain_shape)
    assert torch.equal(a(c)[30:], torch.zeros(10, 2, dtype=torch.float64))
    assert torch.allclose(a(c)[:30], operator(rays[:30], box, basis=basis)(c))


def test_a_small_box_far_from_its_camera_is_within_the_precision_of_its_rays():
    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    camera = Ring(views=1, image_size=(9, 11), pixel_pitch=2e-3, distance=500.0, background_distance=300.0).cameras()[0]
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).to(dtype=torch.float32).clip(box)
    assert VoxelOperator(rays, Grid(box, (1024, 1024, 1024)), LEVER).samples > 0
